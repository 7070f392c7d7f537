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
"""Whether the robot may move, and why not; and whether it follows the commands."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
import enum
import math
from typing import ClassVar

from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    BodyTwist,
    Pose,
    State,
    WheelSpeeds,
    has_moved,
    is_out_of_order,
    motion_between,
)
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class WatchdogParameters(Parameters):
    """Time-outs of the inputs and bounds of a plausible state."""

    reference_timeout: float = parameter(
        0.15, 'maximum age of the reference, measured with the odometry stamps', 's', (0.01, 5.0)
    )
    odometry_timeout: float = parameter(
        0.2, 'maximum gap in the odometry; the robot stops after a longer gap', 's', (0.02, 5.0)
    )
    speed_bound: float = parameter(
        40.0, 'measured wheel speed above which the state is diverging', 'rad/s', (1.0, 1000.0)
    )
    error_bound: float = parameter(
        25.0, 'tracking error above which the state is diverging', 'rad/s', (0.5, 1000.0)
    )
    hold_time: float = parameter(
        0.5, 'duration of the stop after a diverging state', 's', (0.0, 60.0)
    )

    response_bound: float = parameter(
        1.5,
        'distance of a measured wheel speed from the range of the commands in response_window '
        'above which the robot does not follow commands; 0 disables the check',
        'rad/s',
        (0.0, 100.0),
    )
    response_window: float = parameter(
        0.15, 'maximum delay between a command and its effect in the odometry', 's', (0.01, 2.0)
    )
    response_timeout: ClassVar[float] = 0.1
    """Duration of a missing or restored response before the decision changes, s, assumed."""


class Reason(enum.Enum):
    """Decision of the watchdog: the robot follows the reference, or the reason why it does not."""

    TRACKING = 'tracking'
    DISABLED = 'disabled by request'
    NO_ODOMETRY = 'no odometry'
    ODOMETRY_BAD = 'odometry is not finite'
    ODOMETRY_RESTARTED = 'odometry has restarted'
    NO_REFERENCE = 'no reference yet'
    REFERENCE_STALE = 'reference is stale'
    DIVERGING = 'state is diverging'
    NOT_FOLLOWING = 'the robot does not follow commands'
    PAUSED = 'commands pause because the robot does not follow them'
    TOO_FEW_RANGES = 'too few range sensors work to drive on'
    STOPPED_AGAIN = 'the robot has stopped again after each of three pauses'

    def __init__(self, text: str) -> None:
        self.moves = text in ('tracking', 'the robot does not follow commands')
        """Whether a non-zero command may be sent."""


class StopHistory:
    """Stops since the robot first followed a reference, also those between two reports."""

    def __init__(self) -> None:
        self.number = 0
        self.last: Reason | None = None
        """Reason of the newest stop; None before the first motion, and without a stop."""
        self._moving: bool | None = None
        self._begin_ns = self._end_ns = 0
        self._reported = 0

    def update(self, reason: Reason, now_ns: int) -> None:
        """Count a stop when it begins, and take its reason, the newest while it lasts."""
        if reason.moves:
            if self._moving is False:
                self._end_ns = now_ns
            self._moving = True
        elif self._moving is not None:
            if self._moving:
                self.number += 1
                self._begin_ns = now_ns
            self._moving, self.last = False, reason

    def duration(self, now_ns: int) -> float:
        """Return the duration of the newest stop, s."""
        return ((self._end_ns if self._moving else now_ns) - self._begin_ns) / NANOSECONDS

    def age(self, now_ns: int) -> float:
        """Return the time since the newest stop ended, s; 0 while it lasts."""
        return (now_ns - self._end_ns) / NANOSECONDS if self._moving else 0.0

    def unreported(self, now_ns: int) -> str:
        """Return the newest stop if it has begun and ended since the last call."""
        known, self._reported = self._reported, self.number
        if self.last is None or not self._moving or self.number == known:
            return ''
        return (
            f'stopped for {self.duration(now_ns):.2g} s, {self.age(now_ns):.1f} s ago: '
            f'{self.last.value}'
        )


class InputWatchdog:
    """Decides at each step whether odometry and reference are recent and plausible.

    The decision uses message stamps only and reads no clock; it is a function of the messages in
    their order of arrival. Missing odometry is the exception, see :meth:`check_silence`.
    """

    def __init__(self, parameters: WatchdogParameters) -> None:
        self._parameters = parameters
        self.enabled = True
        self.reset()

    def reset(self) -> None:
        """Clear all stamps; the robot may move after the next valid odometry and reference."""
        self._odometry_ns: int | None = None
        self._reference_ns: int | None = None
        self.doubted_ns: int | None = None
        """Stamp of the last message if it leaps, until the next one confirms or refutes it."""
        self.ignored = 0
        """Number of messages that were ignored: repeated, overtaken, or with a refuted stamp."""
        self._silent = False  # whether the odometry has timed out since the last message
        self._reference_pending = False
        self._restarted = False  # whether no reference has arrived since the stamps went back
        self._hold_until_ns: int | None = None
        self._diverged = 0.0, 0.0
        """Wheel speed and error of the last state that was diverging, rad/s."""

    def reference_received(self) -> None:
        """Register a valid reference; its age counts from the next odometry stamp."""
        self._reference_pending = True

    def is_out_of_order(self, stamp_ns: int) -> bool:
        """Whether an odometry is the last one again, or was overtaken by it on the way."""
        last, timeout = self._odometry_ns, self._parameters.odometry_timeout
        return last is not None and is_out_of_order(stamp_ns, last, timeout)

    def ignores(self, stamp_ns: int) -> bool:
        """Whether an odometry changes nothing: out of order, or its stamp alone leaps.

        A stamp beyond the time-out of the last one may be wrong, unless there was a silence. The
        next message confirms it if it follows it: messages are missing, or the clock was set.
        """
        last, doubted, self.doubted_ns = self._odometry_ns, self.doubted_ns, None
        timeout_ns = self._parameters.odometry_timeout * NANOSECONDS
        leaps = last is not None and not self._silent and abs(stamp_ns - last) > timeout_ns
        self._silent = False
        if leaps and doubted is not None and 0 < stamp_ns - doubted <= timeout_ns:
            return False
        self.ignored += doubted is not None
        if leaps:
            self.doubted_ns = stamp_ns
            return True
        ignored = self.is_out_of_order(stamp_ns)
        self.ignored += ignored
        return ignored

    def elapsed(self, stamp_ns: int) -> float | None:
        """Return the time since the previous odometry, s; None if integration must restart.

        That is for the first message, a stamp that decreases, and a gap longer than the time-out.
        """
        last, self._odometry_ns = self._odometry_ns, stamp_ns
        if last is None:
            return None
        elapsed = (stamp_ns - last) / NANOSECONDS
        if elapsed < 0.0 or elapsed > self._parameters.odometry_timeout:
            if elapsed < 0.0:
                self._reference_ns = None
                self._hold_until_ns = None
                self._restarted = True
            return None
        return elapsed

    def decide(
        self, stamp_ns: int, *, finite: bool, known: bool, speed: float, error: float
    ) -> Reason:
        """Return TRACKING if the robot may move at this odometry stamp, else the reason to stop.

        finite, known : whether every number of the odometry is finite, and the reference is known
        speed, error : largest magnitudes of measured wheel speed and of tracking error, rad/s
        """
        if self._reference_pending:
            self._reference_pending = False
            self._reference_ns = stamp_ns
        if not self.enabled:
            return Reason.DISABLED
        if not finite:
            return Reason.ODOMETRY_BAD
        missing = Reason.ODOMETRY_RESTARTED if self._restarted else Reason.NO_REFERENCE
        if self._reference_ns is None:
            return missing
        age = (stamp_ns - self._reference_ns) / NANOSECONDS
        if age > self._parameters.reference_timeout:
            return Reason.REFERENCE_STALE
        if not known:
            return missing
        self._restarted = False
        if speed > self._parameters.speed_bound or error > self._parameters.error_bound:
            self._hold_until_ns = stamp_ns + round(self._parameters.hold_time * NANOSECONDS)
            self._diverged = speed, error
        if self._hold_until_ns is not None and stamp_ns <= self._hold_until_ns:
            return Reason.DIVERGING
        self._hold_until_ns = None
        return Reason.TRACKING

    def divergence(self) -> str:
        """Return what a diverging state was beyond, and what to look at."""
        parameters, (speed, error) = self._parameters, self._diverged
        return (
            f'wheel speed {speed:.3g} rad/s (watchdog.speed_bound {parameters.speed_bound:g}), '
            f'{error:.3g} rad/s off the reference (watchdog.error_bound '
            f'{parameters.error_bound:g}): look at the twist in odom and its units, and at '
            'wheel_radius'
        )

    def check_silence(self, last_received_ns: int | None, now_ns: int) -> bool:
        """Find out whether the odometry is older than the time-out; both times are of one clock.

        If so, the stamp of the next message is believed: :meth:`ignores` has no doubt after it.
        """
        timeout_ns = self._parameters.odometry_timeout * NANOSECONDS
        self._silent = last_received_ns is None or now_ns - last_received_ns > timeout_ns
        return self._silent


EVIDENCE_WEIGHT = 20
"""Weight of a sample that a standing robot cannot produce; other samples have weight 1."""


class ResponseMonitor:
    """Decides whether the wheels respond to the commands.

    A robot without radio contact, in a restart or with a blocked wheel must not be used for
    adaptation. Its wheel speeds lie outside the range of the recent commands, whatever the delay
    of the robot. Commands near zero carry little evidence: a standing robot fits them too.
    """

    def __init__(self, parameters: WatchdogParameters, period: float) -> None:
        self._parameters = parameters
        self._commands: deque[tuple[float, float]] = deque(
            maxlen=max(1, round(parameters.response_window / period))
        )
        self._timeout_steps = max(1, round(parameters.response_timeout / period))
        self.evidence = 0  # against the present decision
        self.responsive = True  # whether the robot follows commands

    def reset(self) -> None:
        """Clear the commands and assume a responsive robot."""
        self._commands.clear()
        self.evidence = 0
        self.responsive = True

    def add_command(self, right: float, left: float) -> None:
        """Store the wheel speeds commanded at this step, rad/s."""
        self._commands.append((right, left))

    def command(self, age: int) -> WheelSpeeds | None:
        """Return the wheel speeds commanded that many steps before the newest; None: unknown."""
        known = 0 <= age < len(self._commands)
        return WheelSpeeds(*self._commands[-1 - age]) if known else None

    def update(self, right: float, left: float) -> bool:
        """Return whether the robot follows commands, given measured wheel speeds, rad/s."""
        bound, commands = self._parameters.response_bound, self._commands
        if bound == 0.0 or len(commands) < (commands.maxlen or 0):
            return self.responsive
        newest = commands[-1]
        if self.responsive and max(abs(right - newest[0]), abs(left - newest[1])) <= bound:
            # A speed within the bound of one command is within the bound of their range.
            self.evidence = 0
            return True
        outside = standstill_outside = 0.0
        for measured, given in zip((right, left), zip(*commands, strict=True), strict=True):
            lowest, highest = min(given), max(given)
            outside = max(outside, measured - highest, lowest - measured)
            standstill_outside = max(standstill_outside, -highest, lowest)
        if (outside > bound) != self.responsive:
            self.evidence = 0
        elif self.responsive or standstill_outside > bound:
            self.evidence += EVIDENCE_WEIGHT
        else:
            self.evidence += 1  # a standing robot fits these commands as well
        if self.evidence >= EVIDENCE_WEIGHT * self._timeout_steps:
            self.responsive, self.evidence = not self.responsive, 0
        return self.responsive


MEAN_TIME, NOISE_STEPS = 0.1, 300
"""Time over which a measured speed is averaged (s), and the steps over which its noise is."""
WHEEL_OUTSIDE = 5.0, 0.05, 0.05
"""Distance of the mean from the range of the commands that no noise explains: its standard
deviations, the speed that is added (rad/s), and the share of the nearest command: a twist of the
odometry may be wrong by that."""
WHEEL_STEPS, WHEEL_GAP = 5, 1.0
"""Number of such steps from which a wheel did not follow, and the longest time between two (s)."""
WHEEL_WAIT, WHEEL_RECENT = 2.0, 10.0
"""Time after which it is reported, and for which, s: by then a wrong twist in the odometry, which
looks alike, is found."""
AT_LIMIT = 0.95  # share of the largest speed of late from which a wheel may be at a limit
LARGEST_MEMORY = 3000  # steps over which the largest speed is forgotten


class WheelMonitor:
    """Says which wheel was at a speed that no command of late explains, for diagnostics only.

    A wheel whose commands are lost for a moment, and one at a limit of the robot, are less than
    ``response_bound`` off, or for less than ``response_timeout``. The mean of some measurements
    shows a quarter of that (noise 0.04 (rad/s)²), whatever the delay within ``response_window``.
    """

    def __init__(self, parameters: WatchdogParameters, period: float) -> None:
        self._mean_steps = max(1, round(MEAN_TIME / period))
        steps = self._mean_steps + max(1, round(parameters.response_window / period))
        self._enabled = parameters.response_bound > 0.0
        self._commands: tuple[deque[float], ...] = (deque(maxlen=steps), deque(maxlen=steps))
        self._measured: tuple[deque[float], ...] = tuple(
            deque(maxlen=self._mean_steps) for _ in range(2)
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything: the speeds before were no measurements."""
        self._noise, self._samples = [0.0, 0.0], 0
        self._largest = [0.0, 0.0]
        self._now_ns = self._begin_ns = self._last_ns = 0
        self._steps = 0
        self._worst = 0, 0.0, 0.0
        """Wheel, mean speed and nearest command (rad/s) where they were farthest apart."""
        self._at_limit = False
        self.interrupt()

    def interrupt(self) -> None:
        """Forget the newest commands and speeds: the robot stops."""
        for values in (*self._commands, *self._measured):
            values.clear()

    @property
    def outside(self) -> bool:
        """Whether a wheel was at such a speed in the last second."""
        return self._steps > 0 and self._now_ns - self._last_ns <= WHEEL_GAP * NANOSECONDS

    def update(self, stamp_ns: int, speeds: Sequence[float], command: Sequence[float]) -> None:
        """Add measured wheel speeds and the command that was sent before, rad/s."""
        if not self._enabled:
            return
        if stamp_ns < self._now_ns:  # the clock was set back: no time of before has an age
            self.reset()
        self._now_ns = stamp_ns
        self._samples += 1
        share, steps = max(1.0 / self._samples, 1.0 / NOISE_STEPS), self._mean_steps
        times, least, part = WHEEL_OUTSIDE
        noise, largest = self._noise, self._largest
        for wheel in range(2):
            commands, measured, speed = self._commands[wheel], self._measured[wheel], speeds[wheel]
            commands.append(command[wheel])
            if measured:
                half_square = 0.5 * (speed - measured[-1]) ** 2
                noise[wheel] += share * (half_square - noise[wheel])
            measured.append(speed)
            if len(commands) < (commands.maxlen or 0):
                continue
            mean = sum(measured) / steps
            bound = times * math.sqrt(noise[wheel] / steps) + least
            largest[wheel] = max(abs(mean), (1.0 - 1.0 / LARGEST_MEMORY) * largest[wheel])
            if abs(mean - commands[-steps]) <= bound:
                continue
            nearest = min(max(mean, min(commands)), max(commands))
            if abs(mean - nearest) > bound + part * abs(nearest):
                self._add(wheel, mean, nearest)

    def _add(self, wheel: int, mean: float, nearest: float) -> None:
        """Count a step with a wheel outside."""
        longest = WHEEL_RECENT if self._steps >= WHEEL_STEPS else WHEEL_GAP
        if self._now_ns - self._last_ns > longest * NANOSECONDS:
            self._steps, self._begin_ns = 0, self._now_ns
        if self._steps == 0 or abs(mean - nearest) > abs(self._worst[1] - self._worst[2]):
            self._worst = wheel, mean, nearest
            # At a limit it is slower than commanded, and as fast as it ever is.
            slower = mean * nearest > 0.0 and abs(mean) < abs(nearest)
            self._at_limit = slower and abs(mean) > AT_LIMIT * self._largest[wheel]
        self._steps += 1
        self._last_ns = self._now_ns

    def problem(self) -> str:
        """Return which wheel did not follow, and the remedy; '' if none was found of late."""
        since_begin, age = (
            (self._now_ns - time) / NANOSECONDS for time in (self._begin_ns, self._last_ns)
        )
        if self._steps < WHEEL_STEPS or since_begin < WHEEL_WAIT or age > WHEEL_RECENT:
            return ''
        wheel, mean, nearest = self._worst
        text = (
            f'the {("right", "left")[wheel]} wheel had {mean:.2f} rad/s, the nearest of its '
            f'commands {nearest:.2f} rad/s, {age:.0f} s ago'
        )
        if self._at_limit:
            return f'{text}: it gets no faster, lower the limits here to those of the robot'
        return (
            f'{text}: commands of it are lost, it is blocked or at a limit of the robot, or it '
            'responds later than watchdog.response_window'
        )


