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
"""A robot of another make: velocity servos, encoders, a slow odometry, commands in steps.

It shares no code with the simulated robot of the package, and its figures are those of a
TurtleBot3 Burger (ROBOTIS-GIT/turtlebot3): the driver truncates commands to 0.01 m/s and
0.01 rad/s, and computes the odometry from the joint positions and the yaw of the IMU.
"""

from collections import deque
from dataclasses import dataclass, field
import math

STEP = 0.001  # integration step, s
TICK = 2.0 * math.pi / 4096  # resolution of the encoders, rad
COMMAND_TICK = 0.01  # resolution of a command, m/s and rad/s


@dataclass
class VelocityRobot:
    """Two wheels whose servos track the commanded speeds with a first-order lag.

    ``odometry`` measures since its last call, as the driver does between two joint states.
    """

    wheel_radius: float = 0.033
    wheel_separation: float = 0.160
    lag: float = 0.05
    dead_time: float = 0.03
    command_tick: float = COMMAND_TICK
    """Resolution of a command, m/s and rad/s; 0: as it is."""
    yaw_gain: float = 1.0  # yaw rate as a share of that of the wheels
    sideways: float = 0.0  # velocity to the left that no wheel has, as on a slope, m/s
    fastest: float = math.inf  # limit of the wheel speeds, rad/s
    pose: list = field(default_factory=lambda: [0.0, 0.0, 0.0])
    speeds: list = field(default_factory=lambda: [0.0, 0.0])
    """Wheel speeds, right wheel first, rad/s."""

    def __post_init__(self):
        self._angles, self._counted = [0.0, 0.0], [0.0, 0.0]
        self._goal = (0.0, 0.0)
        self._commands = deque()
        self._time, self._measured, self._yaw = 0.0, 0.0, 0.0

    def command(self, linear, angular):
        """Receive a twist, which takes effect after the dead time."""
        if (tick := self.command_tick) > 0.0:
            linear, angular = (
                math.trunc(round(value / tick, 9)) * tick for value in (linear, angular)
            )
        half = 0.5 * self.wheel_separation
        goal = [
            min(max((linear + sign * half * angular) / self.wheel_radius, -most), most)
            for sign, most in ((1, self.fastest), (-1, self.fastest))
        ]
        self._commands.append((self._time + self.dead_time, goal))

    def advance(self, duration):
        """Simulate a duration of whole steps (s)."""
        decay = math.exp(-STEP / self.lag)
        for _ in range(round(duration / STEP)):
            self._time += STEP
            while self._commands and self._commands[0][0] <= self._time:
                self._goal = self._commands.popleft()[1]
            for i in range(2):
                self.speeds[i] = self._goal[i] + (self.speeds[i] - self._goal[i]) * decay
                self._angles[i] += STEP * self.speeds[i]
            linear, angular = self.twist
            self.pose[2] += STEP * angular
            cosine, sine = math.cos(self.pose[2]), math.sin(self.pose[2])
            self.pose[0] += STEP * (linear * cosine - self.sideways * sine)
            self.pose[1] += STEP * (linear * sine + self.sideways * cosine)

    @property
    def twist(self):
        """True velocities: forward (m/s) and yaw (rad/s)."""
        right, left = (self.wheel_radius * speed for speed in self.speeds)
        return 0.5 * (right + left), self.yaw_gain * (right - left) / self.wheel_separation

    def odometry(self):
        """Return pose and measured velocities: (x, y, yaw), linear, angular."""
        elapsed = self._time - self._measured
        counted = [math.floor(angle / TICK) * TICK for angle in self._angles]
        right, left = (
            self.wheel_radius * (new - old) / elapsed
            for new, old in zip(counted, self._counted, strict=True)
        )
        angular = (self.pose[2] - self._yaw) / elapsed
        self._counted, self._measured, self._yaw = counted, self._time, self.pose[2]
        return tuple(self.pose), 0.5 * (right + left), angular
