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
"""Fixed-step robot: base class of the simulated robots, integrated on a fixed time grid."""

from abc import ABC, abstractmethod
from collections import deque
from fractions import Fraction
from typing import TYPE_CHECKING, Generic, TypeVar

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.robot.command_limiter import CLOCK_JUMPED_BACK, CommandLimiter
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand, RobotInterface, RobotState

if TYPE_CHECKING:  # its robot is one of this kind
    from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

S = TypeVar('S', bound='PaperRobotParameters')


class FixedStepRobot(RobotInterface, ABC, Generic[S]):
    """Base of the simulated robots: time grid, command limiter and reported states.

    The time grid starts at the first instant passed to any method. States are reported once
    per control period; a command takes effect at the integration step in which it arrives. The
    states depend on the parameters and the calls alone: equal runs are bit-equal.
    """

    def __init__(self, parameters: S) -> None:
        self._parameters = parameters
        self._limiter = CommandLimiter(parameters.limiter, parameters.geometry)
        self._substeps = substeps = parameters.substeps
        self._max_catch_up_ns = round(parameters.max_catch_up_time * NANOSECONDS)
        # A ratio of integers keeps the stamps exact however long the robot runs.
        frequency = Fraction(parameters.rate) * substeps / NANOSECONDS
        self._top, self._bottom = frequency.as_integer_ratio()
        self._origin_ns: int | None = None
        self._steps_since_origin = 0  # integration steps since the origin of the time grid
        self._reached_ns = 0  # time of the last finished substep
        self._reports: deque[RobotState] = deque(maxlen=1024)
        """The newest state, and older ones that were not requested yet."""

    # -- implemented by each robot ----------------------------------------------------------------

    @abstractmethod
    def _apply_parameters(self) -> None:
        """Pass the current parameters to every component."""

    @abstractmethod
    def _integrate(self, count: int) -> None:
        """Run ``count`` integration steps from :attr:`_reached_ns` on."""

    @abstractmethod
    def _measure(self) -> None:
        """Measure at the end of a period, and draw the disturbance of the next one."""

    @abstractmethod
    def _make_state(self, stamp_ns: int) -> RobotState:
        """Return the last measured state."""

    @abstractmethod
    def _moving(self) -> bool:
        """Return whether the wheels turn."""

    @abstractmethod
    def _reset_odometry(self) -> None:
        """Set the odometry pose to the origin."""

    # -- robot interface --------------------------------------------------------------------------

    def apply(self, command: RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from now on, or return why it is rejected."""
        return self._limiter.accept(command, self._run_to(now_ns))

    def advance(self, now_ns: int) -> RobotState:
        """Integrate up to ``now_ns``; return the state at the last instant of the time grid."""
        self._run_to(now_ns, whole_periods=True)
        reports = self._reports
        while len(reports) > 1 and reports[1].stamp_ns <= now_ns:
            reports.popleft()
        return reports[0]

    def stop(self, reason: str, now_ns: int) -> None:
        """Stop; the next command moves the robot again."""
        self._limiter.stop(reason, self._run_to(now_ns))

    def reset_odometry(self, now_ns: int) -> str:
        """Set the odometry pose to the origin; rejected while the robot moves."""
        self._run_to(now_ns)
        if self._moving():
            return 'odometry cannot be reset while the robot moves'
        self._reset_odometry()
        self._refresh_state()
        return ''

    def latch_estop(self, reason: str, now_ns: int) -> str:
        """Stop until :meth:`release_estop`; the robot has it at once."""
        self._limiter.latch(reason, self._run_to(now_ns))
        return ''

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop; the robot then waits for a new command."""
        return self._limiter.release(self._run_to(now_ns))

    # -- simulation only --------------------------------------------------------------------------

    @property
    def parameters(self) -> S:
        """The parameters in use."""
        return self._parameters

    def configure(self, parameters: S) -> None:
        """Continue with other parameters, for example a heavier load."""
        self._parameters.check_read_only(parameters)
        self._parameters = parameters
        self._apply_parameters()

    @property
    def state(self) -> RobotState:
        """The last reported state."""
        return self._reports[-1]

    def step(self, wheels: WheelSpeeds = ZERO_WHEEL_SPEEDS) -> RobotState:
        """Command ``wheels`` now and return the state one control period later.

        For closed loops without a clock, on the time grid of the robot.
        """
        now_ns = self._reached_ns
        self.apply(RobotCommand(wheels, now_ns), now_ns)
        return self._advance_period()

    # -- time grid --------------------------------------------------------------------------------

    def _advance_period(self) -> RobotState:
        return self.advance(self._stamp_after(self._steps_since_origin + self._substeps))

    def _refresh_state(self) -> None:
        self._reports[-1] = self._make_state(self._reports[-1].stamp_ns)

    def _stamp_after(self, steps: int) -> int:
        """Return the instant (ns) that lies ``steps`` integration steps after the origin."""
        top = self._top
        return (self._origin_ns or 0) + (2 * steps * self._bottom + top) // (2 * top)

    def _steps_until(self, wait_ns: int) -> int:
        """Return how many integration steps cover ``wait_ns``."""
        return -(-wait_ns * self._top // self._bottom)

    def _run_to(self, now_ns: int, whole_periods: bool = False) -> int:
        """Integrate up to ``now_ns`` and return the instant reached, within a step before it.

        States are reported on the way. A clock that jumps back before the last returned state, or
        ahead by more than the maximum catch-up time, starts a new time grid. A smaller step back
        is a late request for a state that is already reported.
        """
        if now_ns == self._reached_ns and self._origin_ns is not None:
            return now_ns
        latest_ns = self._reached_ns + self._max_catch_up_ns
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
        self._report_state()

    def _integrate_to(self, now_ns: int, whole_periods: bool) -> None:
        substeps = self._substeps
        # Half a nanosecond more, because stamps are rounded to whole nanoseconds.
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
            self._reached_ns = self._stamp_after(self._steps_since_origin)
            if self._steps_since_origin % substeps == 0:
                self._report_state()

    def _report_state(self) -> None:
        self._measure()
        self._reports.append(self._make_state(self._reached_ns))