MOTION, ASKED_MOTION = (0.03, 0.15), (0.1, 0.5)
"""Change of the pose (m, rad) that is motion, and what the commands to a robot that stands must
have asked of it."""
STANDING_TIME = 1.5  # time in which commands must move the robot, s
ASTRAY_TIME = 5.0  # time in which a robot may move otherwise than commanded, s
PAUSE = 0.8
"""Duration of a pause, s: a robot that has stopped because of slip asks for half a second."""
TRIALS = 3
"""Pauses after which the commands end, if the robot has moved and stopped again after each."""
OPPOSED, OPPOSED_MEMORY = -0.3, 3.0
"""Quotient of measured and commanded velocity below which the robot moves the other way, and the
time constant of its means, s; at the earliest after STANDING_TIME."""
OPPOSED_EXCITATION = 0.004, 0.13
"""Integral of the squared command from which that is known, m²/s and rad²/s: 0.05 m/s and 0.3
rad/s for 1.5 s."""
CONTACT_MOTION, CONTACT_LEAD = 0.05, 0.15
"""Commanded motion (m) of which too little leads anywhere where the robot is held, and the time by
which the pose is behind the commands, s."""
CONTACT_WINDOW = 4.0  # longest time in which that motion is commanded, s
CONTACT_SHARES = 0.3, 0.4
"""Share of the commanded motion below which the robot is held, and share above which it moves
sideways, as along what it touches."""
CONTACT_TURN = 0.25
"""Difference of the turns by pose and by wheels within that motion (rad): what the robot touches
turns it."""
THROWN, THROWN_LAGS, THROWN_MEMORY = 0.4, (0.2, 0.1), 1.0
"""Turn (rad) in about that memory (s) which nothing commanded: a robot that meets something at
full speed, off its middle, is thrown about and turns back rather than drives. Commands and pose
are compared behind these lags (s); without a contact the turn of the twin stays below 0.28 rad."""
OWN_ODOMETRY = 0.001
"""Difference of a step of the pose from that of the wheels (m, rms) up to which the pose is
counted by the wheels: only then that difference of the turns says more than the way does. A tyre
that slips turns a robot, too."""
ON_THE_SPOT, DRIVING = 0.015, 0.05
"""Commanded speeds (m/s) above which the way counts, and the difference of the turns."""
TIGHT = 0.1
"""Radius of a curve (m) below which the robot turns rather than drives: the correction of a pose
may be a fifth of the way of a point beside it, and most of that of its centre."""
FROZEN_MOTION = 0.08, 0.6
"""Motion by the twist (m, rad) during which a pose that is equal to the last bit is frozen; a
camera of 5 Hz repeats the pose of a robot for less."""
RECOVERY_TIME = 5.0  # time of driving as commanded after which earlier pauses do not count, s


