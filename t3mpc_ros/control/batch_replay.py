# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compiled replay of many controller steps of a recorded run."""

import math
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.actuation import VelocityActuation, actuation_command
from t3mpc_ros.control.control_law import (
    BOUND,
    RATE,
    VALUE,
    CertificateReading,
    set_applied_term,
    step_law,
)
from t3mpc_ros.control.control_law import TERM_NAMES as NAMES
from t3mpc_ros.control.jump_transition import step_transition
from t3mpc_ros.control.speed_filter import PREDICTED, SPEEDS, filter_step
from t3mpc_ros.control.switching_tracker import SwitchingTracker, sample_reference
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

body_speeds = kernel(kinematics.body_speeds)

(
    TRACK_FIRST,
    TRACK_END,
    CROSSINGS,
    PHASE,
    SAMPLES,
    LAST_NS,
    SEEN_NS,
    WAITING,
    SATURATED,
    EVIDENCE,
    COMMANDS,
    REFERENCES,
    FAILED,
) = range(13)
"""Places of the whole numbers of a controller's state. Beyond those that it has itself: how many
commands it remembers for its trust in the robot, up to where references are handed over, and
whether a kernel refused a number."""
NUMBERS = 13

TWIST, ERROR, SKILL, APPLIED, TERMS, CERTIFICATE, COMMAND, LIMITED = 0, 2, 4, 6, 8, 18, 22, 24
"""Where in a row of answers they begin; the last is one number."""
WIDTH = 25


class StepBounds(NamedTuple):
    """Up to where a step is plain."""

    odometry_timeout: float
    """s, as the next."""
    reference_timeout: float
    speed: float
    """Of a measured wheel, rad/s, as the next two."""
    error: float
    following: float
    """Beyond the last command; 0 when the robot is always trusted."""
    window: int
    """Commands from which on that can be said."""
    dead_ns: int
    """From an odometry stamp to the instant at which its command acts."""
    due_ns: int
    """When the next jump of the reference is due: no step up to it is left."""


