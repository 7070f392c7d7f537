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
"""Controller of one robot: odometry and reference in, limited twist and status out."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import count
import math
from typing import Any, NamedTuple, Self

import numpy as np

from t3mpc_ros.control.body_correction import BodyCorrection, BodyCorrectionParameters
from t3mpc_ros.control.control_law import (
    MAX_SMOOTHING,
    TERM_NAMES,
    CertificateReading,
    FrictionTermParameters,
    LawParameters,
    Nt3fsMpcController,
    Nt3fsMpcParameters,
    fitting_gain,
    servo_gain,
)
from t3mpc_ros.control.dead_time_estimator import UNKNOWN, USED_EVIDENCE, DeadTimeEstimator
from t3mpc_ros.control.input_shaper import EARLY, HIGHEST, InputShaper, InputShaperParameters
from t3mpc_ros.control.jump_transition import CommandLimit, JumpTransition, MotorLimit
from t3mpc_ros.control.keep_out import KeepOut, KeepOutParameters
from t3mpc_ros.control.odometry_repair import OdometryTwist, StampFilter
from t3mpc_ros.control.pose_controller import PoseController, PoseLoopParameters, PoseReference
from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters
from t3mpc_ros.control.velocity_actuation import (
    LimitParameters,
    ReachMonitor,
    VelocityActuation,
    wheel_limits,
)
from t3mpc_ros.control.watchdog import (
    DriveMonitor,
    InputWatchdog,
    Reason,
    ResponseMonitor,
    WatchdogParameters,
    WheelMonitor,
)
from t3mpc_ros.geometry import kinematics
from t3mpc_ros.geometry.kinematics import (
    WheelGeometry,
    advance_pose,
    twist_from_wheels,
    wheels_from_twist,
)
from t3mpc_ros.geometry.obstacles import Obstacles, OccupancyGrid
from t3mpc_ros.geometry.trajectory import Jump, ReferenceTrajectory, TrajectorySamples, interpolate
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    STANDSTILL,
    Array,
    BodyTwist,
    State,
    WheelSpeeds,
    has_moved,
)
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.parameters.table import (
    ParameterError,
    at_least,
    at_most,
    group,
    parameter,
    with_default,
)

JUMP_DETECTION_FACTOR = 2.2
"""A reference acceleration above this multiple of the acceleration limit is a jump."""

BODY_WEIGHTS = 'body.estimate'  # name of what the body correction has learnt

FEEDBACK_RANGE = {'body': (0.8, 1.2), 'paper': (0.0, 1.4)}
"""Permitted slope of the command in the speed error, relative to the one that fits."""

MIN_DEAD_TIME_CHANGE = 0.0005  # smallest change (s) of the dead time in use
LINEAR_EVIDENCE = 2.0, 4.0
"""Likelihood ratio, 2 log, of the mean speed alone from which the dead time is not changed against
it: where the pose leaves open that the yaw rate is late, and where it does not."""
POSE_EVIDENCE = 0.0  # the same by the pose: while the factor of a wheel is wrong it is 0 to 8

NO_DEAD_TIME = 0.001
"""Estimated dead time (s) up to which the lag in use may be too long: there is no shorter one."""
MAX_MISSED = 20  # largest number of periods without a step through which a ramp goes on

REPORTED_DEAD_TIME, REPORTED_DISTURBANCE = 0.008, 1.0
"""Difference of the dead time from the configured one, and duration of a disturbed response, that
are reported, s."""
REPORTED_NOISE = 2.5, 0.08
"""Noise of the wheel speeds that is reported: as a multiple of the configured one, and (rad/s)²; a
rotor that rings makes up to 0.04."""
INTERVALS, OTHER_RATE = 21, 0.02
"""Number of intervals between steps whose median is the time for which commands are held, and its
relative difference from the period from which that counts."""
OTHER_FREQUENCY = 1.5
"""Ratio of the measured frequency of the rotors to the one in use from which it is used."""

POSE_JUMP = 0.25, 0.5  # change of the pose (m, rad) from one message to the next that is no motion
POSE_FOLLOWS = 3.0
"""Part of ``watchdog.response_bound`` within which the change of the pose follows commands where
the twist does not: the pose of a robot that has stopped itself turns with its gyro."""
SNAPSHOT_PERIOD = 0.25  # time between two snapshots of the weights, s
SNAPSHOT_COUNT = 3  # number of snapshots kept; the oldest one is older than the response time-out


@dataclass(frozen=True)
class ControllerParameters(Nt3fsMpcParameters):
    """Parameters of the controller: control law, wheel geometry, limits and time-outs."""

    composition: str = parameter(
        'paper',
        'body: the wheels follow the plan by feed-forward, and gains learnt from the gyro correct '
        'the yaw rate; for a robot whose wheels follow commands exactly. paper: NT3FS, '
        'compensator and v_p act on the wheel speeds, as in the paper; for a drive with errors',
        choices=('body', 'paper'),
    )
    estimate_dead_time: bool = parameter(
        False,
        'whether the dead time of the robot is estimated from commands and measured speeds, and '
        'used in place of speed_filter.dead_time where it differs by more than 4 ms; what is '
        'learnt while the response is disturbed is then discarded',
        dynamic=True,
    )
    mean_speeds: bool = parameter(
        True,
        'whether a measured wheel speed is the mean over the last period, as from counters of '
        'steps; false: the speed at its stamp',
    )
    geometry: WheelGeometry = group(WheelGeometry, inline=True)
    limits: LimitParameters = group(LimitParameters, inline=True)
    watchdog: WatchdogParameters = group(WatchdogParameters)
    # Wheels of steppers follow whatever the friction; bags without the parameter had no such term.
    friction: FrictionTermParameters = group(FrictionTermParameters, gamma=0.0)
    command_shaper: InputShaperParameters = group(
        InputShaperParameters, straight_frequency=0.0, turning_frequency=0.0
    )
    body: BodyCorrectionParameters = group(BodyCorrectionParameters, fixed=('max_correction',))
    pose: PoseLoopParameters = group(PoseLoopParameters)
    keep_out: KeepOutParameters = group(KeepOutParameters, fixed=('stuck_time',))

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` if the composition cannot treat jumps so."""
        super().check_consistency()
        if self.keep_out.enabled and not self.pose.enabled:
            raise ParameterError(
                'pose.enabled must be true with keep_out.enabled: after a detour the robot must '
                'find back to its path'
            )
        if self.composition == 'body' and self.jump_transition.method == 'predictive':
            raise ParameterError(
                'jump_transition.method must be ramp with composition body, which has no '
                'predictive term: got predictive; or set composition to paper'
            )
        self._check_feedback()

    def _check_feedback(self) -> None:
        """Raise :class:`ParameterError` where the feedback does not fit rate and lag.

        A wheel that follows its command exactly has the better measurement: with less feedback
        than cancels it, the speed is an integral of the noise, with more it oscillates. Where
        the learning parts act on the wheels, they also correct what low feedback leaves.
        """
        period, lag = 1.0 / self.rate, self.speed_filter.lag
        fitting, body = servo_gain(period, lag), self.composition == 'body'
        bound = self.compensated_bound if self.law.compensator and not body else 0.0
        if self.law.gain == 0.0:
            most = 0.5 * MAX_SMOOTHING * fitting
            if bound > most:
                raise ParameterError(
                    f'law.error_bound plus predictive.v_max must be at most {at_most(most, 4)} '
                    f'rad/s² at this rate and lag with law.gain 0: got {bound:g}'
                )
            return
        slope = self.law.gain + bound / self.law.smoothing
        least, most = (share * fitting for share in FEEDBACK_RANGE[self.composition])
        if not least <= slope <= most:
            sum_of = ' plus the slope of the compensator' if bound else ''
            raise ParameterError(
                f'law.gain{sum_of} must be from {at_least(least)} to {at_most(most)} 1/s at this '
                f'rate and lag: got {slope:.3g}; law.gain 0 chooses the gain that fits'
            )

    def resolved(self) -> Self:
        """Return the parameters with the parts of the composition, and the gain that fits."""
        changes: dict[str, object] = {}
        if self.composition == 'body':
            changes = {'use_fuzzy': False, 'law.compensator': False, 'predictive.enabled': False}
        parts = self.with_values(changes)
        if parts.law.gain > 0.0:
            return parts
        gain, smoothing = fitting_gain(parts, 'velocity')
        return parts.with_values({'law.gain': gain, 'law.smoothing': smoothing})


