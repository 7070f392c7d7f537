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
"""Reachable reference across the jumps of the reference."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.kernels import TypedKernel, contiguous, kernel
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class JumpTransitionParameters(Parameters):
    """Treatment of the jumps of the reference."""

    preview: bool = parameter(
        True,
        'whether the transition of a jump that is known in advance starts before the jump; false: '
        'the reference is known up to the present only and is extrapolated by its slope',
        dynamic=True,
    )
    method: str = parameter(
        'ramp',
        'ramp: the law follows a ramp across the jump; predictive: the law follows the jump '
        'itself, which enters Psi_free as a known disturbance, and v_p acts within its bound',
        choices=('ramp', 'predictive'),
    )
    acceleration: float = parameter(
        30.0,
        'acceleration of the ramp: at most the acceleration limit of a wheel; a torque drive '
        'crosses with what its motors have for the direction of the jump instead',
        'rad/s²',
        (1.0, 1e4),
        dynamic=True,
    )


def in_one_direction(jump: Array, time: float) -> Array:
    """Return the accelerations with which both wheels cross a jump in one time (s), rad/s².

    The body keeps one direction then. A wheel that hardly jumps may be a little faster than
    that, since it is soon across.
    """
    alike = np.abs(jump) / time
    found: Array = np.maximum(alike, 0.25 * alike.max())
    return found


class MotorLimit(NamedTuple):
    """What the motors of a torque drive have for a jump."""

    inertia: Array  # theta_bar of (11), kg m², shape (2, 2)
    torque: float  # largest torque of a wheel, N m

    def accelerations(self, jump: Array) -> Array:
        r"""Return the largest accelerations for a jump (rad/s), rad/s², shape (2,), positive.

        Both wheels cross in the same time t, so that the body keeps one direction:

        .. math:: t = \max_i |(\bar\theta J)_i| / \tau, \qquad a_i = |J_i| / t

        Two wheels that turn the body need more torque for the same acceleration than two that
        push it.
        """
        needed = float(np.max(np.abs(self.inertia @ jump))) / self.torque
        return in_one_direction(jump, needed) if needed > 0.0 else np.full(2, math.nan)


ALMOST = 0.9
"""Share of the acceleration of the ramp from which a limit of the command does not shape it."""


class CommandLimit(NamedTuple):
    """Acceleration limits of the command, rad/s², all positive.

    A ramp that is steeper than the command may be begins too late, and ends late. The wheels
    cross together, as with :class:`MotorLimit`.
    """

    mean: float  # of the mean of both wheels
    half: float  # of half of their difference
    wheel: float  # of each wheel
    ramp: float  # acceleration of the ramp by the parameter

    def accelerations(self, jump: Array) -> Array:
        """Return those for a jump (rad/s), rad/s², shape (2,); NaN where they limit nothing."""
        right, left = jump.tolist()
        most = max(abs(right), abs(left))
        time = max(
            0.5 * abs(right + left) / self.mean,
            0.5 * abs(right - left) / self.half,
            most / self.wheel,
        )
        if most >= ALMOST * self.ramp * time:
            return np.full(2, math.nan)
        return in_one_direction(jump, time)


class JumpTransition:
    r"""Computes rbar = r + h, a reference that the wheels can reach, around the jumps of r.

    Assumption 3 of the paper, a reachable reference, does not hold at a jump of r. The law
    follows rbar instead: all of (66)-(84) then holds for chi - rbar, and the adaptation does not
    learn the jump as an estimation error.

    A wheel with bounded acceleration a crosses a jump J with the least squared error if it
    departs from the old reference before the jump. With the relative accelerations
    a_1 = a - s r' before and a_2 after the jump (s the sign of J), the integral of the squared
    error is x³/(3 a_1) + (|J| - x)³/(3 a_2), where x is the distance covered before the jump. Its
    minimum is at

    .. math:: x = |J| \sqrt{a_1} / (\sqrt{a_1} + \sqrt{a_2}),

    half of J if the slopes are equal; the squared error is then a quarter of the one of a
    transition that starts at the jump. The transition of a jump that becomes known later starts
    at once. The *command* crosses with a, one servo lag in advance, and rbar is the response of
    the servo to it.

    ``lag`` (s) is the time constant of the servo, 0 for a torque drive. ``limit`` determines
    the ramps where it has an answer. ``period`` is that of control, s.
    """

    def __init__(
        self,
        parameters: JumpTransitionParameters,
        lag: float,
        period: float,
        limit: MotorLimit | CommandLimit | None = None,
    ) -> None:
        self.parameters = parameters
        self.limit = limit  # what limits the ramps of the next jumps
        self._lag = lag
        self._period = period
        self.count = 0  # number of unfinished transitions; without one rbar is r
        rows, instants = np.zeros((4, 8, 2)), np.zeros(8, dtype=np.int64)
        self._transitions = Transitions._make((*rows, instants, np.zeros(8, dtype=np.bool_)))
        self.plan = Plan(*np.zeros((7, 2)))  # results of the last step
        self.reachable, self.rate = self.plan[:2]
        self._step_transitions = TypedKernel(step_transitions)

    def reset(self) -> None:
        """Discard all jumps: rbar is r."""
        self.count = 0
        for values in self.plan[2:]:
            values[:] = 0.0

    def future_jumps(self, now_ns: int, span: float, rows: int) -> Array:
        """Return the future jumps of delta = chi - r, shape (rows, 2), rad/s.

        Row j holds the jumps between ``now_ns`` + j span and + (j + 1) span (s), for Psi_free
        (56) in :meth:`t3mpc_ros.mpc.predictive_controller.PredictiveController.step`.
        """
        change = np.zeros((rows, 2))
        for k in range(self.count):
            ahead = (int(self._transitions.instants[k]) - now_ns) / NANOSECONDS
            row = math.ceil(ahead / span - 1e-9) - 1
            if 0 <= row < rows:
                change[row] -= self._transitions.jumps[k]
        return change

    def pop_passed(self, now_ns: int) -> Array:
        """Remove the jumps up to ``now_ns`` and return their sum, rad/s, shape (2,)."""
        total = np.zeros(2)
        for k in reversed(range(self.count)):
            if self._transitions.instants[k] <= now_ns:
                total += self._transitions.jumps[k]
                for rows in self._transitions:
                    rows[k : self.count - 1] = rows[k + 1 : self.count].copy()
                self.count -= 1
        return total

    def announce(self, instant_ns: int, jump: Array, slope_after: Array) -> None:
        """Add a jump of r (rad/s), past or future, after which r' is ``slope_after`` (rad/s²)."""
        k = self.count
        if k == len(self._transitions.instants):
            longer = (np.concatenate((rows, np.zeros_like(rows))) for rows in self._transitions)
            self._transitions = Transitions._make(longer)
        ramp = (math.nan, math.nan) if self.limit is None else self.limit.accelerations(jump)
        added = (jump, slope_after, 0.0, ramp, instant_ns, False)
        for rows, value in zip(self._transitions, added, strict=True):
            rows[k] = value
        self.count += 1

    def withdraw(self, instant_ns: int) -> None:
        """Cancel the jumps announced for ``instant_ns`` or later."""
        known = self._transitions
        for k in range(self.count):
            if not known.passed[k] and known.instants[k] >= instant_ns:
                known.jumps[k] = 0.0
                known.instants[k] = instant_ns
                known.passed[k] = True

    def step(
        self, now_ns: int, reference: Array, reference_next: Array, share: float = 1.0
    ) -> None:
        """Update :attr:`plan` for the period that starts when the next command takes effect.

        reference, reference_next : r then and one period later, with its jumps, rad/s, shape (2,)
        share : time since the last step, in periods, at most 1
        """
        self.count = self._step_transitions(
            self._transitions,
            self.count,
            now_ns,
            contiguous(reference),
            contiguous(reference_next),
            self._period,
            share,
            self._lag,
            self.parameters.acceleration,
            self.plan,
        )


