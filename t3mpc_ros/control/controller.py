# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Controller of one robot: odometry and reference in, limited twist and status out."""

from collections import deque
from dataclasses import dataclass
from itertools import count
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.actuation import LimitParameters, VelocityActuation
from t3mpc_ros.control.batch_replay import (
    APPLIED,
    ERROR,
    NEVER,
    BatchStepper,
    ControllerParts,
    Status,
    StepResults,
)
from t3mpc_ros.control.control_law import Nt3fsMpcController, Nt3fsMpcParameters
from t3mpc_ros.control.switching_tracker import SwitchingTracker, sample_reference
from t3mpc_ros.control.watchdog import InputWatchdog, Reason, ResponseMonitor, WatchdogParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.trajectory import Jump, ReferenceTrajectory, Stamps
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    STANDSTILL,
    BodyTwist,
    State,
    StateArray,
    WheelSpeeds,
)
from t3mpc_ros.parameters.table import group

__all__ = ['Controller', 'ControllerParameters', 'Status']

Array = NDArray[np.float64]

JUMP_DETECTION_FACTOR = 2.2
"""A reference that changes this many times faster than the robot may is taken as a switch."""


SNAPSHOT_PERIOD = 0.25
"""s between two copies of what is learnt."""
SNAPSHOT_COUNT = 3
"""The oldest of so many is from before a robot stopped following; doubt takes some time."""


@dataclass(frozen=True)
class ControllerParameters(Nt3fsMpcParameters):
    """The whole controller: the law, the robot's lengths, limits and time-outs."""

    geometry: WheelGeometry = group(WheelGeometry, inline=True)
    limits: LimitParameters = group(LimitParameters, inline=True)
    watchdog: WatchdogParameters = group(WatchdogParameters)


