# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""A calibration loaded by the bridge and the controller is found in the bag of the run."""

import pytest
import yaml

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli import bag as bag_cli
from t3mpc_ros.cli.robot_calibrate import calibration_file
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.recorder import RecorderNode
from t3mpc_ros.robot.calibration import Calibration, Estimate, SharpCurve

pytestmark = pytest.mark.ros

FOUND = Calibration(
    wheel_radius=Estimate(0.0356, 2e-5),
    track=Estimate(0.1514, 9e-5),
    gyro_scale=Estimate(0.9873, 3e-4),
    curves=(SharpCurve(0.2793, 0.0261, 0.0553, 0.004), *7 * (None,)),
)


def test_the_calibration_is_in_the_bag(harness, tmp_path, capsys):
    files = yaml.safe_load(calibration_file(FOUND, '2026-11-22', {}))
    values = {
        node: {
            name.replace('.', '__'): value
            for name, value in files[f'/**/{node}']['ros__parameters'].items()
        }
        for node in ('radio_bridge', 'controller')
    }
    recorder = harness.add(RecorderNode, storage__uri=str(tmp_path / 'bag'))
    harness.add(RadioBridgeNode, port=str(tmp_path / 'none'), **values['radio_bridge'])
    harness.add(ControllerNode, **values['controller'])
    harness.spin_until(lambda: {'radio_bridge', 'controller'} <= set(recorder._metadata.records))
    harness.remove(recorder)
    with open_bag(tmp_path / 'bag') as recording:
        bridge = recording.metadata_records['radio_bridge']
        controller = recording.metadata_records['controller']
    assert float(bridge['wheel_radius']) == float(controller['wheel_radius']) == 0.0356
    assert float(bridge['calibration.wheel_radius_uncertainty']) == 2e-5
    assert float(bridge['odometry.gyro_scale']) == 0.9873
    assert '0.2793' in bridge['calibration.range_scale']
    assert bag_cli.main(['info', str(tmp_path / 'bag')]) == 0
    shown = capsys.readouterr().out
    assert 'calibration of radio_bridge' in shown
    assert '2026-11-22' in shown