class ContactMonitor:
    """Compares what was commanded of a robot with the change of its pose, piece by piece.

    Wheels that slip, and motors that lose steps, count a motion that the pose does not make, if
    it comes from elsewhere; the gyro of the odometry alone sees the turn of a robot that touches
    something with one side.
    """

    def __init__(self) -> None:
        self._pose: Pose | None = None
        self.furthest = ORIGIN
        """Where the robot came, the last time that it advanced: what holds it may turn it."""
        self.wheels_stood = False
        """Whether the wheels did not turn either, when the last contact was found."""
        self.restart(None)

    def restart(self, pose: Pose | None) -> None:
        """Begin a new piece at a pose; at none, a new drive."""
        if pose is None:
            self._asked_rate = self._rate = self._thrown = 0.0
        self._pose = pose
        self._most = self._unlike = 0.0
        self._steps = 0
        self._asked = self._ahead = self._left = self._turn = self._time = self._driven = 0.0
        self._fastest = self._fastest_turn = 0.0

    def is_in_contact(self, odometry: State, command: BodyTwist, elapsed: float) -> bool:
        """Whether something holds, turns or pushes aside a robot that is commanded to drive."""
        pose, last = odometry.pose, self._pose
        if last is not None and self._is_thrown(motion_between(last, pose)[2], command, elapsed):
            self.restart(pose)
            self.wheels_stood = False
            return True
        slowest = max(ON_THE_SPOT, TIGHT * abs(command.angular))
        if last is None or command.linear * self._asked < 0.0 or abs(command.linear) < slowest:
            # Not only left out: the noise of a pose cancels in a sum without gaps alone. On the
            # spot a pose may be corrected, and a tyre slip, without any contact.
            self.restart(pose)
            return False
        ahead, left, turn = motion_between(last, pose)
        self._pose = pose
        self._unlike += (ahead - odometry.twist.linear * elapsed) ** 2
        self._steps += 1
        self._asked += command.linear * elapsed
        self._driven += odometry.twist.linear * elapsed
        self._ahead += ahead
        self._left += left
        if abs(command.linear) > DRIVING:
            self._turn += odometry.twist.angular * elapsed - turn
        if abs(self._ahead) >= self._most:
            self._most, self.furthest = abs(self._ahead), pose
        self._fastest = max(self._fastest, abs(command.linear))
        self._fastest_turn = max(self._fastest_turn, abs(command.angular))
        self._time += elapsed
        asked = abs(self._asked) - CONTACT_LEAD * self._fastest
        if asked < CONTACT_MOTION:
            if self._time > CONTACT_WINDOW:
                self.restart(pose)
            return False
        least, most = CONTACT_SHARES
        touches = math.copysign(self._ahead, self._ahead * self._asked) < least * asked
        touches |= abs(self._left) > most * asked
        if self._unlike <= self._steps * OWN_ODOMETRY**2:
            touches |= abs(self._turn) > CONTACT_TURN + CONTACT_LEAD * self._fastest_turn
        self.wheels_stood = abs(self._driven) < least * asked
        self.restart(pose)
        return touches

    def _is_thrown(self, turn: float, command: BodyTwist, elapsed: float) -> bool:
        """Return whether the robot turns (rad in this step) as nothing has commanded."""
        if not elapsed > 0.0:
            return False
        lag, own_lag = (elapsed / (each + elapsed) for each in THROWN_LAGS)
        self._asked_rate += lag * (command.angular - self._asked_rate)
        self._rate += own_lag * (turn / elapsed - self._rate)
        permitted = min(max(self._rate, min(self._asked_rate, 0.0)), max(self._asked_rate, 0.0))
        self._thrown += elapsed * (self._rate - permitted - self._thrown / THROWN_MEMORY)
        if abs(self._thrown) < THROWN:
            return False
        self._thrown = 0.0
        return True