class Controller:
    """Follows a stamped reference with one robot, one step per odometry message.

    Its output is a function of the messages it was given, in their order: it reads no clock.
    """

    def __init__(self, parameters: ControllerParameters) -> None:
        self.parameters = parameters
        self._pursuit = SwitchingTracker(parameters, 'velocity')
        self._period = 1.0 / parameters.rate
        self._period_ns = round(self._period * NANOSECONDS)
        self._drive = VelocityActuation(
            parameters.estimate, parameters.limits, parameters.geometry, 'velocity', self._period
        )
        self._dead_ns = round(self._drive.dead_time * NANOSECONDS)
        self._looking = self._how_to_look()
        self._speeds, self._wanted, self._begin, self._end = np.zeros((4, 2))
        self._freshness = InputWatchdog(parameters.watchdog)
        self._following = ResponseMonitor(parameters.watchdog, self._period)
        limits = parameters.limits
        self._track = ReferenceTrajectory(
            BodyTwist(
                JUMP_DETECTION_FACTOR * limits.linear_acceleration,
                JUMP_DETECTION_FACTOR * limits.angular_acceleration,
            )
        )
        self._before: deque[tuple[Array, list[Array]]] = deque(maxlen=SNAPSHOT_COUNT)
        """What had been learnt, from oldest to newest."""
        self._since_copy = 0
        self._copy_after = next(n for n in count(1) if n * self._period >= SNAPSHOT_PERIOD)
        self._jumps: list[Jump] = []
        self._told: set[int] = set()
        self._moving = False
        self._last_stamp_ns: int | None = None
        self.status = self._status(0, Reason.NO_ODOMETRY, np.full(2, math.nan))

    @property
    def law(self) -> Nt3fsMpcController:
        """The law, with everything it has learnt."""
        return self._pursuit.law

    @property
    def drive(self) -> VelocityActuation:
        """The seam to the robot: what is estimated and sent. A replay tells it what was sent."""
        return self._drive

    def warm_up(self) -> None:
        """Compile and pre-train now, never inside a step; nothing is remembered of it."""
        self.law.warm_up()
        other, jump = Controller(self.parameters), 2.0 * JUMP_DETECTION_FACTOR * self._period
        jumped = BodyTwist(jump * self.parameters.limits.linear_acceleration, 0.0)
        for k in range(10):
            wanted = STANDSTILL if k < 4 else jumped
            other.add_reference(State(k * self._period_ns, ORIGIN, wanted))
        for k in range(6):
            other.step(State(k * self._period_ns, ORIGIN, STANDSTILL))

    def configure(self, parameters: ControllerParameters) -> None:
        """Use other live settings from the next step on."""
        self.parameters = parameters
        self._pursuit.configure(parameters)
        self._drive.configure(parameters.limits)
        self._looking = self._how_to_look()

    def enable(self, on: bool) -> None:
        """Let the robot move, or stop it until it is let again."""
        self._freshness.enabled = on

    def reset(self) -> None:
        """Forget the run and everything learnt in it; the robot stops until inputs are fresh."""
        enabled = self._freshness.enabled
        self._freshness.reset()
        self._freshness.enabled = enabled
        self._forget_reference()
        self.law.fuzzy.reset()
        self.law.predictive.pretrain()
        self._stop()
        self._last_stamp_ns = None

    def add_reference(self, motion: State) -> bool:
        """Keep a wanted motion; return False when it is not finite and therefore ignored."""
        track = self._track
        newest = track.newest_ns
        if not track.add(motion):
            return False
        if newest is not None and motion.stamp_ns <= newest:
            # The source has started again: what it said of later is no longer so.
            self._jumps = [jump for jump in self._jumps if jump.stamp_ns < motion.stamp_ns]
            self._pursuit.plan.withdraw(motion.stamp_ns)
        if track.has_jumps:
            self._jumps += track.pop_jumps()
        self._freshness.reference_arrived()
        return True

    def step(self, measured: State) -> tuple[BodyTwist, Status]:
        """Return the twist to command now, and why.

        Parameters
        ----------
        measured
            The robot's odometry. A second message with the same stamp changes nothing; one that
            is not finite, out of time or too late stops the robot, with the reason in the status.
        """
        stamp = measured.stamp_ns
        if stamp == self._last_stamp_ns:
            return self._drive.twist, self.status
        restarted = self._last_stamp_ns is not None and stamp < self._last_stamp_ns
        self._last_stamp_ns = stamp
        elapsed = self._freshness.elapsed(stamp)
        if restarted:
            self._forget_reference()

        finite = measured.is_finite()
        acts_ns = stamp + self._dead_ns
        speeds, wanted, begin, end = self._speeds, self._wanted, self._begin, self._end
        track, twist = self._track, measured.twist
        known, speed, error = sample_reference(
            track.stamps,
            track.samples,
            track.first,
            track.end,
            track.jump,
            stamp,
            acts_ns,
            *self._looking,
            twist.linear,
            twist.angular,
            speeds,
            wanted,
            begin,
            end,
        )
        reason = self._freshness.decide(
            stamp, finite=finite, known=known, speed=speed, error=error if finite else 0.0
        )
        if reason.moves and restarted:
            reason = Reason.ODOMETRY_RESTARTED
        if not reason.moves:
            self._stop()
            self.status = self._status(stamp, reason, speeds - wanted)
            return STANDSTILL, self.status

        fresh = elapsed is None or not self._moving
        if fresh:
            self._drive.reset(speeds)
            self._following.reset()
            self._before.clear()
        elif not self._following.heard(*speeds.tolist()):
            return self._command_unresponsive(stamp)
        elif self.status.reason is Reason.NOT_FOLLOWING:
            fresh = True
            self._drive.reset(speeds)
        drive = self._drive
        drive.observe(speeds, elapsed or self._period)
        if fresh:
            self._pursuit.begin(acts_ns, self._drive.ahead, begin)
            self._moving = True
            self._told.clear()
            known_ns = acts_ns if self.parameters.switches.preview else stamp
            self._jumps = [jump for jump in self._jumps if jump.stamp_ns > known_ns]
        if self._jumps or self._told:
            self._announce(stamp, acts_ns)
        command = self._pursuit.step(acts_ns, drive.ahead, begin, end, elapsed or self._period)
        applied = drive.send(command).copy()
        self._pursuit.applied(applied, limited=drive.limited)
        self._following.told(*drive.command.tolist())
        self._keep()
        self.status = self._status(stamp, reason, drive.speeds - wanted, applied)
        return drive.twist, self.status

    def march(
        self, measured: StateArray, references: StateArray, rows: Stamps, answers: StepResults
    ) -> int:
        """Do many steps of a recorded run; return how many of them were plain.

        The same as :meth:`add_reference` and :meth:`step` one after the other, to the last bit.
        Plain steps, at which a robot follows a reference that does not jump, are done in compiled
        stretches; the first stretch ever is compiled before.

        Parameters
        ----------
        measured, references
            Odometry and wanted motions.
        rows
            For each step its odometry message, and from where to where references are handed
            over before it, shape (n, 3).
        answers
            Its n rows are overwritten.

        Raises
        ------
        ValueError
            A number has come to be infinite or NaN; the controller cannot be used further.
        """
        k = plain = 0
        while k < len(rows):
            taken, handed = self._go_on(measured, references, rows, k, answers)
            k, plain = k + taken, plain + taken
            if k == len(rows):
                break
            heard, begin, end = rows[k].tolist()
            for j in range(max(begin, handed), end):
                self.add_reference(references[j])
            answers.note(k, *self.step(measured[heard]))
            k += 1
        return plain

    def _command_unresponsive(self, stamp_ns: int) -> tuple[BodyTwist, Status]:
        """Go on commanding the reference to a robot that does not follow, and learn nothing.

        A stop would be for ever: a board that has restarted waits for commands. What was learnt
        until this was noticed is taken back. When the robot follows again, the law starts as
        after a stop, with what it knew before.
        """
        if self.status.reason is not Reason.NOT_FOLLOWING:
            self._pursuit.reset()
            if self._before:
                self.law.rollback(self._before[0])
                self._before.clear()
        self._drive.aim(self._wanted)
        self._following.told(*self._drive.command.tolist())
        error = self._speeds - self._wanted
        self.status = self._status(stamp_ns, Reason.NOT_FOLLOWING, error)
        return self._drive.twist, self.status

    def _go_on(
        self,
        measured: StateArray,
        references: StateArray,
        rows: Stamps,
        first: int,
        answers: StepResults,
    ) -> tuple[int, int]:
        """Do plain steps from a row on; return how many, and up to where references are kept."""
        handed, switches = int(rows[first, 1]), self.parameters.switches
        jumps = {jump.stamp_ns for jump in self._jumps}
        seen = self._speeds, self._wanted, self._begin, self._end
        acting = self._track, self._pursuit, self._drive, self._freshness, self._following
        parts = ControllerParts(*acting, seen, self._looking)
        if not (
            self._moving
            and self.status.reason is Reason.TRACKING
            and self._last_stamp_ns is not None
            and switches.crossing == 'ramp'
            and self._told <= jumps
            # What is to be seen beforehand waits for the sample after it.
            and (self._told == jumps or not switches.preview)
            and parts.are_plain
        ):
            return 0, handed
        # One that is told of is forgotten when a command acts after it, another is told when seen.
        due_ns = min((t + self._dead_ns * (t not in self._told) for t in jumps), default=NEVER)
        when = self._last_stamp_ns, self._dead_ns, due_ns
        steps = BatchStepper(parts, self.parameters.watchdog, measured, references, handed, *when)
        k = until = first
        while k == until < len(rows):
            until = min(len(rows), k + self._copy_after - self._since_copy)
            taken = steps.run(rows, k, until, answers.numbers)
            k += taken
            self._keep(taken)
        done = answers.numbers[first:k]
        steps.finish(done)
        if len(done):
            answers.follows(first, k)
            self._last_stamp_ns = steps.last_ns
            error, applied = done[-1, ERROR:][:2].copy(), done[-1, APPLIED:][:2].copy()
            self.status = self._status(steps.last_ns, Reason.TRACKING, error, applied)
        return len(done), steps.handed

    def _keep(self, steps: int = 1) -> None:
        """Copy what is learnt, now and then."""
        self._since_copy += steps
        if self._since_copy >= self._copy_after:
            self._since_copy = 0
            self._before.append(self.law.snapshot())

    def silent(self, last_heard_ns: int | None, now_ns: int) -> bool:
        """Whether the odometry has gone silent, so that a stop must be commanded.

        Both times come from one clock of the caller's. When it has, the controller forgets its
        motion, and takes the next odometry message as a new start.
        """
        if not self._freshness.silent(last_heard_ns, now_ns):
            return False
        self._stop()
        self.status = self._status(
            self._last_stamp_ns or 0, Reason.NO_ODOMETRY, np.full(2, math.nan)
        )
        return True

    def _how_to_look(self) -> tuple[float, float, bool, float, float]:
        """Return what :func:`look` is told of the settings."""
        parameters, geometry = self.parameters, self.parameters.geometry
        return (
            self._period,
            parameters.watchdog.reference_timeout * NANOSECONDS,
            parameters.switches.preview,
            geometry.wheel_radius,
            geometry.half_separation,
        )

    def _announce(self, stamp_ns: int, acts_ns: int) -> None:
        """Tell the plan of jumps: when they are seen, or before if that is wanted."""
        newest = self._track.newest_ns or 0
        preview, geometry = self.parameters.switches.preview, self.parameters.geometry
        soon_ns = acts_ns + self._period_ns if preview else stamp_ns
        for jump in self._jumps:
            # Beforehand, wait for the sample after it: then the slope after it is known too.
            known = jump.stamp_ns <= soon_ns or (preview and newest > jump.stamp_ns)
            if known and jump.stamp_ns not in self._told:
                self._told.add(jump.stamp_ns)
                after = self._track.at(jump.stamp_ns)
                slope = BodyTwist(0.0, 0.0) if after is None else after.rate
                self._pursuit.plan.announce(
                    jump.stamp_ns,
                    _array(wheels_from_twist(jump.change, geometry)),
                    _array(wheels_from_twist(slope, geometry)),
                )
        self._jumps = [
            jump
            for jump in self._jumps
            if jump.stamp_ns > acts_ns or jump.stamp_ns not in self._told
        ]
        self._told.intersection_update(jump.stamp_ns for jump in self._jumps)

    def _forget_reference(self) -> None:
        self._track.clear()
        self._jumps.clear()

    def _stop(self) -> None:
        if self._moving or np.any(self._drive.command):
            self._pursuit.reset()
            self._drive.reset(np.zeros(2))
        self._moving = False

    def _status(
        self, stamp_ns: int, reason: Reason, error: Array, applied: Array | None = None
    ) -> Status:
        law = self.law
        moves = applied is not None
        return Status(
            stamp_ns,
            reason,
            error,
            law.terms.copy() if moves else np.zeros_like(law.terms),
            np.zeros(2) if applied is None else applied,
            law.watched.copy(),
            law.predictive.skill,
            reason.moves and self._drive.limited,
        )


def _array(wheels: WheelSpeeds) -> Array:
    return np.array((wheels.right, wheels.left))