@kernel
def replay_steps(
    rows: Stamps,
    first: int,
    until: int,
    state: Stamps,
    measured: Messages,
    references: Messages,
    bounds: tuple[Any, ...],
    track: tuple[Stamps, Array, Array, int],
    looking: tuple[float, float, bool, float, float],
    seen: tuple[Array, Array, Array, Array],
    estimator: tuple[Any, ...],
    plan: tuple[Any, ...],
    predictive: tuple[Any, ...],
    law: tuple[Any, ...],
    drive: tuple[Any, ...],
    answers: Array,
) -> int:
    """Take the steps from ``first`` on, to before ``until`` or the first that is not plain.

    Returns how many were taken.

    rows       : shape (n, 3), for each step its odometry, and from where to where references
                 are handed over before it
    state      : whole numbers, see TRACK_FIRST ... FAILED
    bounds     : as in :class:`Bounds`
    track      : stamps, samples, jump and capacity of the reference
    looking    : as :func:`look` takes it
    seen       : speeds, wanted, begin and finish of :func:`look`
    estimator  : known, commands, enabled, gain, velocity, late, lag and period of
                 :func:`observe`
    plan       : crossings, instants, passed, sums, period, lag, most, followed and rate of
                 :func:`step_plan`
    predictive : stores, sizes, rows, tables, nominal, decays, change, average, every, decay,
                 rules, how, numbers, whole and status of :func:`renew`
    law        : gains, the eight tables of the fuzzy systems, work, terms, command and what the
                 certificate remembers, of :func:`compose`
    drive      : command, limits, period, stretch, applied of :func:`choose_command`
    answers    : shape (n, WIDTH), rows are overwritten
    """
    stamps, samples, jump, _ = track
    speeds, wanted, begin, finish = seen
    known, commands, enabled, gain, velocity, late, lag, period = estimator
    crossings, instants, passed, sums, plan_period, plan_lag, most, followed, rate = plan
    stores, sizes, signals, tables, nominal, decays, change, average, decimation = predictive[:9]
    decay, rules, how, numbers, whole, status = predictive[9:]
    gains, centres, nonsingleton_gain, sharpness, shares, grades, firings, phi, coefficients = law[
        :9
    ]
    work, terms, total, remembered = law[9:]
    command, limits, drive_period, stretch, applied = drive
    timeout, reference_timeout, speed_bound, error_bound, following, window, dead, due = bounds
    for k in range(first, until):
        if not add_references(rows[k, 2], state, references, track):
            return k - first
        heard = rows[k, 0]
        stamp = measured[0][heard]
        acts = stamp + dead
        elapsed = (stamp - state[LAST_NS]) / NANOSECONDS
        if elapsed <= 0.0 or elapsed > timeout or not measured[2][heard] or acts >= due:
            return k - first
        there, speed, error = sample_reference(
            stamps,
            samples,
            state[TRACK_FIRST],
            state[TRACK_END],
            jump,
            stamp,
            acts,
            looking[0],
            looking[1],
            looking[2],
            looking[3],
            looking[4],
            measured[1][heard, 0],
            measured[1][heard, 1],
            speeds,
            wanted,
            begin,
            finish,
        )
        told_ns = stamp if state[WAITING] != 0 else state[SEEN_NS]
        if not there or (stamp - told_ns) / NANOSECONDS > reference_timeout:
            return k - first
        # So that what is no number is not plain.
        if not (speed <= speed_bound and error <= error_bound):
            return k - first
        judged = following != 0.0 and state[COMMANDS] >= window
        apart = max(abs(speeds[0] - command[0]), abs(speeds[1] - command[1]))
        if judged and not apart <= following:
            return k - first

        state[LAST_NS], state[SEEN_NS], state[WAITING] = stamp, told_ns, 0
        if judged:
            state[EVIDENCE] = 0
        filter_step(
            known,
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
        state[CROSSINGS] = step_transition(
            crossings,
            instants,
            passed,
            state[CROSSINGS],
            sums,
            acts,
            begin,
            finish,
            plan_period,
            plan_lag,
            most,
            followed,
            rate,
        )
        phase = state[PHASE]
        sampled = phase == 0 or phase > decimation - average
        state[FAILED] = 1
        if not accumulate_sample(known[PREDICTED], followed, sampled, phase == 0, decay, signals):
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
                decimation,
                decay,
                rules,
                how,
                numbers,
                whole,
                status,
            )
            state[SAMPLES] += 1
        state[PHASE] = (phase + 1) % decimation
        if not step_law(
            known[PREDICTED],
            followed,
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
            remembered,
        ):
            return k - first
        limited = actuation_command(total, known, command, limits, drive_period, stretch, applied)
        state[SATURATED] = 1 if limited else 0
        if limited and not set_applied_term(terms, applied, total, signals):
            return k - first
        state[FAILED] = 0
        state[COMMANDS] = min(state[COMMANDS] + 1, window)

        answer = answers[k]
        answer[TWIST], answer[TWIST + 1] = body_speeds(
            command[0], command[1], looking[3], looking[4]
        )
        for i in range(2):
            answer[ERROR + i] = known[SPEEDS, i] - wanted[i]
            answer[SKILL + i] = signals_view(signals).skills[i]
            answer[APPLIED + i] = applied[i]
            answer[COMMAND + i] = command[i]
            for j in range(terms.shape[0]):
                answer[TERMS + 2 * j + i] = terms[j, i]
        answer[CERTIFICATE : CERTIFICATE + 4] = remembered
        answer[LIMITED] = 1.0 if limited else 0.0
    return until - first


@kernel
def add_references(
    end: int, state: Stamps, references: Messages, track: tuple[Stamps, Array, Array, int]
) -> bool:
    """Keep the references before ``end``; return False at the first that is not plain.

    That one is not finite, does not come after the newest, lies a jump away from it, or there is
    no more room where samples are kept. The others are as in :func:`march`.
    """
    stamps, samples, jump, capacity = track
    while state[REFERENCES] < end:
        j = state[REFERENCES]
        stamp, last, first = references[0][j], state[TRACK_END], state[TRACK_FIRST]
        if not references[2][j] or last == first or stamp <= stamps[last - 1]:
            return False
        if last == stamps.size:
            return False
        if last - first == capacity:
            first += 1
        twist = references[1][j]
        if write_sample(stamps, samples, first, last, stamp, twist[0], twist[1], jump):
            return False  # beyond the end nothing counts: it is written anew
        state[TRACK_FIRST], state[TRACK_END] = first, last + 1
        state[WAITING] = 1
        state[REFERENCES] = j + 1
    return True


