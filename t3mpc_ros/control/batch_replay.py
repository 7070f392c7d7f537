# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compiled replay of many controller steps of a recorded run.

:func:`replay_batch` gives the results of :meth:`Controller.step` to the last bit. It runs regular
steps (the robot follows a reference without jumps) in a compiled loop over the kernels of a
single step; all other steps run in the controller. The module works on the internals of
:class:`Controller`.
"""

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.actuation import VelocityActuation, actuation_command
from t3mpc_ros.control.control_law import (
    BOUND,
    RATE,
    TERM_NAMES,
    VALUE,
    set_applied_term,
    step_law,
)
from t3mpc_ros.control.controller import Controller, Status, SwitchingTracker, sample_reference
from t3mpc_ros.control.jump_transition import step_transitions
from t3mpc_ros.control.speed_filter import PREDICTED, SPEEDS, update_filter
from t3mpc_ros.control.watchdog import InputWatchdog, Reason, ResponseMonitor, WatchdogParameters
from t3mpc_ros.geometry import kinematics
from t3mpc_ros.geometry.trajectory import ReferenceTrajectory, write_sample
from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist, StateArray
from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.predictive_controller import accumulate_sample, predictive_step, signals_view

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Flags = NDArray[np.bool_]
Messages = tuple[Stamps, Array, Flags]
"""Stamps (ns), twists (m/s, rad/s; shape (n, 2)), and whether every number is finite."""

NEVER = int(np.iinfo(np.int64).max)

TWIST, ERROR, SKILL, APPLIED, TERMS, CERTIFICATE, COMMAND, LIMITED = 0, 2, 4, 6, 8, 18, 22, 24
"""First columns of the quantities in a row of results; LIMITED is a single column."""
WIDTH = 25


class StepResults(NamedTuple):
    """Twist and status of each step, NaN where there is none."""

    numbers: Array
    """Shape (n, WIDTH), columns from TWIST to LIMITED."""
    reasons: NDArray[np.object_]
    """:class:`Reason` of each step, None where there is none, shape (n,)."""

    @classmethod
    def empty(cls, count: int) -> Self:
        """Return ``count`` empty rows."""
        return cls(np.full((count, WIDTH), math.nan), np.full(count, None, dtype=np.object_))

    def part(self, begin: int, end: int) -> 'StepResults':
        """Return a view of some of the rows."""
        return StepResults(self.numbers[begin:end], self.reasons[begin:end])

    def set_row(self, row: int, twist: BodyTwist, status: Status) -> None:
        """Write the result of :meth:`Controller.step` into a row."""
        self.numbers[row] = (
            *twist,
            *status.error.tolist(),
            *status.skill.tolist(),
            *status.applied.tolist(),
            *status.terms.ravel().tolist(),
            *status.certificate_state.tolist(),
            math.nan,
            math.nan,
            float(status.limited),
        )
        self.reasons[row] = status.reason

    def set_tracking(self, begin: int, end: int) -> None:
        """Set the reason of some rows to TRACKING."""
        self.reasons[begin:end] = Reason.TRACKING

    @property
    def twists(self) -> Array:
        """Commanded twists, m/s and rad/s, shape (n, 2)."""
        return self.numbers[:, TWIST : TWIST + 2]

    @property
    def pairs(self) -> dict[str, Array]:
        """Quantities of both wheels by name, shape (n, 2), as in :class:`Status`."""
        numbers = self.numbers
        found = {
            'error': numbers[:, ERROR : ERROR + 2],
            'skill': numbers[:, SKILL : SKILL + 2],
            'applied': numbers[:, APPLIED : APPLIED + 2],
            'estimate': 0.0 - numbers[:, TERMS : TERMS + 2],
        }
        for k, name in enumerate(TERM_NAMES):
            found[name] = numbers[:, TERMS + 2 * k : TERMS + 2 * k + 2]
        return found

    @property
    def certificate(self) -> Array:
        """Value and margin of the certificate, see :class:`CertificateReading`, shape (n, 2)."""
        state = self.numbers[:, CERTIFICATE:]
        return np.stack([state[:, VALUE], state[:, BOUND] - state[:, RATE]], axis=1)

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Whether a limit changed the command, shape (n,)."""
        return np.equal(self.numbers[:, LIMITED], 1.0)


