# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Closed loops as the nodes make them, without the nodes, and the bags of them."""

import numpy as np

from support.bag_messages import START, STORE, number, odometry_message, twist_message
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import ORIGIN, State, WheelSpeeds
from t3mpc_ros.simulation.plant.paper_plant import PaperRobot

STEP = 10_000_000
LEAD = 40
WHEELS = ('right', 'left')
GEOMETRY = WheelGeometry()


class Tape:
    """Messages by time of receipt; copies of it are damaged on purpose, then written as bags."""

    def __init__(self, metadata_records, rows=()):
        self.metadata_records = metadata_records
        self.rows = list(rows)

    def add(self, topic, received_ns, message):
        data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
        self.rows.append((received_ns, topic, message.__msgtype__, data))

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


class ClosedLoopObjective:
    """Runs the controller on the simulated robot, as the nodes close the loop."""

    def __init__(self, seed, duration, learnt=None, tape=False, off=(), **changes):
        scenario = Scenario('servo', 'nominal', seed, duration)
        robot = PaperRobot(scenario.true_robot())
        self.controller = Controller(ControllerParameters.from_dict(changes))
        if learnt is not None:
            self.controller.law.set_weights(learnt)
        parameters = {
            name: str(value) for name, value in self.controller.parameters.to_dict().items()
        }
        self.tape = Tape(
            {'controller': {**parameters, 'terms_rate': '20.0', 'use_sim_time': 'False'}}
        )
        self.taped = tape
        self.wanted = scenario.reference().speeds
        self.statuses, self.speeds, self.estimates, self.unexplained = [], [], [], []
        for k in range(LEAD):
            self._tell(k, 0)
        state = robot.advance(START)
        for k in range(scenario.steps):
            heard_ns = START + k * STEP + 1_000_000
            self._tell(k + LEAD, heard_ns - 500_000)
            if off:
                self.controller.enable(not off[0] <= k < off[1])
            twist, status = self.controller.step(state.odometry)
            self.statuses.append(status)
            self.speeds.append(state.true_wheels)
            self.estimates.append(self.controller.actuation.speeds.copy())
            self.unexplained.append(self.controller.actuation.disturbance.copy())
            if tape:
                self._record(k, heard_ns, state.odometry, twist, status)
            state = robot.step(wheels_from_twist(twist, GEOMETRY))
        self.terms = np.array([status.terms for status in self.statuses])
        self.errors = -self.terms[:, 1] / self.controller.parameters.law.gain

    def _tell(self, k, heard_ns):
        twist = twist_from_wheels(WheelSpeeds(*self.wanted[k].tolist()), GEOMETRY)
        motion = State(START + k * STEP, ORIGIN, twist)
        self.controller.add_reference(motion)
        if self.taped:
            self.tape.add(
                '/reference', heard_ns or START, odometry_message(motion.stamp_ns, motion.twist)
            )

    def _record(self, k, heard_ns, odometry, twist, status):
        self.tape.add('/odom', heard_ns, odometry_message(odometry.stamp_ns, odometry.twist))
        self.tape.add('/cmd_vel', heard_ns + 1_000_000, twist_message(twist))
        if (k + 1) % 5:
            return
        for row, term in enumerate(TERM_NAMES):
            for z, wheel in enumerate(WHEELS):
                self.tape.add(
                    f'/controller/terms/{term}/{wheel}',
                    heard_ns + 2_000_000,
                    number(status.terms[row, z]),
                )

    def rmse(self, seconds):
        n = round(100 * seconds)
        return float(np.sqrt(np.mean((np.array(self.speeds[:n]) - self.wanted[:n]) ** 2)))