NEVER = int(np.iinfo(np.int64).max)


class ControllerParts(NamedTuple):
    """Whatever of a controller changes in a plain step, and what it is told."""

    track: ReferenceTrajectory
    pursuit: SwitchingTracker
    drive: VelocityActuation
    watchdog: InputWatchdog
    following: ResponseMonitor
    seen: tuple[Array, Array, Array, Array]
    """Speeds, wanted, begin and finish of :func:`t3mpc_ros.control.switching_tracker.sample_reference`."""
    looking: tuple[float, float, bool, float, float]
    """What it is told of the settings."""

    @property
    def are_plain(self) -> bool:
        """Whether a plain step can come next, as far as these parts can say."""
        following, drive = self.following, self.drive
        newest = following.newest
        return (
            self.track.end > self.track.first
            and not self.watchdog.held
            and self.watchdog.reference_seen[0] is not None
            and following.holds
            and newest is not None
            # A replay may have told of other commands.
            and newest == tuple(drive.command.tolist())
            and not self.pursuit.law.predictive.dithered
        )


class BatchStepper:
    """Goes on from where a controller is, as long as its steps are plain.

    Parameters
    ----------
    parts
        Of the controller; they are behind until :meth:`finish`.
    settings
        How old inputs may be.
    measured, references
        Odometry and wanted motions.
    handed
        How many of the latter were handed over.
    last_ns
        Stamp of the last odometry.
    dead_ns
        From it to the instant at which its command acts.
    due_ns
        When the next jump of the reference, announced already, is due; NEVER without one.
    """

    def __init__(
        self,
        parts: ControllerParts,
        parameters: WatchdogParameters,
        measured: StateArray,
        references: StateArray,
        handed: int,
        last_ns: int,
        dead_ns: int,
        due_ns: int,
    ) -> None:
        self._parts = parts
        track, plan, law = parts.track, parts.pursuit.plan, parts.pursuit.law
        seen_ns, waiting = parts.watchdog.reference_seen
        told, against = parts.following.counts
        state: Stamps = np.zeros(NUMBERS, dtype=np.int64)
        state[TRACK_FIRST], state[TRACK_END] = track.first, track.end
        state[CROSSINGS] = plan.count
        state[PHASE], state[SAMPLES] = law.predictive.phase, law.predictive.samples
        state[LAST_NS], state[SEEN_NS], state[WAITING] = last_ns, seen_ns or 0, waiting
        state[SATURATED], state[EVIDENCE], state[COMMANDS] = law.frozen, against, told
        state[REFERENCES] = handed
        self._state = state
        bounds = StepBounds(
            parameters.odometry_timeout,
            parameters.reference_timeout,
            parameters.speed_bound,
            parameters.error_bound,
            parameters.response_bound,
            parts.following.window,
            dead_ns,
            due_ns,
        )
        # Plain tuples, which a call takes to pieces much faster than named ones.
        self._told = (
            (measured.stamps_ns, measured.twists, measured.finite),
            (references.stamps_ns, references.twists, references.finite),
            tuple(bounds),
            (track.stamps, track.samples, track.jump, track.capacity),
            parts.looking,
            parts.seen,
            parts.drive.estimator.tables,
            plan.tables,
            law.predictive.tables,
            law.tables,
            parts.drive.tables,
        )

    @property
    def handed(self) -> int:
        """Up to where references are handed over."""
        return int(self._state[REFERENCES])

    @property
    def last_ns(self) -> int:
        """Stamp of the odometry of the last step."""
        return int(self._state[LAST_NS])

    def run(self, rows: Stamps, first: int, until: int, answers: Array) -> int:
        """Return how many steps from ``first`` to before ``until`` were done, see :func:`march`.

        Raises
        ------
        ValueError
            The estimate or the law has come to numbers that are not finite.
        """
        taken = replay_steps(rows, first, until, self._state, *self._told, answers)
        if self._state[FAILED]:
            raise ValueError('speeds, errors and accelerations must be finite: got inf or nan')
        return taken

    def finish(self, answers: Array) -> None:
        """Tell the parts what has become of them, and the rows of all steps that were done."""
        parts, state = self._parts, self._state.tolist()
        track, plan, law = parts.track, parts.pursuit.plan, parts.pursuit.law
        track.synchronize(state[TRACK_FIRST], state[TRACK_END])
        parts.watchdog.went_on(state[LAST_NS], state[SEEN_NS], waiting=bool(state[WAITING]))
        if len(answers):
            plan.count = state[CROSSINGS]
            law.predictive.synchronize(state[PHASE], state[SAMPLES])
            law.frozen = bool(state[SATURATED])
            parts.following.went_on(answers[:, COMMAND : COMMAND + 2], state[EVIDENCE])
            parts.drive.limited = bool(answers[-1, LIMITED])