def replay_batch(
    controller: Controller,
    odometry: StateArray,
    references: StateArray,
    rows: Stamps,
    results: StepResults,
) -> int:
    """Run many steps of a recorded run; return the number of regular steps among them.

    The results equal those of :meth:`Controller.add_reference` and :meth:`Controller.step` to the
    last bit. The first call compiles.

    Parameters
    ----------
    controller
        Its state changes as in single steps.
    odometry, references
        Messages of the run.
    rows
        For each step the index of its odometry, and the range of references added before it,
        shape (n, 3).
    results
        Its n rows are overwritten.

    Raises
    ------
    ValueError
        A number is infinite or NaN; the controller cannot be used further.
    """
    k = regular = 0
    while k < len(rows):
        done, added = _replay_regular(controller, odometry, references, rows, k, results)
        k, regular = k + done, regular + done
        if k == len(rows):
            break
        received, begin, end = rows[k].tolist()
        for j in range(max(begin, added), end):
            controller.add_reference(references[j])
        results.set_row(k, *controller.step(odometry[received]))
        k += 1
    return regular


def _replay_regular(
    controller: Controller,
    odometry: StateArray,
    references: StateArray,
    rows: Stamps,
    first: int,
    results: StepResults,
) -> tuple[int, int]:
    """Run regular steps from a row on; return their number and the end of the added references."""
    added, transition = int(rows[first, 1]), controller.parameters.jump_transition
    announced, dead_time_ns = controller._announced, controller._dead_time_ns
    jumps = {jump.stamp_ns for jump in controller._jumps}
    parts = ControllerParts(
        controller._trajectory,
        controller._tracker,
        controller._actuation,
        controller._watchdog,
        controller._response,
        (
            controller._speeds,
            controller._reference,
            controller._reference_begin,
            controller._reference_end,
        ),
        controller._sampling,
    )
    if not (
        controller._moving
        and controller.status.reason is Reason.TRACKING
        and controller._last_stamp_ns is not None
        and transition.method == 'ramp'
        and announced <= jumps
        # With preview, a jump that is not announced yet waits for the sample after it.
        and (announced == jumps or not transition.preview)
        and parts.regular
    ):
        return 0, added
    # An announced jump ends when a command takes effect after it; others start when they occur.
    due_ns = min((t + dead_time_ns * (t not in announced) for t in jumps), default=NEVER)
    times = controller._last_stamp_ns, dead_time_ns, due_ns
    watchdog = controller.parameters.watchdog
    steps = BatchStepper(parts, watchdog, odometry, references, added, *times)
    k = until = first
    while k == until < len(rows):
        until = min(len(rows), k + controller._snapshot_steps - controller._steps_since_snapshot)
        done = steps.run(rows, k, until, results.numbers)
        k += done
        controller._take_snapshot(done)
    numbers = results.numbers[first:k]
    steps.finish(numbers)
    if len(numbers):
        results.set_tracking(first, k)
        controller._last_stamp_ns = steps.last_ns
        error, applied = numbers[-1, ERROR:][:2].copy(), numbers[-1, APPLIED:][:2].copy()
        controller.status = controller._make_status(steps.last_ns, Reason.TRACKING, error, applied)
    return len(numbers), steps.added


class ControllerParts(NamedTuple):
    """Parts of a controller that change in a regular step, and its constants."""

    trajectory: ReferenceTrajectory
    tracker: SwitchingTracker
    actuation: VelocityActuation
    watchdog: InputWatchdog
    response: ResponseMonitor
    samples: tuple[Array, Array, Array, Array]
    """Output arrays of :func:`sample_reference`."""
    sampling: tuple[float, float, bool, float, float]
    """Parameters of :func:`sample_reference`."""

    @property
    def regular(self) -> bool:
        """Whether the state of these parts permits a regular step."""
        response, actuation = self.response, self.actuation
        newest = response.last_command
        return (
            self.trajectory.end > self.trajectory.first
            and not self.watchdog.holding
            and self.watchdog.last_reference[0] is not None
            and response.responsive
            and newest is not None
            # A replay may have set other commands.
            and newest == tuple(actuation.command.tolist())
            and not self.tracker.law.predictive.dithered
        )


