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
"""Closed loops of the controller and simple robots, without plant or noise."""

import math

import numpy as np

from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, State, WheelSpeeds

PERIOD = 10_000_000  # ns
LEAD = 40 * PERIOD  # time by which the reference is ahead, ns
GEOMETRY = WheelGeometry()


def make_state(stamp_ns, linear=0.0, angular=0.0):
    return State(stamp_ns, ORIGIN, BodyTwist(linear, angular))


class Loop:
    """A closed loop with an ideal robot, whose speed is the last command."""

    def __init__(self, reference=lambda t: (0.1, 0.5), **changes):
        self.controller = Controller(ControllerParameters.from_dict(changes))
        self.reference = reference
        self.now = 0
        self.twist = BodyTwist(0.0, 0.0)
        self.reference_active = True

    def step(self, measured=None):
        if self.reference_active:
            stamp = self.now + LEAD
            self.controller.add_reference(make_state(stamp, *self.reference(stamp / 1e9)))
        motion = measured or State(self.now, ORIGIN, self.twist)
        self.twist, status = self.controller.step(motion)
        self.now += PERIOD
        return status

    def run(self, steps):
        return [self.step() for _ in range(steps)]


class ServoLoop(Loop):
    """A closed loop with a servo lag of 20 ms and a dead time of 10 ms.

    While it is not ``responsive`` it stops and follows no command.
    """

    def __init__(self, reference, **changes):
        super().__init__(reference, **({'speed_filter.noise_variance': 0.0} | changes))
        self.speeds = np.zeros(2)
        self.delayed = BodyTwist(0.0, 0.0)
        self.responsive = True

    def step(self, measured=None):
        motion = State(self.now, ORIGIN, twist_from_wheels(WheelSpeeds(*self.speeds), GEOMETRY))
        status = super().step(motion)
        command = np.array(wheels_from_twist(self.delayed, GEOMETRY)) * self.responsive
        self.speeds = command + math.exp(-0.5) * (self.speeds - command)
        self.delayed = self.twist
        return status

    def run(self, seconds):
        """Return the wheel speeds, shape (n, 2)."""
        speeds = []
        for _ in range(round(100 * seconds)):
            speeds.append(self.speeds.copy())
            self.step()
        return np.array(speeds)

    def squared_error(self, seconds, after):
        speeds = self.run(seconds)
        twists = [BodyTwist(*self.reference(0.01 * k)) for k in range(len(speeds))]
        r = np.array([wheels_from_twist(twist, GEOMETRY) for twist in twists])
        return 0.01 * np.sum((speeds - r)[round(100 * after) :, 0] ** 2)