class Status(NamedTuple):
    """What the controller decided at one step, and why; arrays are right wheel first."""

    stamp_ns: int
    reason: Reason
    error: Array
    """delta = chi - r, rad/s; NaN while no reference is known."""
    terms: Array
    """Shape (5, 2), rows as in ``law.TERMS``, rad/s²."""
    applied: Array
    """Wheel accelerations after the limits, rad/s²."""
    watched: Array
    """What the certificate remembers, see :func:`t3mpc_ros.control.control_law.update_certificate`."""
    skill: Array
    limited: bool

    @property
    def estimate(self) -> Array:
        """G of the fuzzy systems, rad/s², shape (2,)."""
        estimate: Array = 0.0 - self.terms[0]
        return estimate

    @property
    def certificate(self) -> CertificateReading:
        """What the run-time certificate says."""
        return CertificateReading.of(self.watched)


class StepResults(NamedTuple):
    """Twist and status of each step, NaN where there is none."""

    numbers: Array
    """Shape (n, WIDTH), columns as in :mod:`t3mpc_ros.control.batch_replay`."""
    reasons: NDArray[np.object_]
    """:class:`Reason` of each, None where there is none, shape (n,)."""

    @classmethod
    def empty(cls, count: int) -> Self:
        """Return rows for so many steps."""
        return cls(np.full((count, WIDTH), math.nan), np.full(count, None, dtype=np.object_))

    def part(self, begin: int, end: int) -> 'StepResults':
        """Return some of the rows: what is written to them is written here."""
        return StepResults(self.numbers[begin:end], self.reasons[begin:end])

    def note(self, row: int, twist: BodyTwist, status: Status) -> None:
        """Write the answer of :meth:`Controller.step` into a row."""
        self.numbers[row] = (
            *twist,
            *status.error.tolist(),
            *status.skill.tolist(),
            *status.applied.tolist(),
            *status.terms.ravel().tolist(),
            *status.watched.tolist(),
            math.nan,
            math.nan,
            float(status.limited),
        )
        self.reasons[row] = status.reason

    def follows(self, begin: int, end: int) -> None:
        """Write that the robot was let move in some rows."""
        self.reasons[begin:end] = Reason.TRACKING

    @property
    def twists(self) -> Array:
        """The commands, m/s and rad/s, shape (n, 2)."""
        return self.numbers[:, TWIST : TWIST + 2]

    @property
    def pairs(self) -> dict[str, Array]:
        """What is said of both wheels by name, shape (n, 2): as in :class:`Status`."""
        numbers = self.numbers
        found = {
            'error': numbers[:, ERROR : ERROR + 2],
            'skill': numbers[:, SKILL : SKILL + 2],
            'applied': numbers[:, APPLIED : APPLIED + 2],
            'estimate': 0.0 - numbers[:, TERMS : TERMS + 2],
        }
        for k, name in enumerate(NAMES):
            found[name] = numbers[:, TERMS + 2 * k : TERMS + 2 * k + 2]
        return found

    @property
    def certificate(self) -> Array:
        """Value and margin of the certificate, see :class:`CertificateReading`, shape (n, 2)."""
        watched = self.numbers[:, CERTIFICATE:]
        return np.stack([watched[:, VALUE], watched[:, BOUND] - watched[:, RATE]], axis=1)

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Whether a limit cut the command, shape (n,)."""
        return np.equal(self.numbers[:, LIMITED], 1.0)