class BatchStepper:
    """Runs regular steps on the arrays of a controller.

    Parameters
    ----------
    parts
        Parts of the controller, which are out of date until :meth:`finish`.
    parameters
        Time-outs and bounds.
    odometry, references
        Messages of the run.
    added
        Number of references added so far.
    last_ns
        Stamp of the last odometry.
    dead_time_ns
        Time from an odometry stamp to the instant at which its command takes effect.
    due_ns
        Instant of the next announced jump of the reference; NEVER without one.
    """

    def __init__(
        self,
        parts: ControllerParts,
        parameters: WatchdogParameters,
        odometry: StateArray,
        references: StateArray,
        added: int,
        last_ns: int,
        dead_time_ns: int,
        due_ns: int,
    ) -> None:
        self._parts = parts
        trajectory, law = parts.trajectory, parts.tracker.law
        transition = parts.tracker.transition
        reference_ns, pending = parts.watchdog.last_reference
        commands, evidence = parts.response.counts
        state: Stamps = np.zeros(STATE_SIZE, dtype=np.int64)
        state[TRAJECTORY_FIRST], state[TRAJECTORY_END] = trajectory.first, trajectory.end
        state[TRANSITIONS] = transition.count
        state[PHASE], state[SAMPLES] = law.predictive.phase, law.predictive.samples
        state[LAST_NS], state[REFERENCE_NS], state[PENDING] = last_ns, reference_ns or 0, pending
        state[SATURATED], state[EVIDENCE], state[COMMANDS] = law.saturated, evidence, commands
        state[REFERENCES] = added
        self._state = state
        bounds = StepBounds(
            parameters.odometry_timeout,
            parameters.reference_timeout,
            parameters.speed_bound,
            parameters.error_bound,
            parameters.response_bound,
            parts.response.window,
            dead_time_ns,
            due_ns,
        )
        # Plain tuples: a call unpacks them much faster than named ones.
        self._arguments = (
            (odometry.stamps_ns, odometry.twists, odometry.finite),
            (references.stamps_ns, references.twists, references.finite),
            tuple(bounds),
            (trajectory.stamps, trajectory.samples, trajectory.jump, trajectory.capacity),
            parts.sampling,
            parts.samples,
            parts.actuation.speed_filter.kernel_arguments,
            transition.kernel_arguments,
            law.predictive.tables,
            law.kernel_arguments,
            parts.actuation.kernel_arguments,
        )

    @property
    def added(self) -> int:
        """Number of references added so far."""
        return int(self._state[REFERENCES])

    @property
    def last_ns(self) -> int:
        """Stamp of the odometry of the last step."""
        return int(self._state[LAST_NS])

    def run(self, rows: Stamps, first: int, until: int, results: Array) -> int:
        """Return the number of regular steps run from ``first`` on, see :func:`replay_steps`.

        Raises
        ------
        ValueError
            A number of the estimate or of the law is not finite.
        """
        done = replay_steps(rows, first, until, self._state, *self._arguments, results)
        if self._state[FAILED]:
            raise ValueError('speeds, errors and accelerations must be finite: got inf or nan')
        return done

    def finish(self, results: Array) -> None:
        """Write the state back to the parts, given the result rows of all steps."""
        parts, state = self._parts, self._state.tolist()
        law = parts.tracker.law
        parts.trajectory.synchronize(state[TRAJECTORY_FIRST], state[TRAJECTORY_END])
        parts.watchdog.synchronize(
            state[LAST_NS], state[REFERENCE_NS], pending=bool(state[PENDING])
        )
        if len(results):
            parts.tracker.transition.count = state[TRANSITIONS]
            law.predictive.synchronize(state[PHASE], state[SAMPLES])
            law.saturated = bool(state[SATURATED])
            parts.response.synchronize(results[:, COMMAND : COMMAND + 2], state[EVIDENCE])
            parts.actuation.limited = bool(results[-1, LIMITED])


# -- compiled loop ------------------------------------------------------------------------------