@dataclass(frozen=True)
class StepperControllerParameters(ControllerParameters):
    """Parameters whose defaults are for a robot with stepper motors and a gyro."""

    composition: str = with_default(ControllerParameters, 'composition', 'body')
    estimate_dead_time: bool = with_default(ControllerParameters, 'estimate_dead_time', True)
    law: LawParameters = group(LawParameters, gain=0.0)
    # A rotor follows its field at once; the lag of 0.02 s is that of the velocity drive.
    speed_filter: SpeedFilterParameters = group(
        SpeedFilterParameters, fixed=('disturbance',), lag=0.003
    )
    command_shaper: InputShaperParameters = group(InputShaperParameters)


WHEELS = ('right', 'left')
_OF_WHEELS = ('error', 'estimate', 'skill', *(f'terms/{t}' for t in (*TERM_NAMES, 'applied')))
SCALAR_NAMES = (
    *(f'{name}/{wheel}' for name in _OF_WHEELS for wheel in WHEELS),
    'lyapunov/value',
    'lyapunov/margin',
)
"""Names of the scalars of a step, below the name of the node, as in :attr:`Status.scalars`."""


class Status(NamedTuple):
    """Result of one step beside the command; arrays are right wheel first."""

    stamp_ns: int
    reason: Reason
    error: Array  # delta = chi - r, rad/s; NaN while no reference is known
    terms: Array  # shape (5, 2), rows as in ``TERM_NAMES``, rad/s²
    applied: Array  # wheel accelerations after the limits, rad/s²
    certificate: CertificateReading  # reading of the run-time certificate
    skill: Array  # skill of the predictor in the middle of its horizon
    limited: bool  # whether a limit changed the command

    @property
    def estimate(self) -> Array:
        """Estimate g of the fuzzy systems, rad/s², shape (2,)."""
        estimate: Array = 0.0 - self.terms[0]
        return estimate

    @property
    def scalars(self) -> list[float]:
        """Values of the :data:`SCALAR_NAMES`; NaN where there is none."""
        terms = self.terms.ravel().tolist()
        return [
            *self.error.tolist(),
            *(0.0 - term for term in terms[:2]),
            *self.skill.tolist(),
            *terms,
            *self.applied.tolist(),
            self.certificate.value,
            self.certificate.margin,
        ]