class Transitions(NamedTuple):
    """Jumps that are known, for kernels; the first ``count`` rows are valid."""

    jumps: Array  # change of r, rad/s, shape (n, 2)
    slopes_after: Array  # r' after the jump, rad/s², shape (n, 2)
    covered: Array  # commanded part of the jump, rad/s, shape (n, 2)
    accelerations: Array  # of the ramp where a limit determines it, else NaN, rad/s², shape (n, 2)
    instants: NDArray[np.int64]  # when r jumps, ns, shape (n,)
    passed: NDArray[np.bool_]  # whether it has, shape (n,)


class Plan(NamedTuple):
    """Results of :func:`step_transitions`, shape (2,) each; rad/s but for the rate."""

    reachable: Array  # rbar now
    rate: Array  # its derivative until the next step, rad/s²
    response: Array  # response of the servo to the commanded parts of all jumps, one period later
    response_now: Array  # the same now
    passed: Array  # sum of the jumps that r has made
    offset: Array  # h now
    offset_next: Array  # h one period later


@kernel
def step_transitions(
    transitions: Transitions,
    count: int,
    now_ns: int,
    reference: Array,
    reference_next: Array,
    period: float,
    share: float,
    lag: float,
    acceleration: float,
    plan: Plan,
) -> int:
    """Update h for the period that starts at ``now_ns``; return the number of transitions left."""
    jumps, instants, passed = transitions.jumps, transitions.instants, transitions.passed
    if count > 0:
        keep = math.exp(-period / lag) if lag > 0.0 else 0.0
        kept = math.exp(-share * period / lag) if lag > 0.0 else 0.0
        until_ns = now_ns + round(period * NANOSECONDS)
        # The command precedes the response of the servo; and the sampled r jumps within the
        # period before the instant, on average in its middle.
        lead = period * (keep / (1.0 - keep) + 0.5)
        mark_passed(transitions, count, plan, now_ns)
        for i in range(2):
            before = (1.0 - share) * plan.response_now[i] + share * plan.response[i]
            plan.response_now[i] = before
            plan.offset[i] = before - plan.passed[i]
            rise, passed_next = reference_next[i] - reference[i], plan.passed[i]
            for k in range(count):
                if not passed[k] and until_ns >= instants[k]:
                    rise -= jumps[k, i]
                    passed_next += jumps[k, i]
            commanded = 0.0
            for k in range(count):
                left = (instants[k] - now_ns) / NANOSECONDS - lead
                advance(transitions, k, i, left, rise / period, period, share, acceleration)
                commanded += transitions.covered[k, i]
            plan.response[i] += (1.0 - kept) * (commanded - plan.response[i])
            plan.offset_next[i] = plan.response[i] - passed_next
        # After 30 lags the remaining response is below rounding.
        over_ns = now_ns - round(30.0 * lag * NANOSECONDS)
        count = remove_finished(transitions, count, plan, over_ns)
    else:
        plan.offset[:] = 0.0
        plan.offset_next[:] = 0.0
    for i in range(2):
        plan.reachable[i] = reference[i] + plan.offset[i]
        after = reference_next[i] + plan.offset_next[i]
        plan.rate[i] = (after - plan.reachable[i]) / period
    return count


