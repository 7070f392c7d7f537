# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The controller of one robot: stamped motions in, a limited twist and its reason out."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.composition import ComposedLaw, CompositionSettings
from t3mpc_ros.control.freshness import Freshness, FreshnessSettings, Reason
from t3mpc_ros.control.law import CertificateReading
from t3mpc_ros.control.limits import LimitSettings, VelocityCommand
from t3mpc_ros.motion import BodyTwist, Geometry, Motion, WheelSpeeds
from t3mpc_ros.motion.kinematics import wheels_from_body
from t3mpc_ros.motion.track import Track, TrackPoint
from t3mpc_ros.motion.words import NANOSECONDS, STANDSTILL
from t3mpc_ros.settings import nested

Array = NDArray[np.float64]

JUMP_FACTOR = 2.2
"""A reference that changes this many times faster than the robot may is taken as a switch."""


@dataclass(frozen=True)
class ControllerSettings(CompositionSettings):
    """The whole controller: the law, the robot's lengths, limits and time-outs."""

    geometry: Geometry = nested(Geometry)
    limits: LimitSettings = nested(LimitSettings)
    freshness: FreshnessSettings = nested(FreshnessSettings)


@dataclass(frozen=True, slots=True)
class Status:
    """What the controller decided at one step, and why; arrays are right wheel first."""

    stamp_ns: int
    reason: Reason
    error: Array
    """delta = chi - r, rad/s; NaN while no reference is known."""
    estimate: Array
    """g of the fuzzy systems, rad/s²."""
    terms: Array
    """Shape (5, 2), rows as in ``law.TERMS``, rad/s²."""
    applied: Array
    """Wheel accelerations after the limits, rad/s²."""
    certificate: CertificateReading
    skill: Array
    limited: bool


class Controller:
    """Follows a stamped reference with one robot, one step per odometry message.

    Its output is a function of the messages it was given, in their order: it reads no clock.
    """

    def __init__(self, settings: ControllerSettings) -> None:
        self.settings = settings
        self.law = ComposedLaw(settings, 'velocity')
        self._command = VelocityCommand(settings.limits, settings.geometry)
        self._freshness = Freshness(settings.freshness)
        limits = settings.limits
        self._track = Track(
            BodyTwist(
                JUMP_FACTOR * limits.linear_acceleration, JUMP_FACTOR * limits.angular_acceleration
            )
        )
        self._moving = False
        self._last_stamp_ns: int | None = None
        self.status = self._status(0, Reason.NO_ODOMETRY, np.full(2, math.nan))

    def warm_up(self) -> None:
        """Compile and pre-train now, never inside a step."""
        self.law.warm_up()

    def configure(self, settings: ControllerSettings) -> None:
        """Use other live settings from the next step on."""
        self.settings = settings
        self.law.configure(settings)
        self._command.configure(settings.limits)

    def enable(self, on: bool) -> None:
        """Let the robot move, or stop it until it is let again."""
        self._freshness.enabled = on

    def reset(self) -> None:
        """Forget the run and everything learnt in it; the robot stops until inputs are fresh."""
        enabled = self._freshness.enabled
        self._freshness.reset()
        self._freshness.enabled = enabled
        self._track.clear()
        self.law.fuzzy.reset()
        self.law.predictive.relearn()
        self._stop(np.zeros(2))
        self._last_stamp_ns = None

    def add_reference(self, motion: Motion) -> bool:
        """Keep a wanted motion; return False when it is not finite and therefore ignored."""
        if not self._track.add(motion):
            return False
        self._freshness.reference_arrived()
        return True

    def step(self, measured: Motion) -> tuple[BodyTwist, Status]:
        """Return the twist to command now, and why.

        Parameters
        ----------
        measured
            The robot's odometry. A second message with the same stamp changes nothing; one that
            is not finite, out of time or too late stops the robot, with the reason in the status.
        """
        stamp = measured.stamp_ns
        if stamp == self._last_stamp_ns:
            return self._command.twist, self.status
        restarted = self._last_stamp_ns is not None and stamp < self._last_stamp_ns
        self._last_stamp_ns = stamp
        elapsed = self._freshness.elapsed(stamp)
        if restarted:
            self._track.clear()

        finite = measured.is_finite()
        speeds = _array(wheels_from_body(measured.twist, self.settings.geometry))
        point = self._wanted(stamp)
        wanted = (
            np.full(2, math.nan)
            if point is None
            else _array(wheels_from_body(point.twist, self.settings.geometry))
        )
        error = speeds - wanted
        reason = self._freshness.decide(
            stamp,
            finite=finite,
            known=point is not None,
            speed=float(np.max(np.abs(speeds))) if finite else math.inf,
            error=float(np.max(np.abs(error))) if point is not None and finite else 0.0,
        )
        if reason.moves and restarted:
            reason = Reason.ODOMETRY_RESTARTED
        if not reason.moves or point is None:
            self._stop(speeds if finite else np.zeros(2))
            self.status = self._status(stamp, reason, error)
            return STANDSTILL, self.status

        if elapsed is None or not self._moving:
            self._start(speeds)
            elapsed = 1.0 / self.settings.rate
        rate = _array(wheels_from_body(point.rate, self.settings.geometry))
        command = self.law.step(speeds, wanted, rate, elapsed)
        applied = _array(
            self._command.step(WheelSpeeds(*map(float, command)), 1.0 / self.settings.rate)
        )
        self.law.applied(applied, _array(self._command.wheels), limited=self._command.limited)
        self.status = self._status(stamp, reason, self.law.speeds - wanted, applied)
        return self._command.twist, self.status

    def silent(self, last_heard_ns: int | None, now_ns: int) -> bool:
        """Whether the odometry has gone silent, so that a stop must be commanded.

        Both times come from one clock of the caller's. When it has, the controller forgets its
        motion, and takes the next odometry message as a new start.
        """
        if not self._freshness.silent(last_heard_ns, now_ns):
            return False
        self._stop(np.zeros(2))
        self.status = self._status(
            self._last_stamp_ns or 0, Reason.NO_ODOMETRY, np.full(2, math.nan)
        )
        return True

    def _wanted(self, stamp_ns: int) -> TrackPoint | None:
        """Return the reference for this stamp, holding the newest one for the time-out."""
        newest = self._track.newest_ns
        if newest is None:
            return None
        age = stamp_ns - newest
        if 0 < age <= self.settings.freshness.reference_timeout * NANOSECONDS:
            return self._track.at(newest)
        return self._track.at(stamp_ns)

    def _start(self, speeds: Array) -> None:
        self.law.reset(speeds)
        self._command.reset(WheelSpeeds(*map(float, speeds)))
        self._moving = True

    def _stop(self, speeds: Array) -> None:
        if self._moving or np.any(self._command.wheels):
            self.law.reset(speeds)
            self._command.reset(WheelSpeeds(0.0, 0.0))
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
            -law.terms[0] if moves else np.zeros(2),
            law.terms.copy() if moves else np.zeros_like(law.terms),
            np.zeros(2) if applied is None else applied,
            law.reading,
            law.predictive.skill.copy(),
            self._command.limited if moves else False,
        )


def _array(wheels: WheelSpeeds) -> Array:
    return np.array((wheels.right, wheels.left))
