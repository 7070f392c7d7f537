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
"""Closed loops as the nodes make them, without the nodes, and the bags of them."""

import numpy as np

from support.bag_messages import START, serialised
from support.golden_bags import RecordedController
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.controller import ControllerParameters
from t3mpc_ros.evaluation.process_replay.controller_replay import TYPES, cdr_bytes
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import ORIGIN, State, WheelSpeeds
from t3mpc_ros.simulation.paper_robot import PaperRobot

STEP = 10_000_000
LEAD = 40
GEOMETRY = WheelGeometry()


class Tape:
    """Messages by time of receipt; copies of it are damaged on purpose, then written as bags."""

    def __init__(self, metadata_records, rows=()):
        self.metadata_records = metadata_records
        self.rows = list(rows)

    def add(self, topic, received_ns, message):
        self.rows.append((received_ns, topic, message.__msgtype__, serialised(message)))

    def where(self, keep):
        """Return the messages for which ``keep(seconds, topic, count on its topic)`` is true."""
        counts = {}
        kept = []
        for row in self.rows:
            counts[row[1]] = counts.get(row[1], -1) + 1
            if keep((row[0] - START) / 1e9, row[1], counts[row[1]]):
                kept.append(row)
        return Tape(self.metadata_records, kept)

    def changed(self, **parameters):
        """Return the same messages beside other settings; None takes one away."""
        table = {**self.metadata_records['controller'], **parameters}
        table = {name: value for name, value in table.items() if value is not None}
        return Tape({'controller': table}, self.rows)

    def write(self, folder):
        with BagWriter(folder, metadata_records=self.metadata_records) as bag:
            for topic, kind in {row[1]: row[2] for row in self.rows}.items():
                bag.add_topic(topic, kind)
            for received_ns, topic, _, data in sorted(self.rows, key=lambda row: row[0]):
                bag.write(topic, received_ns, received_ns, data)
        return folder


class TapeBag:
    """Keeps the messages of a controller in a tape."""

    def __init__(self, tape):
        self.tape = tape

    def add(self, topic, now_ns, value):
        self.tape.rows.append((now_ns, f'/{topic}', TYPES[topic], cdr_bytes(value)))


class TrainingRun:
    """A controller on the simulated robot of the paper, recorded as by the nodes.

    It is disabled in the control periods ``off``.
    """

    def __init__(self, seed, duration, off=(), **changes):
        scenario = Scenario('servo', 'nominal', seed, duration)
        robot = PaperRobot(scenario.true_robot())
        parameters = ControllerParameters.from_dict(changes)
        table = {name: str(value) for name, value in parameters.to_dict().items()}
        self.tape = Tape({'controller': table})
        recorded = RecordedController(parameters, TapeBag(self.tape), START - 1)
        self.controller = recorded.controller
        reference = scenario.reference().speeds
        self.statuses, self.estimates, self.unexplained = [], [], []

        def add_reference(k, now_ns):
            twist = twist_from_wheels(WheelSpeeds(*reference[k].tolist()), GEOMETRY)
            recorded.add_reference(now_ns, State(START + k * STEP, ORIGIN, twist))

        for k in range(LEAD):
            add_reference(k, START)
        state = robot.advance(START)
        for k in range(scenario.steps):
            now_ns = START + k * STEP + 1_000_000
            add_reference(k + LEAD, now_ns - 500_000)
            if k in off:
                recorded.enable(now_ns - 1, k == off[-1])
            twist = recorded.step(now_ns, state.odometry)
            self.statuses.append(self.controller.status)
            self.estimates.append(self.controller.actuation.speeds.copy())
            self.unexplained.append(self.controller.actuation.disturbance.copy())
            state = robot.step(wheels_from_twist(twist, GEOMETRY))
        self.terms = np.array([status.terms for status in self.statuses])
        self.errors = -self.terms[:, 1] / self.controller.parameters.law.gain