@kernel
def mark_passed(transitions: Transitions, count: int, plan: Plan, now_ns: int) -> None:
    """Add each jump to the passed ones once its instant is reached."""
    for k in range(count):
        if not transitions.passed[k] and now_ns >= transitions.instants[k]:
            transitions.passed[k] = True
            for i in range(2):
                plan.passed[i] += transitions.jumps[k, i]


@kernel
def advance(
    transitions: Transitions,
    k: int,
    i: int,
    left: float,
    slope: float,
    period: float,
    share: float,
    acceleration: float,
) -> None:
    """Advance the ramp of jump ``k`` and wheel ``i`` by a share of a period after its start.

    ``left`` (s): time until the jump, less the lead of the command; ``slope``: r' without the jump
    """
    size = abs(transitions.jumps[k, i])
    rest = transitions.jumps[k, i] - transitions.covered[k, i]
    if rest == 0.0:
        return
    sign = math.copysign(1.0, rest)
    if not math.isnan(transitions.accelerations[k, i]):
        acceleration = transitions.accelerations[k, i]
    after = max(acceleration - sign * transitions.slopes_after[k, i], 0.2 * acceleration)
    before = after
    if not transitions.passed[k]:
        before = max(acceleration - sign * slope, 0.2 * acceleration)
    fraction = math.sqrt(before) / (math.sqrt(before) + math.sqrt(after))
    # The first step is a fraction of a period: the ramp starts at its instant, not at a sample.
    time = min(fraction * size / before - left + period, share * period)
    if time > 0.0:
        transitions.covered[k, i] += sign * min(before * time, abs(rest))


@kernel
def remove_finished(transitions: Transitions, count: int, plan: Plan, over_ns: int) -> int:
    """Remove the transitions finished since ``over_ns``; return the number of the others."""
    jumps, slopes, covered, accelerations, instants, passed = transitions
    kept = 0
    for k in range(count):
        done = passed[k] and instants[k] <= over_ns
        for i in range(2):
            done = done and covered[k, i] == jumps[k, i]
        for i in range(2):
            if done:
                plan.response[i] -= jumps[k, i]
                plan.response_now[i] -= jumps[k, i]
                plan.passed[i] -= jumps[k, i]
            else:
                jumps[kept, i], slopes[kept, i] = jumps[k, i], slopes[k, i]
                covered[kept, i], accelerations[kept, i] = covered[k, i], accelerations[k, i]
        if not done:
            instants[kept], passed[kept] = instants[k], passed[k]
            kept += 1
    return kept
