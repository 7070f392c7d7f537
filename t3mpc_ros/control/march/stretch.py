# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The plain steps of a recorded run in one compiled call, by the kernels of a single step.

Nothing is computed here: kernels are called in the order in which the controller calls them, and
what is not plain is found out before anything is changed, and left to the controller.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.composition import compose, note_applied
from t3mpc_ros.control.drive import choose_command
from t3mpc_ros.control.estimate import AHEAD, SPEEDS, observe
from t3mpc_ros.control.pursuit import look
from t3mpc_ros.control.switches import step_plan
from t3mpc_ros.kernels import kernel
from t3mpc_ros.motion import kinematics
from t3mpc_ros.motion.track import write_sample
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.mpc.response import gather, signals_in
from t3mpc_ros.mpc.skill import renew

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
    FROZEN,
    AGAINST,
    TOLD,
    REFERENCES,
    FAILED,
) = range(13)
"""Places of the whole numbers of a controller's state. Beyond those that it has itself: how many
commands it remembers for its trust in the robot, up to where references are handed over, and
whether a kernel refused a number."""
NUMBERS = 13

TWIST, ERROR, SKILL, APPLIED, TERMS, WATCHED, COMMAND, LIMITED = 0, 2, 4, 6, 8, 18, 22, 24
"""Where in a row of answers they begin; the last is one number."""
WIDTH = 25


class Bounds(NamedTuple):
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
def march(
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
    stores, sizes, signals, tables, nominal, decays, change, average, every = predictive[:9]
    decay, rules, how, numbers, whole, status = predictive[9:]
    gains, centres, pull, sharpness, shares, grades, firings, phi, coefficients = law[:9]
    work, terms, total, remembered = law[9:]
    command, limits, drive_period, stretch, applied = drive
    timeout, reference_timeout, speed_bound, error_bound, following, window, dead, due = bounds
    for k in range(first, until):
        if not hand_over(rows[k, 2], state, references, track):
            return k - first
        heard = rows[k, 0]
        stamp = measured[0][heard]
        acts = stamp + dead
        elapsed = (stamp - state[LAST_NS]) / NANOSECONDS
        if elapsed <= 0.0 or elapsed > timeout or not measured[2][heard] or acts >= due:
            return k - first
        there, speed, error = look(
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
        judged = following != 0.0 and state[TOLD] >= window
        apart = max(abs(speeds[0] - command[0]), abs(speeds[1] - command[1]))
        if judged and not apart <= following:
            return k - first

        state[LAST_NS], state[SEEN_NS], state[WAITING] = stamp, told_ns, 0
        if judged:
            state[AGAINST] = 0
        observe(
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
        state[CROSSINGS] = step_plan(
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
        sampled = phase == 0 or phase > every - average
        state[FAILED] = 1
        if not gather(known[AHEAD], followed, sampled, phase == 0, decay, signals):
            return k - first
        if phase == 0:
            renew(
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
        if not compose(
            known[AHEAD],
            followed,
            rate,
            signals,
            elapsed,
            state[FROZEN] != 0,
            gains,
            centres,
            pull,
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
        limited = choose_command(total, known, command, limits, drive_period, stretch, applied)
        state[FROZEN] = 1 if limited else 0
        if limited and not note_applied(terms, applied, total, signals):
            return k - first
        state[FAILED] = 0
        state[TOLD] = min(state[TOLD] + 1, window)

        answer = answers[k]
        answer[TWIST], answer[TWIST + 1] = body_speeds(
            command[0], command[1], looking[3], looking[4]
        )
        for i in range(2):
            answer[ERROR + i] = known[SPEEDS, i] - wanted[i]
            answer[SKILL + i] = signals_in(signals).skills[i]
            answer[APPLIED + i] = applied[i]
            answer[COMMAND + i] = command[i]
            for j in range(terms.shape[0]):
                answer[TERMS + 2 * j + i] = terms[j, i]
        answer[WATCHED : WATCHED + 4] = remembered
        answer[LIMITED] = 1.0 if limited else 0.0
    return until - first


@kernel
def hand_over(
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
