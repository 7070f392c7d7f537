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
"""The table of docs/safety.md in its short form: one trial of each kind, with real processes."""

import pytest
from support.long_tests import few_of

from bench import stopping_times

pytestmark = [pytest.mark.ros, pytest.mark.timed, pytest.mark.slow]


@pytest.mark.parametrize(
    'kind',
    few_of(['suspend', 'publisher', 'uplink', 'downlink', 'unplug', 'kill', 'cable', 'two']),
)
def test_the_robot_rests_in_time_whatever_fails(kind, processes, ros, tmp_path):
    """A bridge suspended for seconds executed an old command when it went on.

    A trial in which the emulator itself was interrupted is repeated: its times are then wrong.
    """
    import rclpy

    node = rclpy.create_node('stopping_times')
    try:
        for name, trials, _ in stopping_times.rows(
            node, processes, tmp_path, 1, durations=(1.0,), kinds=(kind,)
        ):
            (trial,) = trials
            print(f'\n{name}: {trial}')
            assert trial.rest is None or trial.rest <= stopping_times.LIMIT
            assert trial.after <= stopping_times.CREEP
    finally:
        node.destroy_node()
