# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixed-step robot: base class of the simulated robots, integrated on a fixed time grid."""

from abc import ABC, abstractmethod
from collections import deque
from fractions import Fraction
from typing import Generic, TypeVar

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError, Parameters
from t3mpc_ros.robot.command_limiter import CLOCK_JUMPED_BACK, CommandLimiter
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand, RobotInterface, RobotState

S = TypeVar('S', bound=Parameters)


def check_read_only(before: Parameters, after: Parameters) -> None:
    """Raise ParameterError when a setting differs that is fixed once the robot is made."""
    old, new = before.to_dict(), after.to_dict()
    for row in before.specs():
        if not row.dynamic and old[row.name] != new[row.name]:
            raise ParameterError(
                f'{row.name} is fixed while the robot runs '
                f'(it is {old[row.name]}): got {new[row.name]}'
            )


class FixedStepRobot(RobotInterface, ABC, Generic[S]):
    """What every robot that is computed has in common: its grid of time, its guard, its reports.

    Time runs on a fixed grid that starts at the first instant it hears of. States are reported
    once per control period; a command takes effect at the integration step in which it arrives.
    What comes out depends on the settings and the calls alone: equal runs are equal bit for bit.

    Parameters
    ----------
    settings
        The whole table of the robot.
    rate
        Reports per second.
    substeps
        Integration steps between two reports.
    longest_gap
        Time (s) that is made up for when nobody asked; what is longer is skipped.
    guard
        Decides what reaches the wheels.
    """

    def __init__(
        self, parameters: S, rate: float, substeps: int, longest_gap: float, guard: CommandLimiter
    ) -> None:
        self._parameters = parameters
        self._limiter = guard
        self._substeps = substeps
        self._longest_gap_ns = round(longest_gap * NANOSECONDS)
        # A ratio of whole numbers: stamps stay exact however long the robot runs.
        frequency = Fraction(rate) * substeps / NANOSECONDS
        self._top, self._bottom = frequency.as_integer_ratio()
        self._origin_ns: int | None = None
        self._steps_since_origin = 0
        """Integration steps since the origin of the grid."""
        self._reached_ns = 0
        self._reports: deque[RobotState] = deque(maxlen=1024)
        """The newest, and older ones that nobody has asked for."""

    # -- what a robot has of its own --------------------------------------------------------------

    @abstractmethod
    def _apply_parameters(self) -> None:
        """Let every part use the settings in force."""

    @abstractmethod
    def _integrate(self, count: int) -> None:
        """Run ``count`` integration steps from :meth:`_now_ns` on."""

    @abstractmethod
    def _measure(self) -> None:
        """Measure at the end of a period, and draw what disturbs the next one."""

    @abstractmethod
    def _make_state(self, stamp_ns: int) -> RobotState:
        """Return the state as last measured."""

    @abstractmethod
    def _moving(self) -> bool:
        """Return whether the wheels turn."""

    @abstractmethod
    def _reset_odometry(self) -> None:
        """Let dead reckoning start at the origin."""

    # -- the seam ---------------------------------------------------------------------------------

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from now on; return why not if it is refused."""
        return self._limiter.accept(command, self._run_to(now_ns))

    def advance(self, now_ns: int) -> RobotState:
        """Return the state at the last point of the grid that is not later than ``now_ns``."""
        self._run_to(now_ns, whole_periods=True)
        reports = self._reports
        while len(reports) > 1 and reports[1].stamp_ns <= now_ns:
            reports.popleft()
        return reports[0]

    def stop(self, reason: str, now_ns: int) -> None:
        """Come to rest; the next command moves the robot again."""
        self._limiter.stop(reason, self._run_to(now_ns))

    def reset_odometry(self, now_ns: int) -> str:
        """Let dead reckoning start at the origin; refused while the robot moves."""
        self._run_to(now_ns)
        if self._moving():
            return 'odometry cannot be reset while the robot moves'
        self._reset_odometry()
        self._refresh_state()
        return ''

    def latch_estop(self, reason: str, now_ns: int) -> None:
        """Come to rest, and stay so until :meth:`release_estop`."""
        self._limiter.latch(reason, self._run_to(now_ns))

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop; the robot then waits for a new command."""
        return self._limiter.release(self._run_to(now_ns))

    # -- only where time is computed --------------------------------------------------------------

    @property
    def parameters(self) -> S:
        """The table in force."""
        return self._parameters

    def configure(self, parameters: S) -> None:
        """Go on with other settings, a heavier load say.

        Raises
        ------
        ParameterError
            A setting differs that is fixed once the robot is made.
        """
        check_read_only(self._parameters, parameters)
        self._parameters = parameters
        self._apply_parameters()

    @property
    def state(self) -> RobotState:
        """The state last reported."""
        return self._reports[-1]

    def step(self, wheels: WheelSpeeds = ZERO_WHEEL_SPEEDS) -> RobotState:
        """Command ``wheels`` now and return the state one control period later.

        For closed loops without a clock: the robot's own grid is the time.
        """
        now_ns = self._now_ns()
        self.apply(RobotCommand(wheels, now_ns), now_ns)
        return self._advance_period()

    # -- inside -----------------------------------------------------------------------------------

    def _advance_period(self) -> RobotState:
        return self.advance(self._after(self._steps_since_origin + self._substeps))

    def _refresh_state(self) -> None:
        self._reports[-1] = self._make_state(self._reports[-1].stamp_ns)

    def _now_ns(self) -> int:
        """Return the time of the last finished substep."""
        return self._reached_ns

    def _after(self, steps: int) -> int:
        """Return the instant (ns) that lies ``steps`` integration steps after the origin."""
        top = self._top
        return (self._origin_ns or 0) + (2 * steps * self._bottom + top) // (2 * top)

    def _steps_until(self, wait_ns: int) -> int:
        """Return how many integration steps cover ``wait_ns``."""
        return -(-wait_ns * self._top // self._bottom)

    def _run_to(self, now_ns: int, whole_periods: bool = False) -> int:
        """Integrate up to ``now_ns`` and return the instant reached, within a step before it.

        Reports are made on the way. A clock that went back to before the state last handed out,
        or that left the longest gap behind, starts a new grid. One that went back by less is a
        late question for a report that was made already.
        """
        if now_ns == self._reached_ns and self._origin_ns is not None:
            return now_ns
        latest_ns = self._reached_ns + self._longest_gap_ns
        if self._origin_ns is None:
            self._reports.clear()
            self._start_grid(now_ns)
        elif now_ns < self._reports[0].stamp_ns:
            self._limiter.stop(CLOCK_JUMPED_BACK, now_ns)
            self._reports.clear()
            self._start_grid(now_ns)
        elif now_ns > latest_ns:
            self._integrate_to(latest_ns, whole_periods)
            self._start_grid(now_ns)
        else:
            self._integrate_to(now_ns, whole_periods)
        return self._reached_ns

    def _start_grid(self, now_ns: int) -> None:
        self._origin_ns = now_ns
        self._steps_since_origin = 0
        self._reached_ns = now_ns
        self._make_report()

    def _integrate_to(self, now_ns: int, whole_periods: bool) -> None:
        substeps = self._substeps
        # Half a nanosecond more, because stamps are rounded to whole ones.
        elapsed = 2 * (now_ns - (self._origin_ns or 0)) + 1
        goal = elapsed * self._top // (2 * self._bottom)
        if whole_periods:
            goal -= goal % substeps
        while self._steps_since_origin < goal:
            count = min(
                substeps - self._steps_since_origin % substeps, goal - self._steps_since_origin
            )
            self._integrate(count)
            self._steps_since_origin += count
            self._reached_ns = self._after(self._steps_since_origin)
            if self._steps_since_origin % substeps == 0:
                self._make_report()

    def _make_report(self) -> None:
        self._measure()
        self._reports.append(self._make_state(self._reached_ns))