(
    TRAJECTORY_FIRST,
    TRAJECTORY_END,
    TRANSITIONS,
    PHASE,
    SAMPLES,
    LAST_NS,
    REFERENCE_NS,
    PENDING,
    SATURATED,
    EVIDENCE,
    COMMANDS,
    REFERENCES,
    FAILED,
) = range(13)
"""Elements of the integer state: that of the controller, the number of commands in the response
monitor, the number of references added, and whether a kernel rejected a number."""
STATE_SIZE = 13


class StepBounds(NamedTuple):
    """Bounds of a regular step."""

    odometry_timeout: float
    """s, as the next."""
    reference_timeout: float
    speed: float
    """Of a measured wheel, rad/s, as the next two."""
    error: float
    response: float
    """Distance from the last command; 0 disables the check."""
    window: int
    """Number of commands from which the response is checked."""
    dead_time_ns: int
    """Time from an odometry stamp to the instant at which its command takes effect."""
    due_ns: int
    """Instant of the next jump of the reference; steps up to it are regular."""


body_speeds = kernel(kinematics.body_speeds)


@kernel
def replay_steps(
    rows: Stamps,
    first: int,
    until: int,
    state: Stamps,
    odometry: Messages,
    references: Messages,
    bounds: tuple[Any, ...],
    trajectory: tuple[Stamps, Array, Array, int],
    sampling: tuple[float, float, bool, float, float],
    wheel_samples: tuple[Array, Array, Array, Array],
    speed_filter: tuple[Any, ...],
    transition: tuple[Any, ...],
    predictive: tuple[Any, ...],
    law: tuple[Any, ...],
    actuation: tuple[Any, ...],
    results: Array,
) -> int:
    """Run the steps from ``first`` to before ``until`` or the first one that is not regular.

    Returns the number of steps. A step that is not regular is detected before any change.

    rows          : shape (n, 3), for each step the index of its odometry, and the range of
                    references added before it
    state         : integers, see TRAJECTORY_FIRST ... FAILED
    bounds        : as in :class:`StepBounds`
    trajectory    : stamps, samples, jump and capacity of the reference
    sampling      : parameters of :func:`sample_reference`
    wheel_samples : output arrays of :func:`sample_reference`
    speed_filter  : arguments of :func:`update_filter`
    transition    : arguments of :func:`step_transitions`
    predictive    : arguments of :func:`predictive_step`
    law           : arguments of :func:`step_law`
    actuation     : arguments of :func:`actuation_command`
    results       : shape (n, WIDTH), rows are overwritten
    """
    stamps, samples, jump, _ = trajectory
    speeds, reference, begin, end = wheel_samples
    filter_state, commands, enabled, gain, velocity, late, lag, period = speed_filter
    transitions, instants, passed, sums, transition_period, servo_lag = transition[:6]
    ramp_acceleration, reachable, rate = transition[6:]
    stores, sizes, signals, tables, nominal, decays, change, average, every = predictive[:9]
    decay, rules, how, numbers, whole, status = predictive[9:]
    gains, centres, nonsingleton_gain, sharpness, shares, grades, firings = law[:7]
    phi, coefficients, work, terms, total, certificate = law[7:]
    command, limits, command_period, command_gain, applied = actuation
    timeout, reference_timeout, speed_bound, error_bound, response, window, dead, due = bounds
    for k in range(first, until):
        # References before the range of the step are those that the controller did not receive.
        state[REFERENCES] = max(state[REFERENCES], rows[k, 1])
        if not add_references(rows[k, 2], state, references, trajectory):
            return k - first
        received = rows[k, 0]
        stamp = odometry[0][received]
        effect = stamp + dead
        elapsed = (stamp - state[LAST_NS]) / NANOSECONDS
        if elapsed <= 0.0 or elapsed > timeout or not odometry[2][received] or effect >= due:
            return k - first
        known, speed, error = sample_reference(
            stamps,
            samples,
            state[TRAJECTORY_FIRST],
            state[TRAJECTORY_END],
            jump,
            stamp,
            effect,
            sampling[0],
            sampling[1],
            sampling[2],
            sampling[3],
            sampling[4],
            odometry[1][received, 0],
            odometry[1][received, 1],
            speeds,
            reference,
            begin,
            end,
        )
        reference_ns = stamp if state[PENDING] != 0 else state[REFERENCE_NS]
        if not known or (stamp - reference_ns) / NANOSECONDS > reference_timeout:
            return k - first
        # Written so that NaN is not regular.
        if not (speed <= speed_bound and error <= error_bound):
            return k - first
        checked = response != 0.0 and state[COMMANDS] >= window
        distance = max(abs(speeds[0] - command[0]), abs(speeds[1] - command[1]))
        if checked and not distance <= response:
            return k - first

        state[LAST_NS], state[REFERENCE_NS], state[PENDING] = stamp, reference_ns, 0
        if checked:
            state[EVIDENCE] = 0
        update_filter(
            filter_state,
            commands,
            command,
            speeds,
            True,
            elapsed,
            enabled,
            gain,
            velocity,
            late,
            lag,
            period,
        )
        state[TRANSITIONS] = step_transitions(
            transitions,
            instants,
            passed,
            state[TRANSITIONS],
            sums,
            effect,
            begin,
            end,
            transition_period,
            servo_lag,
            ramp_acceleration,
            reachable,
            rate,
        )
        phase = state[PHASE]
        sampled = phase == 0 or phase > every - average
        state[FAILED] = 1
        if not accumulate_sample(
            filter_state[PREDICTED], reachable, sampled, phase == 0, decay, signals
        ):
            return k - first
        if phase == 0:
            predictive_step(
                stores,
                sizes,
                signals,
                tables,
                nominal,
                decays,
                change,
                state[SAMPLES],
                average,
                every,
                decay,
                rules,
                how,
                numbers,
                whole,
                status,
            )
            state[SAMPLES] += 1
        state[PHASE] = (phase + 1) % every
        if not step_law(
            filter_state[PREDICTED],
            reachable,
            rate,
            signals,
            elapsed,
            state[SATURATED] != 0,
            gains,
            centres,
            nonsingleton_gain,
            sharpness,
            shares,
            grades,
            firings,
            phi,
            coefficients,
            work,
            terms,
            total,
            certificate,
        ):
            return k - first
        limited = actuation_command(
            total, filter_state, command, limits, command_period, command_gain, applied
        )
        state[SATURATED] = 1 if limited else 0
        if limited and not set_applied_term(terms, applied, total, signals):
            return k - first
        state[FAILED] = 0
        state[COMMANDS] = min(state[COMMANDS] + 1, window)

        result = results[k]
        result[TWIST], result[TWIST + 1] = body_speeds(
            command[0], command[1], sampling[3], sampling[4]
        )
        for i in range(2):
            result[ERROR + i] = filter_state[SPEEDS, i] - reference[i]
            result[SKILL + i] = signals_view(signals).skills[i]
            result[APPLIED + i] = applied[i]
            result[COMMAND + i] = command[i]
            for j in range(terms.shape[0]):
                result[TERMS + 2 * j + i] = terms[j, i]
        result[CERTIFICATE : CERTIFICATE + 4] = certificate
        result[LIMITED] = 1.0 if limited else 0.0
    return until - first


@kernel
def add_references(
    end: int, state: Stamps, references: Messages, trajectory: tuple[Stamps, Array, Array, int]
) -> bool:
    """Store the references before ``end``; return False at the first one that is not regular.

    That one is not finite, does not follow the newest sample, is a jump, or exceeds the storage.
    Other arguments as in :func:`replay_steps`.
    """
    stamps, samples, jump, capacity = trajectory
    while state[REFERENCES] < end:
        j = state[REFERENCES]
        stamp, last = references[0][j], state[TRAJECTORY_END]
        first = state[TRAJECTORY_FIRST]
        if not references[2][j] or last == first or stamp <= stamps[last - 1]:
            return False
        if last == stamps.size:
            return False
        if last - first == capacity:
            first += 1
        twist = references[1][j]
        if write_sample(stamps, samples, first, last, stamp, twist[0], twist[1], jump):
            return False  # the sample is beyond the end and will be overwritten
        state[TRAJECTORY_FIRST], state[TRAJECTORY_END] = first, last + 1
        state[PENDING] = 1
        state[REFERENCES] = j + 1
    return True