class Controller:
    """Tracks a stamped reference with one robot, one step per odometry message.

    The output is a function of the messages in their order; the controller reads no clock.

    parameters : replaceable at run time, see :meth:`configure`
    obstacles : known walls and pillars in the frame of the odometry, for the keep-out
    saved : a map in that frame, whose obstacles it knows at the start
    """

    def __init__(
        self,
        parameters: ControllerParameters,
        obstacles: Obstacles | None = None,
        saved: OccupancyGrid | None = None,
    ) -> None:
        self.parameters = parameters
        self._pose_reference = PoseReference()
        self.pose_controller = PoseController(parameters.pose)  # the pose loop
        self.keep_out = (
            KeepOut(parameters.keep_out, _largest(parameters.limits), obstacles, saved)
            if parameters.keep_out.enabled
            else None
        )
        """The keep-out, None unless it is enabled."""
        self._tracker = SwitchingTracker(parameters.resolved(), 'velocity')
        self._tracker.transition.limit = _command_limit(parameters)
        self._period = 1.0 / parameters.rate
        self._period_ns = round(self._period * NANOSECONDS)
        self.actuation = VelocityActuation(
            parameters.speed_filter,
            _limits_in_use(parameters),
            parameters.geometry,
            'velocity',
            self._period,
        )
        """Speed filter and last command; a replay sets the recorded commands here."""
        self._lag = parameters.speed_filter.lag
        geometry = parameters.geometry
        self.body = BodyCorrection(
            parameters.body, geometry.wheel_radius, geometry.half_separation, self._period
        )
        """The correction of the yaw rate with its map."""
        self._ahead_ns = 0
        """Time by which the plan is ahead of the command, ns; 0 without a known future."""
        self._sampling = Sampling.of(parameters)
        self._sampled = SampledReference(*np.zeros((4, 2)))
        self._sample_reference = TypedKernel(sample_reference)
        self._watchdog = InputWatchdog(parameters.watchdog)
        self._response = ResponseMonitor(parameters.watchdog, self._period)
        near = parameters.watchdog.response_bound / POSE_FOLLOWS
        self._pose_response = ResponseMonitor(
            replace(parameters.watchdog, response_bound=near), self._period
        )
        """By the change of the pose, while the twist of the odometry is used."""
        self.wheel_monitor = WheelMonitor(parameters.watchdog, self._period)
        """Which wheel was at a speed that no command of late explains."""
        self._trajectory = ReferenceTrajectory(_least_jump(parameters.limits))
        self._snapshot_steps = next(n for n in count(1) if n * self._period >= SNAPSHOT_PERIOD)
        self._jumps: list[Jump] = []
        self._announced: set[int] = set()
        self._moving = False
        self._begin()

    def _begin(self) -> None:
        """Begin without odometry, and with the dead time of the parameters."""
        self._shaper = InputShaper(self.parameters.command_shaper, self._period)
        self._turning_frequency = self.parameters.command_shaper.turning_frequency
        """Frequency for which the commands are shaped, Hz."""
        self._intervals: deque[float] = deque(maxlen=INTERVALS)
        self._longer_hold_ns = 0
        """Time by which a command is in advance because it is held longer than a period, ns."""
        self._excess_lag = 0.0  # part of the lag that the response contradicts, s
        self.dead_time = self._make_dead_time_estimator()  # estimate of the dead time
        self._set_dead_time(self.parameters.speed_filter.dead_time)
        self.disturbed = False
        """Whether the response is disturbed, so that nothing is learned from it."""
        self._disturbed_for = 0.0
        self._late_reference_for = 0.0
        """Time for which the reference did not reach the instant that is commanded, s."""
        self._before_disturbance: tuple[Any, Any] | None = None
        self._snapshots: deque[tuple[Any, Any]] = deque(maxlen=SNAPSHOT_COUNT)
        """Weights, oldest first."""
        self._steps_since_snapshot = 0
        self._place = ORIGIN
        self._last_stamp_ns: int | None = None
        self._step_ns = 0  # instant of the last step, with odometry or without
        self._reach = ReachMonitor()
        self.drive_monitor = DriveMonitor(
            feels=self.keep_out is not None, follows_pose=self.parameters.pose.enabled
        )
        """Pauses of the commands."""
        self.odometry_twist = OdometryTwist()  # whether the odometry has a twist
        self._twist_believed = True  # whether it was used at the last step
        self.stamp_filter = StampFilter()  # whether its stamps jitter
        self.odometry_used = True
        """Whether the last message was used: not repeated or overtaken, and its stamp no leap."""
        self.status = self._make_status(0, Reason.NO_ODOMETRY)

    @property
    def law(self) -> Nt3fsMpcController:
        """The control law with its weights."""
        return self._tracker.law

    @property
    def response_time(self) -> float | None:
        """Most time from a command to its effect in the odometry, s; None: not estimated."""
        if not self.parameters.estimate_dead_time:
            return None
        return self._delay + 4.0 * self.dead_time.standard_deviation

    @property
    def _delay(self) -> float:
        """Dead time in use and lag: from a command to the motion it causes, s."""
        return self._dead_time + self.parameters.speed_filter.lag

    @property
    def gain(self) -> float:
        """Feedback gain K in use, 1/s."""
        return self._tracker.parameters.law.gain

    @property
    def doubts_odometry(self) -> bool:
        """Whether the stamp of the last message leaps: the next one tells whether it is true."""
        return self._watchdog.doubted_ns is not None

    @property
    def ignored_odometry(self) -> int:
        """Number of messages that were ignored: repeated, overtaken, or with a refuted stamp."""
        return self._watchdog.ignored

    def problems(self) -> list[str]:
        """Return what does not fit in odometry and response, each with its remedy."""
        found = [self.drive_monitor.problem()]
        if self.status.reason is Reason.DIVERGING:
            found.append(self._watchdog.divergence())
        if self.keep_out is not None and self._last_stamp_ns is not None:
            found.append(self.keep_out.ranges.problem())
        found += [self.stamp_filter.problem(), self.odometry_twist.problem()]
        if not self.drive_monitor.pauses:  # else the whole robot does not follow
            found.append(self.wheel_monitor.problem())
        configured = self.parameters.speed_filter.dead_time
        in_use, lag = self._dead_time, self.parameters.speed_filter.lag
        if self._excess_lag > 0.0 and in_use < -NO_DEAD_TIME:
            found.append(
                f'the robot responds after {in_use + lag:.3f} s, too early for a '
                f'speed_filter.lag of {lag:g} s: the estimate is in use; set the lag'
            )
        elif abs(in_use - configured) > REPORTED_DEAD_TIME:
            found.append(
                f'the robot responds after {in_use:.3f} s, speed_filter.dead_time is '
                f'{configured:g} s: the estimate is in use; set the parameter'
            )
        noise = self._noise_problem()
        if self._disturbed_for > REPORTED_DISTURBANCE:
            found.append(
                'the response to the commands is disturbed, nothing is learnt from it: commands '
                f'or odometry are late, or the dead time has changed{noise and ", or "}{noise}'
            )
        found.append(self._reference_problem())
        frequency = self.parameters.command_shaper.turning_frequency
        if self._turning_frequency != frequency:
            found.append(
                f'the robot oscillates in yaw with {self._turning_frequency:.1f} Hz, '
                f'command_shaper.turning_frequency is {frequency:g} Hz: commands are shaped for '
                'the measured one; set both frequencies'
            )
        found.append(self.body.problem() or self.odometry_twist.turn_problem())
        if not self.stamp_filter.jitters:  # what is left of it is rough, too
            found.append(self.body.response_problem())
        return [text for text in found if text] or ([noise] if noise else [])

    def get_weights(self) -> dict[str, Array]:
        """Return all adapted arrays by name: those of the law, and the gains of the body."""
        return self.law.get_weights() | {BODY_WEIGHTS: self.body.get_weights()}

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Use weights as returned by :meth:`get_weights`; those of the body may be missing."""
        body = weights.get(BODY_WEIGHTS)
        if body is not None:
            self.body.set_weights(body)
        self.law.set_weights({name: v for name, v in weights.items() if name != BODY_WEIGHTS})

    def warm_up(self) -> None:
        """Compile and pretrain, so that no step has to; the state of the controller is kept."""
        self.law.warm_up()
        other, jump = Controller(self.parameters), 2.0 * JUMP_DETECTION_FACTOR * self._period
        jumped = BodyTwist(jump * self.parameters.limits.linear_acceleration, 0.0)
        for k in range(24):
            reference = STANDSTILL if k < 14 else jumped
            other.add_reference(State(k * self._period_ns, ORIGIN, reference))
        for k in range(16):
            other.step(State(k * self._period_ns, ORIGIN, STANDSTILL))

    def configure(self, parameters: ControllerParameters) -> None:
        """Use new values of the dynamic parameters from the next step on."""
        if parameters.estimate_dead_time and not self.parameters.estimate_dead_time:
            self.dead_time.reset(self.actuation.speeds)
        self.parameters = parameters
        self._tracker.configure(parameters.resolved())
        self.body.configure(parameters.body)
        self.pose_controller.parameters = parameters.pose
        self.actuation.configure(_limits_in_use(parameters))
        self._tracker.transition.limit = _command_limit(parameters)
        self._trajectory.set_jump(_least_jump(parameters.limits))
        if self.keep_out is not None:
            self.keep_out.limits = _largest(parameters.limits)
        self._sampling = Sampling.of(parameters)

    def enable(self, on: bool) -> None:
        """Enable the robot's motion, or stop the robot until it is enabled again."""
        self._watchdog.enabled = on
        if on:
            self.drive_monitor.reset()

    def reset(self) -> None:
        """Discard the state and the weights; the robot stops until new inputs arrive."""
        enabled = self._watchdog.enabled
        self._watchdog.reset()
        self._watchdog.enabled = enabled
        self._clear_reference()
        self.law.reset_estimate()
        self.law.predictive.pretrain()
        self.body.reset()
        self._stop()
        self._reset_response()
        self.wheel_monitor.reset()
        self.pose_controller.reset()
        self._begin()
        if self.keep_out is not None:
            self.keep_out.reset()

    def add_range(self, sensor: int, reading: float, stamp_ns: int | None = None) -> bool:
        """Add a range reading (m, REP 117) of a sensor, taken at the pose of the last odometry.

        Return False for one that changes no decision: late, repeated or impossible.
        """
        if self.keep_out is None or self._last_stamp_ns is None:
            return False
        return self.keep_out.add_reading(sensor, reading, self._place, stamp_ns)

    def add_reference(self, reference: State) -> bool:
        """Store a reference sample; return False if it is not finite and therefore ignored."""
        trajectory = self._trajectory
        newest = trajectory.newest_ns
        if not self.parameters.pose.enabled and trajectory.holds(reference):
            # A source that sends its whole horizon again and again has not changed its plan.
            self._watchdog.reference_received()
            return True
        if not trajectory.add(reference):
            return False
        if newest is not None and reference.stamp_ns <= newest:
            # The source has restarted: its samples replace those with later stamps.
            self._jumps = [jump for jump in self._jumps if jump.stamp_ns < reference.stamp_ns]
            self._tracker.transition.withdraw(reference.stamp_ns)
        if self.parameters.pose.enabled:
            self._pose_reference.add(reference)
        self._jumps += trajectory.pop_jumps()
        self._watchdog.reference_received()
        return True

    def step(self, odometry: State) -> tuple[BodyTwist, Status]:
        """Return the twist to command now, and the status.

        odometry : state of the robot. A message with the stamp of the last one, or with one that
            is older by no more than the time-out, is counted and changes nothing, but that it
            stops a disabled robot. So does one whose stamp is further than the time-out from the
            last one; if the next one follows it, that is a restart, and an older stamp stops the
            robot. One that comes before 0.6 of a period has passed changes nothing either: the
            odometry is faster than ``rate``. A message that is not finite stops the robot.
        """
        self.odometry_used = not self._watchdog.ignores(odometry.stamp_ns)
        if not self.odometry_used:
            return self._ignore(odometry.stamp_ns)
        stamped, stamp = odometry.stamp_ns, self.stamp_filter.time(odometry)
        odometry = odometry._replace(stamp_ns=stamp)
        last, step_ns = self._last_stamp_ns, self._step_ns
        if last is not None and last < stamp < step_ns + EARLY * self._period_ns:
            return self._wait(odometry)
        self._last_stamp_ns = self._step_ns = stamp
        elapsed = self._watchdog.elapsed(stamped)
        odometry = self.odometry_twist.measured(
            odometry, restart=elapsed is None, command=self._followed_command()
        )
        disbelieved = self._disbelieve_twist()
        if disbelieved:
            elapsed = None  # the speeds before were no measurements: all estimates begin again
        self._check_continuity(last, odometry)
        plan_ns, reason = self._decide(odometry, elapsed)
        speeds, reference, begin, end = self._sampled
        if not reason.moves:
            self._stop()
            self.status = self._make_status(stamp, reason, speeds - reference)
            return STANDSTILL, self.status

        actuation = self.actuation
        dt = self._period if elapsed is None else (stamp - step_ns) / NANOSECONDS
        self._watch_interval(dt)
        self._watch_reference(stamp, dt)
        if self.status.reason is Reason.PAUSED and not self._response.responsive:
            # Commands go on as before the pause: nothing is learnt until the robot responds.
            actuation.reset(speeds)
            self._moving = True
            return self._command_unresponsive(odometry, dt)
        restart = elapsed is None or not self._moving
        # A robot that drives on where only its speeds are known anew: the plan is kept.
        followed = self._response.responsive
        follows = disbelieved and self._moving and followed
        if restart:
            self.wheel_monitor.interrupt()
            actuation.reset(speeds, follows=follows)
            self._reset_response()
            self._snapshots.clear()
        else:
            self.wheel_monitor.update(stamp, speeds.tolist(), actuation.command.tolist())
            if not self._is_responsive(speeds):
                return self._follow_unresponsive(odometry, dt, followed=followed)
            if self.status.reason is Reason.NOT_FOLLOWING:
                restart = True
                actuation.reset(speeds, actuation.command.copy())
        self._observe(speeds, dt, restart=restart)
        if self.parameters.pose.enabled:
            if restart:
                self.pose_controller.reset()
            self._follow_pose(odometry, begin, end, dt)
        if restart and not follows:
            self._begin_plan(stamp, plan_ns)
        applied = self._send(stamp, plan_ns, odometry.pose.yaw, dt)
        short = self._falls_short(dt)
        self.law.set_applied(applied, saturated=actuation.limited or short)
        self._take_snapshot()
        self.status = self._make_status(stamp, reason, actuation.speeds - reference, applied)
        return actuation.twist, self.status

    @property
    def drives_through_gaps(self) -> bool:
        """Whether :meth:`step_without_odometry` may command anything.

        The pose decides where a robot with a pose loop goes, and what the body correction learns.
        """
        return self.parameters.composition == 'paper' and not self.parameters.pose.enabled

    def step_without_odometry(self, stamp_ns: int) -> tuple[BodyTwist, Status] | None:
        """Return the command for an instant whose odometry is missing; None if there is none.

        A tracking robot follows the known reference on until ``watchdog.odometry_timeout``: the
        wheels are taken to be where the commands have led them, and nothing is learnt. It stops
        where it would with odometry. Odometry of earlier instants that comes later changes no
        command.

        stamp_ns : that instant, by the clock of the odometry
        """
        last, period_ns = self._last_stamp_ns, self._period_ns
        timeout_ns = self.parameters.watchdog.odometry_timeout * NANOSECONDS
        if last is None or not (self._moving and self.drives_through_gaps):
            return None
        if self.status.reason is not Reason.TRACKING:
            return None
        if stamp_ns < self._step_ns + EARLY * period_ns or stamp_ns > last + timeout_ns:
            return None
        actuation, unknown = self.actuation, np.full(2, math.nan)
        dt = (stamp_ns - self._step_ns) / NANOSECONDS
        self._step_ns = stamp_ns
        actuation.observe(unknown, dt)
        if self.parameters.estimate_dead_time:
            self.dead_time.step(unknown, actuation.command, dt)
        wheels = WheelSpeeds(*actuation.speeds.tolist())
        twist = twist_from_wheels(wheels, self.parameters.geometry)
        plan_ns, reason = self._sample_plan(State(stamp_ns, self._place, twist))
        reference = self._sampled.reference
        if not reason.moves:
            self._stop()
            self.status = self._make_status(stamp_ns, reason, actuation.speeds - reference)
            return STANDSTILL, self.status
        self.law.saturated = True  # the error is assumed: nothing is learnt from it
        applied = self._send(stamp_ns, plan_ns, self._place.yaw, dt)
        self.law.set_applied(applied, saturated=True)
        error = actuation.speeds - reference
        self.status = self._make_status(stamp_ns, reason, error, applied)
        return actuation.twist, self.status

    def _send(self, stamp_ns: int, plan_ns: int, yaw: float, elapsed: float) -> Array:
        """Send the command for the sampled plan; return the accelerations (rad/s²) that act."""
        if self._jumps or self._announced:
            self._announce_jumps(stamp_ns, plan_ns)
        _, _, begin, end = self._sampled
        acceleration = self._acceleration(plan_ns, yaw, begin, end, elapsed)
        applied = self.actuation.send_acceleration(acceleration, elapsed).copy()
        self._add_command()
        return applied

    def _add_command(self) -> None:
        right, left = self.actuation.command.tolist()
        self._response.add_command(right, left)
        self._pose_response.add_command(right, left)

    def _reset_response(self) -> None:
        """Assume a robot that follows its commands."""
        self._response.reset()
        self._pose_response.reset()

    def _followed_command(self) -> BodyTwist | None:
        """Return the command that the robot follows now, if it drives: that of the dead time."""
        if not self._moving:
            return None
        # The newest one was sent a period ago, speeds are means over a period.
        wheels = self._response.command(max(round(self._delay / self._period - 0.5), 0))
        return None if wheels is None else twist_from_wheels(wheels, self.parameters.geometry)

    def _is_responsive(self, speeds: Array) -> bool:
        """Whether the robot follows commands, by the speeds (rad/s) that are used."""
        if self._twist_believed:
            by_pose = self.odometry_twist.speeds_by_pose
            self._pose_response.update(*wheels_from_twist(by_pose, self.parameters.geometry))
        return self._response.update(*speeds.tolist())

    def _check_keep_out(self, odometry: State, reason: Reason, begin: Array) -> Reason:
        """Return the reason after contact and range sensors; ``begin``: planned speeds, rad/s."""
        keep_out = self.keep_out
        assert keep_out is not None
        keep_out.ranges.update(odometry.stamp_ns, odometry.pose)
        if self.drive_monitor.contact and self.status.reason.moves:
            astern = self.actuation.twist.linear < 0.0
            keep_out.touch(self.drive_monitor.contact_monitor.furthest, astern=astern)
        rejoins = self.pose_controller.rejoining
        astern = keep_out.retreats or (not rejoins and float(begin.sum()) < 0.0)
        if reason.moves and keep_out.ranges.is_blind(astern=astern):
            return Reason.TOO_FEW_RANGES
        return reason

    def _ignore(self, stamp_ns: int) -> tuple[BodyTwist, Status]:
        """Return the last command at a message that is not used; a disabled robot stops."""
        if not self._watchdog.enabled:
            self._stop()
            self.status = self._make_status(stamp_ns, Reason.DISABLED, self.status.error)
        return self.actuation.twist, self.status

    def _wait(self, odometry: State) -> tuple[BodyTwist, Status]:
        """Return the last command at an odometry that comes before the period has passed."""
        _, reason = self._sample_plan(odometry)
        if reason.moves:
            return self.actuation.twist, self.status
        self._stop()
        self.status = self._make_status(odometry.stamp_ns, reason, self.status.error)
        return STANDSTILL, self.status

    def _disbelieve_twist(self) -> bool:
        """Whether a twist that was used is replaced from now on; the estimates by it end."""
        twist = self.odometry_twist
        believed, self._twist_believed = self._twist_believed, not twist.replaced
        if not (believed and twist.replaced) or (twist.missing and twist.known):
            return False
        self.dead_time = self._make_dead_time_estimator()
        self.wheel_monitor.reset()
        return True

    def _check_continuity(self, last_ns: int | None, odometry: State) -> None:
        """Clear what an odometry that does not follow the last one makes invalid."""
        if last_ns is None:
            return
        if odometry.stamp_ns < last_ns:  # the source has restarted
            self._clear_reference()
            if self.keep_out is not None:
                self.keep_out.reset()
        elif (
            self.keep_out is not None
            and odometry.is_finite()
            and has_moved(self._place, odometry.pose, *POSE_JUMP)
        ):  # a localisation has found the robot elsewhere
            self.keep_out.relocate()  # what it has marked was marked at another place
            self.drive_monitor.contact_monitor.restart(None)

    def _decide(self, odometry: State, elapsed: float | None) -> tuple[int, Reason]:
        """Sample the plan; return the instant planned for, ns, and whether to move."""
        plan_ns, reason = self._sample_plan(odometry)
        if elapsed is None or not reason.moves:
            self.drive_monitor.begin()
        if reason.moves:
            reason = self.drive_monitor.decide(
                odometry, self.actuation.twist, elapsed or 0.0, following=self._response.responsive
            )
        if self.keep_out is not None and odometry.is_finite():
            reason = self._check_keep_out(odometry, reason, self._sampled.begin)
        return plan_ns, reason

    def _sample_plan(self, odometry: State) -> tuple[int, Reason]:
        """Sample speeds and reference; return the instant planned for, ns, and whether to move."""
        stamp, twist = odometry.stamp_ns, odometry.twist
        finite = odometry.is_finite()
        if finite:
            self._place = odometry.pose
        effect_ns = stamp + self._dead_time_ns + self._longer_hold_ns
        if not self._moving:
            self._ahead_ns = self._plan_ahead(effect_ns)
        plan_ns = effect_ns + self._ahead_ns
        known, speed, error = self._sample_reference(
            self._trajectory.buffer,
            stamp,
            plan_ns,
            twist.linear,
            twist.angular,
            self._sampling,
            self._sampled,
        )
        return plan_ns, self._watchdog.decide(
            stamp, finite=finite, known=known, speed=speed, error=error if finite else 0.0
        )

    def _observe(self, speeds: Array, dt: float, *, restart: bool) -> None:
        """Update the estimates of speeds, disturbance and dead time, ``dt`` s after the last."""
        self.actuation.observe(speeds, dt)
        if restart:
            self.dead_time.reset(speeds)
            self.disturbed, self._before_disturbance = False, None
            self._disturbed_for = 0.0
        else:
            self._update_dead_time(speeds, dt)

    def _falls_short(self, elapsed: float) -> bool:
        """Whether the drive does not reach its commands, where the law acts on the wheels."""
        actuation = self.actuation
        return self.parameters.composition == 'paper' and self._reach.update(
            actuation.speeds.tolist(),
            actuation.command.tolist(),
            (self._lag * actuation.speed_filter.state.disturbance).tolist(),
            elapsed,
        )

    def _begin_plan(self, stamp_ns: int, plan_ns: int) -> None:
        """Begin to move at the predicted speeds, towards the reference at ``plan_ns``."""
        predicted = self.actuation.predicted
        self._tracker.begin(plan_ns, predicted, self._sampled.begin)
        self._shaper.reset(predicted)
        self.body.restart()
        self._moving = True
        self._announced.clear()
        known_ns = plan_ns if self.parameters.jump_transition.preview else stamp_ns
        self._jumps = [jump for jump in self._jumps if jump.stamp_ns > known_ns]

    def _acceleration(
        self, plan_ns: int, yaw: float, begin: Array, end: Array, elapsed: float
    ) -> Array:
        """Return u (rad/s²), shape (2,), for the plan from ``begin`` to ``end`` (rad/s)."""
        tracker, speeds = self._tracker, self.actuation.predicted
        corrects_body = self.parameters.composition == 'body' and self.parameters.body.enabled
        corrects_body = corrects_body and not self.odometry_twist.pose_is_late
        if self._ahead_ns == 0 and not corrects_body:
            return tracker.step(plan_ns, speeds, begin, end, elapsed)
        planned, rate = tracker.plan(plan_ns, begin, end, elapsed)
        if self._ahead_ns > 0:
            self._shaper.step(planned, elapsed)
            planned, rate = self._shaper.reference, self._shaper.rate
        if corrects_body:
            correction = self.body.step(
                yaw,
                elapsed,
                self._sampled.reference,
                planned,
                self.actuation.command,
                self._delay + 0.5 * self._period,
                learn=not self.disturbed,
            )
            self._check_shaper()
            planned = planned + np.array([correction, -correction])
        return self.law.step(speeds, planned, rate, elapsed)

    def _watch_interval(self, elapsed: float) -> None:
        """Plan for the time for which commands are held, where odometry has another rate.

        The command realises an acceleration over the period (E19): it is in advance by T / (1 -
        exp(-T/lag)).
        """
        self._intervals.append(elapsed)
        if self.parameters.composition != 'body' or len(self._intervals) < INTERVALS:
            return
        held, period = sorted(self._intervals)[INTERVALS // 2], self._period
        self._longer_hold_ns, self.dead_time.lateness = 0, 0.0
        if abs(held / period - 1.0) > OTHER_RATE:
            lag = self.parameters.speed_filter.lag
            advance = [time / -math.expm1(-time / lag) for time in (held, period)]
            self._longer_hold_ns = round((advance[0] - advance[1]) * NANOSECONDS)
            self.dead_time.lateness = 0.5 * (held - period)
        self.dead_time.lateness += self.odometry_twist.lateness

    def _watch_reference(self, stamp_ns: int, elapsed: float) -> None:
        """Add up the time for which commands follow a reference that had ended before."""
        newest_ns = self._trajectory.newest_ns
        if newest_ns is None or newest_ns < stamp_ns + self._dead_time_ns:
            self._late_reference_for += elapsed
        else:  # one that is late at times is late
            self._late_reference_for = max(self._late_reference_for - 0.25 * elapsed, 0.0)

    def _reference_problem(self) -> str:
        """Return by how much the reference is too late to be followed, or nothing."""
        newest_ns, stamp_ns = self._trajectory.newest_ns, self._last_stamp_ns
        if self._late_reference_for <= REPORTED_DISTURBANCE or newest_ns is None:
            return ''
        lead = (newest_ns - (stamp_ns or 0)) / NANOSECONDS
        side = 'behind' if lead < 0.0 else 'ahead of'
        return (
            f'the newest reference is stamped {abs(lead):.3f} s {side} odom, and the robot '
            f'responds after {self._dead_time:.3f} s: it follows late; raise the lead of the '
            'reference (lead of reference_generator, 0.4 s), or synchronise the clocks'
        )

    def _noise_problem(self) -> str:
        """Return that the odometry has more noise than is set; late messages look alike."""
        configured = self.parameters.speed_filter.noise_variance
        noise = self.dead_time.noise_variance
        if not noise > max(REPORTED_NOISE[0] * configured, REPORTED_NOISE[1]):
            return ''
        return (
            f'the wheel speeds by the twist in odom have a noise of {noise:.2g} (rad/s)², '
            f'speed_filter.noise_variance is {configured:g}: set the parameter'
        )

    def _check_shaper(self) -> None:
        """Shape the commands for the frequency at which the robot turns out to oscillate.

        Its stiffness or its inertia are not those assumed; the other frequency changes alike.
        """
        assumed = self._turning_frequency
        if assumed == 0.0 or self._ahead_ns == 0:
            return
        found = self.body.turning_frequency
        if found == 0.0 or max(found / assumed, assumed / found) < OTHER_FREQUENCY:
            return
        self._turning_frequency = found
        configured = self.parameters.command_shaper
        factor = found / configured.turning_frequency
        straight = min(factor * configured.straight_frequency, HIGHEST)
        self._shaper.retune(InputShaperParameters(straight, found))

    def _follow_pose(self, odometry: State, begin: Array, end: Array, elapsed: float) -> None:
        """Change the plan from ``begin`` to ``end`` (rad/s) by pose loop and keep-out."""
        geometry, horizon = self.parameters.geometry, self._delay
        reference = self._pose_reference.at(odometry.stamp_ns + round(horizon * NANOSECONDS))
        if reference is None:
            return
        # The commands of the dead time are on their way: the robot will be there.
        command = WheelSpeeds(*self.actuation.command.tolist())
        pose = advance_pose(odometry.pose, twist_from_wheels(command, geometry), horizon)
        now, later = WheelSpeeds(*begin.tolist()), WheelSpeeds(*end.tolist())
        planned = twist_from_wheels(now, geometry)
        keep_out = self.keep_out
        learn = not self.disturbed and not (keep_out is not None and keep_out.changed)
        twist = self.pose_controller.step(reference, pose, planned, elapsed, learn=learn)
        if keep_out is not None:
            if self.pose_controller.rejoining:
                velocity = keep_out.guide(self.pose_controller.closing_velocity(planned), pose)
                twist = self.pose_controller.drive_along(velocity)
            twist = keep_out.step(twist, pose, elapsed)
        if self.pose_controller.rejoining or (keep_out is not None and keep_out.changed):
            later = now
        wheels = wheels_from_twist(twist, geometry)
        for i in range(2):
            begin[i] = wheels[i]
            end[i] = wheels[i] + (later[i] - now[i])

    def _plan_ahead(self, effect_ns: int) -> int:
        """Return the lead of the shaper, ns; 0 if the reference is not known that far ahead."""
        parameters, newest = self.parameters.jump_transition, self._trajectory.newest_ns
        lead = self._shaper.lead_ns
        usable = parameters.preview and parameters.method == 'ramp' and newest is not None
        return lead if usable and (newest or 0) >= effect_ns + lead + self._period_ns else 0

    def check_odometry(self, last_received_ns: int | None, now_ns: int) -> bool:
        """Whether the odometry has timed out, so that a stop must be commanded.

        Both times are from one clock of the caller. After a time-out the controller clears its
        state, and the next odometry message is a new start.
        """
        if not self._watchdog.check_silence(last_received_ns, now_ns):
            return False
        self._stop()
        self.status = self._make_status(self._last_stamp_ns or 0, Reason.NO_ODOMETRY)
        return True

    def _follow_unresponsive(
        self, odometry: State, elapsed: float, *, followed: bool
    ) -> tuple[BodyTwist, Status]:
        """Return the command where the twist does not follow; the pose may, as ``followed``."""
        by_pose = self._twist_believed and self._pose_response.responsive
        if not (followed and by_pose and self.odometry_twist.pose_is_prompt):
            return self._command_unresponsive(odometry, elapsed)
        self.odometry_twist.reject()  # from the next message on
        self._reset_response()
        self._add_command()
        return self.actuation.twist, self.status

    def _command_unresponsive(self, odometry: State, elapsed: float) -> tuple[BodyTwist, Status]:
        """Command the reference to a robot that does not follow commands; adaptation pauses.

        A stop would be permanent, because a restarted board needs commands to start. The weights
        return to a snapshot from before the fault. When the robot follows commands again, the
        law starts as after a stop, with these weights.
        """
        if self.status.reason is not Reason.NOT_FOLLOWING:
            self._tracker.reset()
            if self._snapshots:
                self._rollback(self._snapshots[0])
                self._snapshots.clear()
        speeds, reference, begin, end = self._sampled
        if self.parameters.pose.enabled:
            self._follow_pose(odometry, begin, end, elapsed)
            self.actuation.send_speeds(begin)
        else:
            self.actuation.send_speeds(reference)
        self._add_command()
        error = speeds - reference
        self.status = self._make_status(odometry.stamp_ns, Reason.NOT_FOLLOWING, error)
        return self.actuation.twist, self.status

    def _update_dead_time(self, speeds: Array, elapsed: float) -> None:
        """Update the dead time in use; after a disturbance, discard what was learnt during it."""
        estimator, actuation = self.dead_time, self.actuation
        dead_time, self.disturbed = self.parameters.speed_filter.dead_time, False
        if self.parameters.estimate_dead_time:
            by_pose = self._speeds_by_pose(elapsed)
            self.disturbed = estimator.step(speeds, actuation.command, elapsed, by_pose)
            dead_time = estimator.dead_time_in_use - self._excess_lag
            if self._is_too_fast_for_lag():
                self._excess_lag = self.parameters.speed_filter.lag - 0.5 * self._period
                self.dead_time = self._make_dead_time_estimator()
                self.dead_time.reset(speeds)
                dead_time = self.dead_time.dead_time_in_use - self._excess_lag
        if self.disturbed:
            self._disturbed_for += elapsed
        else:  # disturbances that come and go are one
            self._disturbed_for = max(self._disturbed_for - 0.25 * elapsed, 0.0)
        if self.disturbed and self._before_disturbance is None and self._snapshots:
            self._before_disturbance = self._snapshots[0]
            self._snapshots.clear()
        elif not self.disturbed and self._before_disturbance is not None:
            self._rollback(self._before_disturbance)
            self._before_disturbance = None
        longer = dead_time - self._dead_time
        if longer > MIN_DEAD_TIME_CHANGE and self.odometry_twist.may_be_late(longer):
            return  # comparisons with the pose decide that first
        if abs(longer) > MIN_DEAD_TIME_CHANGE and not self._is_contradicted(dead_time):
            self._set_dead_time(dead_time)

    def _speeds_by_pose(self, elapsed: float) -> Array:
        """Return the wheel speeds (rad/s) by a prompt pose beside the twist, else NaN.

        They are means since the last message; those of the twist must be of the same time.
        """
        twist = self.odometry_twist
        same_time = self.parameters.mean_speeds and elapsed < 1.5 * self._period
        if twist.replaced or not (same_time and twist.pose_is_prompt):
            return UNKNOWN
        return np.array(wheels_from_twist(twist.speeds_by_pose, self.parameters.geometry))

    def _is_contradicted(self, dead_time: float) -> bool:
        """Whether mean speed or pose contradict an estimated dead time (s): the twist is wrong."""
        if not self.parameters.estimate_dead_time:
            return False
        open_to_doubt = self.odometry_twist.may_turn_late(dead_time - self._dead_time)
        found, in_use = (each + self._excess_lag for each in (dead_time, self._dead_time))
        linear, by_pose = self.dead_time.contradictions(found, in_use)
        proven = self.odometry_twist.pose_is_proven
        return linear > LINEAR_EVIDENCE[not open_to_doubt] or (proven and by_pose > POSE_EVIDENCE)

    def _set_dead_time(self, dead_time: float) -> None:
        """Use a dead time (s); below 0 the robot responds before its lag has passed."""
        self._dead_time = dead_time
        self.actuation.set_dead_time(max(dead_time, 0.0))
        self._dead_time_ns = round(dead_time * NANOSECONDS)

    def _is_too_fast_for_lag(self) -> bool:
        """Whether wheels that follow their commands do so faster than their lag permits."""
        lag, estimator = self.parameters.speed_filter.lag, self.dead_time
        if self.parameters.composition != 'body' or lag <= 0.5 * self._period:
            return False
        if self._excess_lag > 0.0 or estimator.dead_time > NO_DEAD_TIME:
            return False
        configured = self.parameters.speed_filter.dead_time
        return estimator.evidence_against(configured) > USED_EVIDENCE

    def _make_dead_time_estimator(self) -> DeadTimeEstimator:
        # The pulses of a stepper ramp over a period, half a period late on average.
        filtered = self.parameters.speed_filter
        return DeadTimeEstimator(
            replace(filtered, lag=max(filtered.lag - self._excess_lag, 0.5 * self._period)),
            self._period,
            mean_speeds=self.parameters.mean_speeds,
            friction=self.parameters.composition == 'paper',
        )

    def _rollback(self, snapshot: tuple[Any, Any]) -> None:
        """Restore the weights of a snapshot."""
        weights, body = snapshot
        if weights:
            self.law.set_weights(weights)
        self.body.rollback(body)

    def _take_snapshot(self) -> None:
        """Store a snapshot of the weights once per SNAPSHOT_PERIOD, except while disturbed."""
        if self.disturbed:
            return
        self._steps_since_snapshot += 1
        if self._steps_since_snapshot >= self._snapshot_steps:
            self._steps_since_snapshot = 0
            learnt = self.law.get_weights() if self.parameters.composition == 'paper' else {}
            self._snapshots.append((learnt, self.body.snapshot()))

    def _announce_jumps(self, stamp_ns: int, effect_ns: int) -> None:
        """Announce jumps to the transition: in advance with preview, else when they occur."""
        newest = self._trajectory.newest_ns or 0
        preview, geometry = self.parameters.jump_transition.preview, self.parameters.geometry
        soon_ns = effect_ns + self._period_ns if preview else stamp_ns
        for jump in self._jumps:
            # With preview, the sample after the jump must be known, for the slope after it.
            known = jump.stamp_ns <= soon_ns or (preview and newest > jump.stamp_ns)
            if known and jump.stamp_ns not in self._announced:
                self._announced.add(jump.stamp_ns)
                after = self._trajectory.at(jump.stamp_ns)
                slope = STANDSTILL if after is None else after.rate
                self._tracker.transition.announce(
                    jump.stamp_ns,
                    np.array(wheels_from_twist(jump.change, geometry)),
                    np.array(wheels_from_twist(slope, geometry)),
                )
        self._jumps = [
            jump
            for jump in self._jumps
            if jump.stamp_ns > effect_ns or jump.stamp_ns not in self._announced
        ]
        self._announced.intersection_update(jump.stamp_ns for jump in self._jumps)

    def _clear_reference(self) -> None:
        self._trajectory.clear()
        self._pose_reference.clear()
        self._jumps.clear()
        self._announced.clear()

    def _stop(self) -> None:
        if self._moving or np.any(self.actuation.command):
            self._tracker.reset()
            self.actuation.reset(np.zeros(2))
        self._moving = False

    def _make_status(
        self,
        stamp_ns: int,
        reason: Reason,
        error: Array | None = None,
        applied: Array | None = None,
    ) -> Status:
        law = self.law
        return Status(
            stamp_ns,
            reason,
            np.full(2, math.nan) if error is None else error,
            np.zeros_like(law.terms) if applied is None else law.terms.copy(),
            np.zeros(2) if applied is None else applied,
            law.certificate,
            law.predictive.skill,
            reason.moves and self.actuation.limited,
        )


class SwitchingTracker:
    """Computes the accelerations that track a reference with jumps.

    All times are the instant at which the result takes effect.

    drive : ``'velocity'`` or ``'torque'``; with ``'velocity'`` the transition includes the servo
        lag
    motor_limit : of a torque drive, if it is known
    """

    def __init__(
        self, parameters: Nt3fsMpcParameters, drive: str, motor_limit: MotorLimit | None = None
    ) -> None:
        self.parameters = parameters
        self._period = 1.0 / parameters.rate
        self.law = Nt3fsMpcController(parameters)
        lag = parameters.speed_filter.lag if drive == 'velocity' else 0.0
        self.transition = JumpTransition(
            parameters.jump_transition, lag, self._period, motor_limit
        )

    def configure(self, parameters: Nt3fsMpcParameters) -> None:
        """Use new values of the dynamic parameters from the next step on."""
        self.parameters = parameters
        self.law.configure(parameters)
        self.transition.parameters = parameters.jump_transition

    def reset(self) -> None:
        """Discard jumps and state; the weights are kept."""
        self.law.reset()
        self.transition.reset()

    def begin(self, now_ns: int, speeds: Array, reference: Array) -> None:
        """Start at the present wheel speeds; their distance to the reference is a jump."""
        self.reset()
        self.transition.announce(now_ns, reference - speeds, np.zeros(2))

    def step(
        self, now_ns: int, speeds: Array, reference: Array, reference_next: Array, dt: float
    ) -> Array:
        """Return u (rad/s²), shape (2,), which takes effect at ``now_ns``.

        reference, reference_next : at that instant and one period later, including jumps, rad/s
        """
        if self.parameters.jump_transition.method == 'predictive':
            return self._step_predictive(now_ns, speeds, reference, reference_next, dt)
        return self.law.step(speeds, *self.plan(now_ns, reference, reference_next, dt), dt)

    def plan(
        self, now_ns: int, reference: Array, reference_next: Array, dt: float
    ) -> tuple[Array, Array]:
        """Return reachable reference (rad/s) and its rate (rad/s²) at ``now_ns``, shape (2,).

        The ramps of jumps go on through the time without a step, ``dt`` s since the last one.
        """
        transition, share = self.transition, 1.0
        if transition.count:
            periods = min(round(dt / self._period, 6), MAX_MISSED)
            missed = max(math.ceil(periods) - 1, 0)
            share = periods - missed  # of a period, until the first step; the others have a whole
            for k in range(missed, 0, -1):
                missed_ns = now_ns - round(k * self._period * NANOSECONDS)
                jumps = -transition.future_jumps(missed_ns, self._period, 1)[0]
                transition.step(missed_ns, reference, reference + jumps, share)
                share = 1.0
        transition.step(now_ns, reference, reference_next, share)
        return transition.reachable, transition.rate

    def _step_predictive(
        self, now_ns: int, speeds: Array, reference: Array, reference_next: Array, dt: float
    ) -> Array:
        """Return u with the jumps as known disturbances in Psi_free (56)."""
        predictive, transition = self.law.predictive, self.transition
        until_ns = now_ns + round(self._period * 1e9)
        predictive.notify_jump(-transition.pop_passed(now_ns))
        change = None
        if predictive.due:
            horizon = predictive.parameters.horizon
            change = transition.future_jumps(now_ns, predictive.span, horizon)
        soon = -transition.future_jumps(now_ns, (until_ns - now_ns) / 1e9, 1)[0]
        rate = (reference_next - soon - reference) / self._period
        return self.law.step(speeds, reference, rate, dt, change)


wheel_speeds = kernel(kinematics.wheel_speeds)


class Sampling(NamedTuple):
    """Parameters of :func:`sample_reference`."""

    period: float  # control period, s
    hold_ns: float  # how long the newest sample is held
    preview: bool  # whether to use future samples; else the slope extrapolates the reference
    radius: float  # wheel radius, m
    half: float  # half of the wheel separation, m

    @classmethod
    def of(cls, parameters: ControllerParameters) -> Self:
        """Return those of a controller."""
        return cls(
            1.0 / parameters.rate,
            parameters.watchdog.reference_timeout * NANOSECONDS,
            parameters.jump_transition.preview,
            parameters.geometry.wheel_radius,
            parameters.geometry.half_separation,
        )


class SampledReference(NamedTuple):
    """Results of :func:`sample_reference`: wheel speeds, rad/s, shape (2,) each."""

    speeds: Array  # measured, at the stamp of the odometry
    reference: Array  # reference at that stamp
    begin: Array  # reference when the next command takes effect
    end: Array  # reference one period later


@kernel
def sample_reference(
    trajectory: TrajectorySamples,
    stamp_ns: int,
    effect_ns: int,
    linear: float,
    angular: float,
    sampling: Sampling,
    result: SampledReference,
) -> tuple[bool, float, float]:
    """Write measured and reference wheel speeds; return whether the reference is known.

    Also return the largest magnitudes of the measured speeds and of the tracking error. The next
    command takes effect at ``effect_ns``.
    """
    speeds, reference, begin, end = result
    period, hold_ns, preview, radius, half = sampling
    speeds[0], speeds[1] = wheel_speeds(linear, angular, radius, half)
    speed = max(abs(speeds[0]), abs(speeds[1]))
    first, last = trajectory.bounds[0], trajectory.bounds[1] - 1
    newest = trajectory.stamps[last] if last >= first else 0
    known, v, w, v_rate, w_rate = interpolate(trajectory, hold_newest(stamp_ns, newest, hold_ns))
    if not known:
        reference[:] = math.nan
        return False, speed, 0.0
    reference[0], reference[1] = wheel_speeds(v, w, radius, half)
    error = max(abs(speeds[0] - reference[0]), abs(speeds[1] - reference[1]))
    if preview:
        until_ns = effect_ns + round(period * NANOSECONDS)
        begin_ns = hold_newest(effect_ns, newest, hold_ns)
        end_ns = hold_newest(until_ns, newest, hold_ns)
        begin_known, v_begin, w_begin, _, _ = interpolate(trajectory, begin_ns)
        end_known, v_end, w_end, _, _ = interpolate(trajectory, end_ns)
        if begin_known and end_known:
            begin[0], begin[1] = wheel_speeds(v_begin, w_begin, radius, half)
            end[0], end[1] = wheel_speeds(v_end, w_end, radius, half)
            return True, speed, error
    slopes = wheel_speeds(v_rate, w_rate, radius, half)
    ahead = (effect_ns - stamp_ns) / NANOSECONDS
    for i in range(2):
        begin[i] = reference[i] + ahead * slopes[i]
        end[i] = reference[i] + (ahead + period) * slopes[i]
    return True, speed, error


@kernel
def hold_newest(stamp_ns: int, newest_ns: int, hold_ns: float) -> int:
    """Return the instant to interpolate at: the newest sample holds for ``hold_ns``."""
    return newest_ns if 0 < stamp_ns - newest_ns <= hold_ns else stamp_ns


def _limits_in_use(parameters: ControllerParameters) -> LimitParameters:
    """Return the limits of the commands; no deadband where no rotor oscillates, or on a path.

    The pose loop keeps to a path within less than what a deadband leaves behind.
    """
    if any(parameters.command_shaper.delays) and not parameters.pose.enabled:
        return parameters.limits
    return replace(parameters.limits, deadband=0.0)


def _largest(limits: LimitParameters) -> BodyTwist:
    """Return the largest |v| and |omega| of a command."""
    return BodyTwist(limits.linear, limits.angular)


def _least_jump(limits: LimitParameters) -> BodyTwist:
    """Return the accelerations (m/s², rad/s²) above which the reference jumps."""
    return BodyTwist(
        JUMP_DETECTION_FACTOR * limits.linear_acceleration,
        JUMP_DETECTION_FACTOR * limits.angular_acceleration,
    )


def _command_limit(parameters: ControllerParameters) -> CommandLimit:
    """Return the acceleration limits of the command for the ramps of jumps."""
    mean, half, wheel = wheel_limits(parameters.limits, parameters.geometry)[1].tolist()
    return CommandLimit(mean, half, wheel, parameters.jump_transition.acceleration)
