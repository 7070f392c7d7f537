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
"""Jog: turns one wheel by a number of revolutions, wheels off the ground, to check wiring."""

from collections.abc import Callable
import math
from typing import NamedTuple

from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool.manoeuvre import Manoeuvre
from t3mpc_ros.robot.interface import WheelAngles

LEFT, RIGHT = 'left', 'right'


class JogResult(NamedTuple):
    """Microsteps counted by the board, forward positive."""

    target: int
    counted: int
    other: int
    """Of the other wheel, expected to be 0."""
    seconds: float


class Jog(Manoeuvre):
    """Turns one wheel, LEFT or RIGHT, over the link; negative revolutions are backward."""

    _ends_when_silent = False
    _over_cable = True
    _late_reason = 'the wheel does not reach its target: does the board count its steps?'

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes,
        entropy: Callable[[int], bytes],
        wheel: str,
        revolutions: float,
        speed: float,
        report: Callable[[str], None],
    ) -> None:
        if wheel not in (LEFT, RIGHT):
            raise ValueError(f'wheel must be {LEFT} or {RIGHT}: got {wheel}')
        self._right = wheel == RIGHT
        self._angle = math.tau * revolutions
        angles = WheelAngles(self._angle, 0.0) if self._right else WheelAngles(0.0, self._angle)
        super().__init__(parameters, key, entropy, angles, speed, report)

    @property
    def result(self) -> JogResult | None:
        """Counts of the board so far."""
        info, travelled = self.link.info, self.travelled
        if info is None or travelled is None:
            return None
        steps = info.steps_per_rev * info.microsteps
        way, other = travelled if self._right else reversed(travelled)
        target, counted, idle = (
            round(angle * steps / math.tau) for angle in (self._angle, way, other)
        )
        return JogResult(target, counted, idle, self.seconds)


def format_result(result: JogResult, wheel: str, revolutions: float) -> str:
    """Return the result as text, with the expected motion and remedies."""
    way, top = ('forward', 'front') if revolutions > 0 else ('backward', 'back')
    other = RIGHT if wheel == LEFT else LEFT
    return '\n'.join(
        (
            f'{wheel}: {result.counted} microsteps counted, target {result.target}; '
            f'{other}: {result.other}; {result.seconds:.1f} s',
            f'Expected: {abs(revolutions):g} turns {way} of the {wheel} wheel (its top moves to '
            f'the {top}), standstill of the {other} wheel. Otherwise:',
            '  the other wheel turned: swap the cables of the two drivers',
            f'  reverse direction: t3mpc robot setup --invert {wheel} (or both), over the USB of '
            'the robot board, or swap the wires of one motor coil',
            '  more or fewer turns: t3mpc robot setup --microsteps as the jumpers of the drivers',
            '  humming or lost steps: more motor current, or a lower --speed',
        )
    )