class DriveMonitor:
    """Pauses the commands to a robot that stands in spite of them, or that moves otherwise.

    A robot that has stopped because of slip stands until nothing was commanded for a while. One
    that never moves gets commands again after each pause, however many: its emergency stop may be
    released, its board may start. One that moves and then stops again gets three pauses.
    """

    def __init__(self, *, feels: bool = False, follows_pose: bool = False) -> None:
        """``feels``: also pause them where the change of the pose says that the robot is held.

        ``follows_pose``: also where the pose is frozen, by which the robot is led.
        """
        self._feels, self._follows_pose = feels, follows_pose
        self.contact_monitor = ContactMonitor()  # where something holds the robot
        self.reset()

    def reset(self) -> None:
        """Forget all pauses."""
        self.pauses = 0  # pauses since the robot drove as commanded
        self.contact = False  # whether this pause began because something held the robot
        self._frozen = False  # whether it began because the pose was frozen
        self._trials = 0
        self._stopped = False
        """Whether a pause began because something held the robot, or it stopped by itself."""
        self._ended = False
        self._pause = 0.0
        self.begin()

    def begin(self) -> None:
        """Begin a drive: nothing was commanded before."""
        self._anchor: Pose | None = None
        self._moved = False
        self._well = self._astray = 0.0
        self._power, self._product = [0.0, 0.0], [0.0, 0.0]
        self._time = 0.0
        self.contact = self._frozen = False
        self._pose: Pose | None = None
        self._unchanged = 0.0  # share of FROZEN_MOTION since the pose last changed
        self.contact_monitor.restart(None)
        self._restart(None)

    def _restart(self, pose: Pose | None) -> None:
        self._anchor = pose
        self._since = 0.0
        self._asked = [0.0, 0.0]
        self._measured = [0.0, 0.0]

    def decide(
        self, odometry: State, command: BodyTwist, elapsed: float, *, following: bool
    ) -> Reason:
        """Return TRACKING if the robot may move, else the reason why nothing is commanded.

        ``command``: twist of the last period; ``following``: whether the wheels respond
        """
        if self._ended:
            return Reason.STOPPED_AGAIN
        if self._pause > 0.0:
            self._pause -= elapsed
            if self._pause > 0.0:
                return Reason.PAUSED
            self.begin()
            return Reason.TRACKING
        unchanged = self._unchanged_share(odometry, elapsed)
        held = self._feels and self.contact_monitor.is_in_contact(odometry, command, elapsed)
        if self._follows_pose and unchanged > (0.5 if held else 1.0):
            self._frozen = True
            return self._begin_pause()
        # A robot that stops by itself, after a slip, drives on after a pause; what holds it will
        # hold it again.
        by_itself = self.contact_monitor.wheels_stood and not self._stopped
        self._stopped = self._stopped or held
        self.contact = held and not by_itself
        stands = self._stands(odometry, command, elapsed) or held
        if stands or self._is_opposed(odometry.twist, command, elapsed):
            return self._begin_pause()
        if following:
            self._astray = max(self._astray - elapsed, 0.0)
            self._well += elapsed
            if self._moved and self._well > RECOVERY_TIME:
                self.pauses = self._trials = 0
                self._stopped = False
        elif self._moved:
            self._astray += elapsed
            if self._astray > ASTRAY_TIME:
                return self._begin_pause()
        return Reason.TRACKING

    def problem(self) -> str:
        """Return what to do about a robot that does not follow, or nothing."""
        if self._ended and self.contact:
            return (
                'something that the range sensors do not see holds the robot: free it, move what '
                'is in its way or keep it out by keep_out.world, then call ~/enable'
            )
        if self._frozen:
            return (
                'the pose in odom stays the same while its twist moves: look at the localisation '
                f'or camera that gives it{", then call ~/enable" if self._ended else ""}'
            )
        if self._ended:
            return 'free the wheels, look at the diagnostics of the robot, then call ~/enable'
        if self.contact:
            return 'the robot touches something that the range sensors do not see: it backs off'
        if self.pauses:
            return (
                f'{self.pauses} pauses of the commands, each followed by another attempt: look at '
                'the diagnostics of the robot; emergency stop, power, wheels; signs and stamps '
                'of odom'
            )
        return ''

    def _unchanged_share(self, odometry: State, elapsed: float) -> float:
        """Return the motion by the twist since the pose last changed; 1: the pose is frozen."""
        if odometry.pose != self._pose:
            self._pose, self._unchanged = odometry.pose, 0.0
        else:
            shares = (abs(v) / most for v, most in zip(odometry.twist, FROZEN_MOTION, strict=True))
            self._unchanged += elapsed * max(shares)
        return self._unchanged

    def _stands(self, odometry: State, command: BodyTwist, elapsed: float) -> bool:
        """Whether the robot has not moved for longer than its commands allow."""
        pose, measured, asked = odometry.pose, self._measured, self._asked
        twist = odometry.twist
        measured[0] += twist.linear * elapsed
        measured[1] += twist.angular * elapsed
        asked[0] += command.linear * elapsed
        asked[1] += command.angular * elapsed
        self._since += elapsed
        moved = abs(measured[0]) > MOTION[0] or abs(measured[1]) > MOTION[1]
        if self._anchor is None or moved or has_moved(self._anchor, pose, *MOTION):
            self._moved = self._moved or self._anchor is not None
            self._restart(pose)
            return False
        return self._since > STANDING_TIME and any(
            abs(one) > bound for one, bound in zip(asked, ASKED_MOTION, strict=True)
        )

    def _is_opposed(self, measured: BodyTwist, command: BodyTwist, elapsed: float) -> bool:
        """Whether a velocity of the robot has the opposite sign of its command."""
        self._time += elapsed
        kept, opposed = 1.0 - min(elapsed / OPPOSED_MEMORY, 1.0), False
        for i, enough in enumerate(OPPOSED_EXCITATION):
            self._power[i] = kept * self._power[i] + elapsed * command[i] ** 2
            self._product[i] = kept * self._product[i] + elapsed * command[i] * measured[i]
            opposed |= self._power[i] > enough and self._product[i] < OPPOSED * self._power[i]
        return opposed and self._time > STANDING_TIME

    def _begin_pause(self) -> Reason:
        self.pauses += 1
        self._trials += self._moved
        self._ended = self._trials > TRIALS
        self._pause = PAUSE
        return Reason.STOPPED_AGAIN if self._ended else Reason.PAUSED
