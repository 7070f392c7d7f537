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
"""How to build and to use each object with a state: for test_fresh_state.py.

A drive uses the object in all ways that change it, for longer than its buffers are long.
"""

from collections.abc import Callable
import math
import random
from types import SimpleNamespace

import numpy as np

from support.fresh_state import OPAQUE, Configured, Operation, Stateful
from t3mpc_ros.chaos.pose_reference import (
    PathClock,
    PathReferenceParameters,
    PortraitSource,
    TwistSource,
    WaitParameters,
)
from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.control.body_correction import SKILL as SKILL_FIELDS
from t3mpc_ros.control.body_correction import BodyCorrection, BodyCorrectionParameters
from t3mpc_ros.control.controller import (
    Controller,
    ControllerParameters,
    StepperControllerParameters,
)
from t3mpc_ros.control.dead_time_estimator import DeadTimeEstimator
from t3mpc_ros.control.keep_out import KeepOut, KeepOutParameters
from t3mpc_ros.control.pose_controller import (
    PoseController,
    PoseLoopParameters,
)
from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters, SpeedKalmanFilter
from t3mpc_ros.control.watchdog import InputWatchdog, ResponseMonitor, WatchdogParameters
from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import FAULT_KINDS, Fault, FaultInjection
from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.emulator.serial_line import SerialLine
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.obstacles import Obstacles
from t3mpc_ros.geometry.sample_scheduler import RealTimeFactor, SampleScheduler, SimulatedTime
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, State, WheelSpeeds
from t3mpc_ros.mpc.predictive_controller import PredictiveController, PredictiveParameters
from t3mpc_ros.robot.command_limiter import CommandLimiter, CommandLimiterParameters
from t3mpc_ros.robot.gyro_odometry import GyroOdometry, GyroOdometryParameters
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters
from t3mpc_ros.simulation.sensors.battery import SimulatedBattery, SimulatedBatteryParameters
from t3mpc_ros.simulation.sensors.imu import SimulatedImu, SimulatedImuParameters
from t3mpc_ros.simulation.sensors.range_sensor import (
    SimulatedRangeSensorParameters,
    SimulatedRangeSensors,
)

BODY_PARAMETERS = BodyCorrectionParameters(gyro_scale_tolerance=0.001)
PERIOD, PERIOD_NS = 0.01, 10_000_000
GEOMETRY = WheelGeometry()
Random = random.Random


def pair(r: Random, size: float = 5.0) -> np.ndarray:
    """Return two numbers, now and then zero or far beyond every limit."""
    scale = r.choice((size, size, size, 0.0, 0.02 * size, 20.0 * size))
    return np.array([scale * r.gauss(0.0, 1.0), scale * r.gauss(0.0, 1.0)])


def pose(r: Random, size: float = 0.5) -> Pose:
    """Return a random pose."""
    return Pose(r.gauss(0.0, size), r.gauss(0.0, size), r.uniform(-math.pi, math.pi))


def gap(r: Random) -> float:
    """Return a period, now and then a long one, s."""
    return r.choice((PERIOD, PERIOD, PERIOD, 0.9 * PERIOD, 3.1 * PERIOD, 0.3))


def properties(thing: object, *names: str) -> list[object]:
    """Return what the named properties are now; arrays are copied."""
    found = [getattr(thing, name) for name in names]
    return [each.copy() if isinstance(each, np.ndarray) else each for each in found]


# -- control --------------------------------------------------------------------------------------


def drive_filter(kalman, r):
    """Send commands and measure speeds."""
    found = []
    for _ in range(20):
        kalman.update(pair(r), pair(r), gap(r), sent=r.random() < 0.9)
        found += [*(array.copy() for array in kalman.state), kalman.dead_time]
    return found


def drive_response(monitor, r):
    """Give commands that the robot does not follow; it ends with evidence against the decision."""
    found = []
    for k in range(r.randrange(40, 120)):
        monitor.add_command(9.0, 9.0)
        speed = 9.0 if k % 50 < 20 else 0.0
        found.append((monitor.update(speed, speed), monitor.evidence))
    for _ in range(5):
        monitor.add_command(9.0, 9.0)
        speed = 0.0 if monitor.responsive else 9.0
        found.append((monitor.update(speed, speed), monitor.evidence))
    return found


def drive_estimator(estimator, r):
    """Measure a servo with another dead time, friction and a disturbance."""
    found, speeds, sent = [], np.zeros(2), [np.zeros(2)] * 6
    for k in range(300):
        command = np.array([4.0 * math.sin(0.11 * k), 5.0 * math.cos(0.07 * k)])
        speeds = speeds + 0.4 * (sent[-4] - speeds)
        measured = speeds + (pair(r, 3.0) if 200 < k < 230 else 0.05 * pair(r, 1.0))
        sent.append(command)
        found.append(estimator.step(measured, command, gap(r) if r.random() < 0.05 else PERIOD))
        found += properties(estimator, 'dead_time', 'dead_time_in_use', 'standard_deviation')
        found.append(float(estimator.estimate.noise_ratio))
    return found


def drive_keep_out(keep_out, r):
    """Drive towards walls, look around, be stuck, and fail to move."""
    found, at = [], pose(r, 0.1)
    for k in range(400):
        keep_out.map.add_reading(
            r.randrange(8), r.choice((0.3, 0.6, math.inf, -math.inf, math.nan)), at
        )
        twist = keep_out.step(BodyTwist(0.25, r.gauss(0.0, 0.3)), at, 0.05)
        found += [twist, keep_out.activity, keep_out.changed]
        found.append(keep_out.guide((0.2, r.gauss(0.0, 0.2)), at))
        if k % 200 < 100:
            yaw = at.yaw + 0.05 * twist.angular
            move = 0.05 * twist.linear
            at = Pose(at.x + move * math.cos(yaw), at.y + move * math.sin(yaw), yaw)
    return found


def make_keep_out():
    """Return a keep-out before a known wall, which is soon stuck."""
    parameters = KeepOutParameters.from_dict({'stuck_time': 1.0, 'map.half_size': 1.5})
    wall = Obstacles(np.array([[0.5, -1.0, 0.5, 1.0]]), np.array([[-0.5, 0.5, 0.1]]))
    return KeepOut(parameters, BodyTwist(0.3, 3.0), wall)


def drive_body(body, r):
    """Turn with wheels other than the nominal ones, with gaps."""
    found, yaw, sent = [], r.uniform(-3.0, 3.0), np.zeros(2)
    for k in range(300):
        elapsed = gap(r) if r.random() < 0.1 else PERIOD
        wanted = np.array([6.0 + 3.0 * math.sin(0.1 * k), 2.0]) + 0.1 * pair(r, 0.1)
        yaw += elapsed * 1.1 * (sent[0] - sent[1]) * 0.5 * 0.035 / 0.0735 + r.gauss(0.0, 1e-4)
        learn = k % 90 > 5
        found.append(body.step(yaw, elapsed, wanted, wanted, sent, 0.02, learn=learn))
        found += [body.authority, body.yaw_error]
        sent = wanted
    return found


def make_body(parameters=BODY_PARAMETERS):
    """Return the correction of the default robot."""
    return BodyCorrection(parameters, 0.035, 0.0735, PERIOD)


def drive_pose_controller(controller, r):
    """Leave the reference, and come back; it ends on the way."""
    found = []
    for k in range(20):
        away = Pose(*(0.1 * pair(r, 1.0)).tolist(), 0.1) if k < 19 else Pose(1.0, 0.0, 0.0)
        twist = controller.step(ORIGIN, away, BodyTwist(0.2, 0.1), 0.01)
        found += [twist, controller.rejoining]
        found.append(controller.error)
    return found


def drive_controller(controller, r):
    """Track jumps and curves with gaps, restarts, and a robot that does not follow."""
    found, speeds, at = [], np.zeros(2), pose(r, 0.1)
    now = r.randrange(10**9)
    for k in range(r.randrange(230, 300)):
        now += round(1e9 * gap(r)) if r.random() < 0.01 else PERIOD_NS
        if r.random() < 0.004:
            now -= 10**9  # the clock of the robot restarts
        target = BodyTwist(0.15 if k % 80 < 40 else -0.1, 1.5 * math.sin(0.05 * k))
        if k % 150 < 140:
            ahead = State(now + 20 * PERIOD_NS, Pose(at.x + 0.05, at.y, at.yaw), target)
            found.append(controller.add_reference(ahead))
        controller.add_range(r.randrange(8), r.choice((0.4, math.inf, math.nan)))
        command = np.array(controller.actuation.command)
        share = 0.0 if 150 < k < 185 else 0.7
        speeds = speeds + share * (command - speeds) + 0.02 * pair(r, 1.0)
        twist = BodyTwist(0.0175 * (speeds[0] + speeds[1]), 0.238 * (speeds[0] - speeds[1]))
        yaw = at.yaw + 0.011 * twist.angular
        x, y = (
            at.x + PERIOD * twist.linear * math.cos(yaw),
            at.y + PERIOD * twist.linear * math.sin(yaw),
        )
        at = Pose(x, y, yaw)
        if r.random() < 0.01:
            twist = BodyTwist(math.nan, 0.0)
        command, status = controller.step(State(now, at, twist))
        found += [command, status.reason, status.scalars, controller.disturbed, controller.gain]
        found += properties(controller.dead_time, 'dead_time', 'standard_deviation')
        if r.random() < 0.01:
            controller.enable(False)
        elif r.random() < 0.3:
            controller.enable(True)
        if r.random() < 0.005:
            found.append(controller.check_odometry(now, now + 10**9))
    controller.enable(r.random() < 0.5)
    return found


def make_controller(
    table=StepperControllerParameters, **values: object
) -> Callable[[], Controller]:
    """Return what makes a controller."""
    given = {'predictive.dither': 0.5, **{k.replace('__', '.'): v for k, v in values.items()}}
    parameters = table.from_dict(given)
    return lambda: Controller(parameters)


DITHERED = PredictiveParameters(dither=0.5)


def drive_predictive(controller, r):
    """Give errors with known jumps, and apply less than v_p."""
    found = []
    for k in range(130):
        found.append(controller.step(np.array([math.sin(0.05 * k), 1.0]) + 0.02 * pair(r, 1.0)))
        found += [controller.skill, *map(np.copy, (*controller.signals, *controller.responses))]
        found += properties(controller, 'due', 'solved')
        if r.random() < 0.1:
            controller.signals.applied[:] = 0.5 * found[0]
        if r.random() < 0.03:
            controller.notify_jump(pair(r, 3.0))
    return found


def other_weights(controller):
    """Return weights of another seed."""
    return PredictiveController(PredictiveParameters(seed=5), PERIOD, 15.0).get_weights()


WEIGHTS = other_weights(None)


# -- chaos ----------------------------------------------------------------------------------------

CHAOS = {'settle': 1.0, 'switching.times': (0.5, 1.0), 'switching.blend': 0.2, 'ramp': 0.3}


def drive_clock(clock, r):
    """Give samples of the reference and poses of a robot that lags behind."""
    found, stamp = [], 10**9
    for k in range(100):
        stamp += PERIOD_NS
        clock.add_reference(stamp + 5 * PERIOD_NS, Pose(0.01 * k, 0.0, 0.0))
        clock.observe(stamp, Pose(0.004 * k + r.gauss(0.0, 0.01), 0.0, 0.0))
        found.append(clock.rate)
    return found


def drive_source(source, r):
    """Take samples, at a rate that changes."""
    return [source.advance(r.choice((1.0, 1.0, 0.5, 0.0))) for _ in range(60)]


def make_portrait():
    """Return a chaotic path with new seeds after random times."""
    parameters = PathReferenceParameters.from_dict(
        {'settle': 1.0, 'reseed.shortest': 0.3, 'reseed.longest': 0.5, 'source': 'portrait'}
    )
    return PortraitSource(parameters, GEOMETRY, ORIGIN, 3, lambda: 8)


def drive_twist(source, r):
    """Command twists, some of which expire."""
    found = []
    for _ in range(100):
        if r.random() < 0.1:
            found.append(source.set_target(BodyTwist(*pair(r, 0.3).tolist())))
        found.append(source.advance(r.choice((1.0, 0.5))))
    source.set_target(BodyTwist(0.2, 1.0))
    return found


def drive_reference(reference, r):
    """Take samples."""
    return [reference.advance() for _ in range(r.randrange(120, 150))]


# -- robot, geometry ------------------------------------------------------------------------------


def drive_limiter(limiter, r):
    """Command, stop and release in any order, with gaps; it ends while it follows a command."""
    found, now = [], max(limiter._clock_ns or 0, 0)
    for _ in range(60):
        now += round(1e9 * gap(r))
        stamp = now - r.choice((0, 0, 0, 10**7, -(10**7), 3 * 10**8))
        wheels = WheelSpeeds(*pair(r, 8.0).tolist())
        if r.random() < 0.05:
            wheels = WheelSpeeds(math.nan, 0.0)
        act = r.random()
        if act < 0.7:
            found.append(limiter.accept(RobotCommand(wheels, stamp), now))
        elif act < 0.75:
            limiter.stop('because', now)
        elif act < 0.8:
            limiter.latch('because', now)
        elif act < 0.9:
            found.append(limiter.release(now))
        elif act < 0.92:
            limiter.assume_standstill()
        found.append(limiter.advance(now, PERIOD))
        found += properties(limiter, 'estop', 'timed_out', 'reason')
        found.append(limiter.remaining_ns(now))
    limiter.release(now)
    limiter.accept(RobotCommand(WheelSpeeds(5.0, 3.0), now), now)
    found.append(limiter.advance(now, PERIOD))
    return found


def latch_and_release(limiter):
    """Latch the emergency stop and release it, long after the history."""
    limiter.latch('because', 10**11)
    limiter.release(10**11)


def drive_gyro(odometry, r):
    """Stand, turn, slip, be pushed, and lose the sensor; it ends in the middle of a standstill."""
    found, pushed = [], r.randrange(100, 140)
    for k in range(650):
        phase = k % 400
        turn = 0.0 if phase < 250 else 0.05
        gyro = 0.02 + 0.75 * turn * 0.238 / PERIOD + r.gauss(0.0, 1e-3)
        if pushed < phase < pushed + 5 or 330 < phase < r.choice((330, 360)):
            gyro += 2.0
        absent = 300 < phase < 305
        odometry.update(turn, -0.5 * turn, None if absent else gyro, PERIOD, r.choice((0.0, 1e-6)))
        found += properties(
            odometry, 'pose', 'covariance', 'bias', 'bias_std', 'calibrated', 'slipping_for'
        )
    slips = r.random() < 0.5
    for _ in range(r.randrange(20, 40)):
        odometry.update(0.1 * slips, 0.0, 0.02 + r.gauss(0.0, 1e-3), PERIOD)
    return found


def drive_scheduler(scheduler, r):
    """Call late and early."""
    found, now = [], 10**9 + r.randrange(10**9)
    for _ in range(30):
        now += r.choice((PERIOD_NS, PERIOD_NS - 1000, PERIOD_NS + 999, 10**9))
        found += [scheduler.due(now), scheduler.lateness(now), scheduler.skipped]
    return found


def drive_time(clock, r):
    """Let the steady clock run, with other factors; it ends while it runs."""
    steady = 10**9
    found = [clock.due(steady)]
    for _ in range(30):
        steady += round(1e9 * gap(r))
        if r.random() < 0.2:
            clock.set_real_time_factor(r.choice((0.0, 1.0, 7.0)), steady)
        if clock.real_time_factor == 0.0:
            found.append(clock.step(r.randrange(3)))
        found += [clock.due(steady), clock.now_ns(steady)]
    clock.set_real_time_factor(2.0, steady)
    found.append(clock.due(steady))
    return found


def drive_factor(factor, r):
    """Let both clocks run."""
    found, steady = [], 0
    for _ in range(30):
        steady += r.randrange(10**9)
        factor.update(2 * steady, steady)
        found.append(factor.value)
    return found


# -- simulation, emulator -------------------------------------------------------------------------


def drive_robot(robot, r):
    """Drive, stop, latch, and let time jump; it ends at rest."""
    found, now = [], robot._reached_ns
    for _ in range(25):
        now += r.choice((PERIOD_NS,) * 8 + (3 * PERIOD_NS, 15 * 10**6, -(10**9), 10**10))
        now = max(now, 0)
        found.append(robot.apply(RobotCommand(WheelSpeeds(*pair(r, 3.0).tolist()), now), now))
        act = r.random()
        if act < 0.05:
            robot.stop('because', now)
        elif act < 0.1:
            robot.latch_estop('because', now)
        elif act < 0.3:
            found.append(robot.release_estop(now))
        elif act < 0.35:
            found.append(robot.reset_odometry(now))
        found.append(robot.advance(now))
    robot.stop('the end', now)
    found.append(robot.advance(now + 4 * 10**8))
    return found


def drive_imu(imu, r):
    """Measure, most often at one period."""
    found = []
    for _ in range(30):
        filtered = np.array([[0.0, r.gauss(0.0, 1.0)] for _ in range(3)])
        found.append(imu.measure(filtered, PERIOD, r.choice((0.0, 0.3))))
        found += [imu.bias, imu.counts]
    return found


def drive_ranges(ranges, r):
    """Measure what is due."""
    found = []
    for _ in range(30):
        for sensor in ranges.due(gap(r)):
            ranges.measure(sensor, r.choice((0.05, 0.3, 0.7, math.inf)))
        found += [ranges.readings, ranges.counts, ranges.periods]
    return found


def drive_battery(battery, r):
    """Draw power, with sags about both thresholds."""
    return [
        (
            battery.draw(r.uniform(0.0, 30.0), 1.0, r.uniform(0.0, 5.0)),
            battery.low,
            battery.collapsed,
        )
        for _ in range(60)
    ]


def drive_plant(plant, r):
    """Issue pulses."""
    found = []
    for _ in range(40):
        plant.set_motors(r.random() < 0.9, r.random() < 0.9)
        found.append(plant.run(1000 * r.randrange(1, 9), r.uniform(0.0, 9.0), 5.0))
        plant.imu_absent = r.random() < 0.1
        found += properties(
            plant, 'pulses', 'pose', 'wheels', 'registers', 'adc_counts', 'until_sample_us'
        )
    plant.imu_absent = False
    return found


def make_line():
    """Return a serial line with faults, and what it has delivered."""
    events, delivered = EventQueue(0), []
    faults = FaultInjection(lambda: events.now_ns, 1)
    for name in ('reorder', 'split', 'flip_bits'):
        faults.add(Fault(name, 0.0, math.inf, 0.3), 0)
    return SimpleNamespace(
        line=SerialLine(events, faults, delivered.append), events=events, delivered=delivered
    )


def drive_line(bench, r):
    """Send blocks; some are under way at the end, one is held."""
    del bench.delivered[:]
    for _ in range(20):
        bench.line.send(r.randbytes(r.randrange(1, 40)))
        bench.events.run_to(bench.events.now_ns + r.randrange(10**6))
    return list(bench.delivered)


def clear_line(bench):
    """Clear the line, and wait for what may still arrive."""
    bench.line.clear()
    del bench.delivered[:]
    bench.events.run_to(10**12)


def drive_injection(faults, r):
    """Add faults of each kind, and let random ones occur."""
    found = []
    for _ in range(60):
        kind = r.choice(FAULT_KINDS)
        if r.random() < 0.5:
            faults.add(Fault(kind.name, 0.0, r.choice((1e-9, 1.0, math.inf))), 0)
        found += [faults.occurs(kind.name), faults.interval(kind.name), faults.active(kind.name)]
    return found


# -- the table ------------------------------------------------------------------------------------

LAST = (
    '._output.command',
    '._output.estimate',
    '._output.terms',
    '.command',
    '.terms',
    '.fuzzy._phi',
    '.fuzzy.tables.phi',
)
"""What the last step of the law has written."""
ALPHA = (
    *('.fuzzy.tables.coefficients', '.fuzzy._coefficients'),
    *('._friction.coefficients', '._inertia.coefficients'),
)
MACHINE = tuple(
    f'._{each}.{name}'
    for each in ('predictors[0].state', 'predictors[1].state', 'wheels[0]', 'wheels[1]')
    for name in (
        *('history.persistence_mse', 'history.prediction_mse', 'machine.output_weights'),
        *('machine.visible_weights', 'rls.information', 'rls.power'),
    )
)
SKILL = '.signals.skills', '.skill'
RAMPS = '.plan.rate', '.plan.reachable', '.rate', '.reachable', '._transitions'
BODY_SKILL = tuple(
    f'{memory}.{name}' for memory in ('._memory[0]', '._state.memory[0]') for name in SKILL_FIELDS
)
BODY_OLD = tuple(
    f'{memory}.{name}'
    for memory in ('._memory[0]', '._state.memory[0]')
    for name in ('yaw', 'last_reference', 'last')
)
GYRO_RESPONSE = 'first_pole', 'second_pole', 'last_rate', 'last_dt', 'standstill_for'


def below(name: str, paths: tuple[str, ...]) -> tuple[str, ...]:
    """Return the paths below an attribute."""
    return tuple(f'{name}{path}' for path in paths)


def all_of(thing: object, *without: str) -> tuple[str, ...]:
    """Return the paths of all attributes but some."""
    return tuple(
        f'.{name}'
        for name, part in vars(thing).items()
        if name not in without and not isinstance(part, OPAQUE)
    )


UNUSED = (
    '._sampled',
    *below('._tracker.transition', RAMPS),
    *below('._tracker.law', LAST[:5]),
    *('._trajectory.buffer.samples', '._trajectory.buffer.stamps'),
)
"""What a reset controller writes before it reads it."""
IMU_TUNING = '._colour', '._dt', '._walk_step'
BODY = (
    *('._arrays.state', '._arrays.modes', '._arrays.totals', '._state', '._modes', '._now'),
    '.steps_done',
)
TWIN = DigitalTwinParameters.from_dict(
    {'noise.variance': 0.04, 'faults.command_loss': 0.2, 'faults.slippery': 0.02}
)
PAPER = PaperRobotParameters.from_dict({'noise.variance': 0.04})


def used_weights():
    """Return the weights of a controller that has learnt."""
    controller = make_controller(ControllerParameters, friction__gamma=5.0)()
    drive_controller(controller, Random(7))
    return {name: 1.0 + array for name, array in controller.get_weights().items()} | {
        name: array for name, array in controller.get_weights().items() if 'scales' in name
    }


OTHER_WEIGHTS = used_weights()
SPEEDS = np.array([2.0, 1.0])
FRESH = {
    # control
    SpeedKalmanFilter: Stateful(
        lambda: SpeedKalmanFilter(SpeedFilterParameters(), 'velocity', PERIOD),
        drive_filter,
        {
            'reset': Operation(lambda f: f.reset(SPEEDS)),
            'set_dead_time': Operation(
                lambda f: f.set_dead_time(0.0437),
                kept=('.state',),
                continued=('._commands',),
                scratch=('.parameters.dead_time',),
                built=lambda: SpeedKalmanFilter(
                    SpeedFilterParameters(dead_time=0.0437), 'velocity', PERIOD
                ),
            ),
        },
    ),
    BodyCorrection: Stateful(
        make_body,
        drive_body,
        {
            'reset': Operation(lambda b: b.reset()),
            'restart': Operation(
                lambda b: b.restart(),
                kept=('._state.estimate', '._state.covariance', *BODY_SKILL),
                scratch=BODY_OLD,
            ),
        },
    ),
    ResponseMonitor: Stateful(
        lambda: ResponseMonitor(WatchdogParameters(), PERIOD),
        drive_response,
        {'reset': Operation(lambda m: m.reset())},
    ),
    DeadTimeEstimator: Stateful(
        lambda: DeadTimeEstimator(SpeedFilterParameters(), PERIOD, friction=True),
        drive_estimator,
        {
            'reset': Operation(
                lambda e: e.reset(SPEEDS),
                kept=below(
                    '._state',
                    (
                        *(
                            '.dead_time',
                            '.deviation',
                            '.noise_ratio',
                            '.noise_count',
                            '.support',
                            '.change',
                        ),
                        *('.friction', '.covariance', '.accepted', '.recent', '.rejected'),
                    ),
                ),
            )
        },
    ),
    KeepOut: Stateful(
        make_keep_out,
        drive_keep_out,
        {'reset': Operation(lambda k: k.reset(), scratch=('._nearest', '._rows'))},
    ),
    Controller: Stateful(
        make_controller(pose__enabled=True, keep_out__enabled=True),
        drive_controller,
        {
            'reset': Operation(
                lambda c: c.reset(),
                kept=('._watchdog.enabled',),
                scratch=(
                    *('._ahead_ns', '._sampled', '.keep_out._nearest'),
                    *below('._tracker.transition', RAMPS),
                    *below('._tracker.law', (LAST[0], *LAST[2:5])),
                    *('._trajectory.buffer.samples', '._trajectory.buffer.stamps'),
                ),
            )
        },
    ),
    'Controller, paper': Stateful(
        make_controller(ControllerParameters, pose__enabled=True, friction__gamma=5.0),
        drive_controller,
        {
            'reset': Operation(
                lambda c: c.reset(),
                kept=('._watchdog.enabled',),
                scratch=UNUSED,
            ),
            'a time-out of the odometry': Operation(
                lambda c: c.check_odometry(None, 0),
                kept=(
                    *all_of(
                        make_controller(ControllerParameters)(),
                        *('_tracker', 'actuation', '_moving', 'status', '_watchdog'),
                    ),
                    *below('._watchdog', all_of(InputWatchdog(WatchdogParameters()), '_silent')),
                    *below('._tracker.law', (*ALPHA, *below('.predictive', MACHINE))),
                ),
                continued=below('._tracker.law.predictive', SKILL),
                scratch=(
                    *below('._tracker.law', LAST),
                    *below('._tracker.transition', RAMPS),
                    '.status.stamp_ns',
                ),
            ),
            'set_weights': Operation(
                lambda c: (c.reset(), c.set_weights(OTHER_WEIGHTS)),
                kept=('._watchdog.enabled',),
                scratch=UNUSED,
            ),
        },
    ),
    # mpc
    PredictiveController: Stateful(
        lambda: PredictiveController(DITHERED, PERIOD, 15.0),
        drive_predictive,
        {
            'reset': Operation(lambda c: c.reset(), kept=MACHINE, continued=SKILL),
            'pretrain': Operation(lambda c: c.pretrain()),
            'set_weights': Operation(lambda c: c.set_weights(WEIGHTS)),
        },
    ),
    # chaos
    PathClock: Stateful(
        lambda: PathClock(WaitParameters()),
        drive_clock,
        {
            'a restart of the reference': Operation(
                lambda c: c.add_reference(0, ORIGIN),
                kept=('._held', '._nearest', '._set_off', '._stamp_ns', '._start', '.rate'),
            ),
            'the robot is where it should be': Operation(
                lambda c: (c.add_reference(2 * 10**9, ORIGIN), c.observe(2 * 10**9, ORIGIN)),
                kept=('._set_off', '._start'),
            ),
        },
    ),
    PortraitSource: Stateful(
        make_portrait,
        drive_source,
        {
            'reseed': Operation(
                lambda s: s.reseed(7),
                kept=('._path._carried', '._path._last', '._path._tail', '._timing'),
            )
        },
    ),
    TwistSource: Stateful(
        lambda: TwistSource(PathReferenceParameters(), ORIGIN),
        drive_twist,
        {
            'a twist that is not finite': Operation(
                lambda s: s.set_target(BodyTwist(math.nan, 0.0)), kept=('._pose', '._twist')
            )
        },
    ),
    ChaoticReference: Stateful(
        lambda: ChaoticReference(ReferenceParameters.from_dict(CHAOS), GEOMETRY),
        drive_reference,
        {
            'reset': Operation(lambda c: c.reset()),
            'reset to a seed': Operation(
                lambda c: c.reset(5),
                scratch=('._parameters.seed',),
                built=lambda: ChaoticReference(
                    ReferenceParameters.from_dict(CHAOS | {'seed': 5}), GEOMETRY
                ),
            ),
        },
    ),
    # robot, geometry
    CommandLimiter: Stateful(
        lambda: CommandLimiter(CommandLimiterParameters(), GEOMETRY),
        drive_limiter,
        {
            'latch': Operation(lambda x: x.latch('because', 10**11), kept=('._ramp',)),
            'latch and release': Operation(latch_and_release, kept=('._ramp',)),
            'stop': Operation(lambda x: x.stop('because', 10**11), kept=('._ramp',)),
            'jump back': Operation(
                lambda x: (x.stop('because', -1), x.stop('because', -2)), continued=('._ramp',)
            ),
        },
    ),
    GyroOdometry: Stateful(
        lambda: GyroOdometry(GyroOdometryParameters(), GEOMETRY),
        drive_gyro,
        {
            'reset': Operation(
                lambda o: o.reset(Pose(1.0, 2.0, 3.0)),
                kept=('._memory', '._covariance[3][3]', '._covariance[4][4]', '._drift[3][3]'),
            ),
            'forget_bias': Operation(
                lambda o: o.forget_bias(),
                # The response of the gyro's filter to the steps, and for how long they rest.
                kept=(
                    *('._pose', *(f'._memory[0].{name}' for name in GYRO_RESPONSE)),
                    *(
                        f'._{matrix}[{row}][{column}]'
                        for matrix in ('covariance', 'drift')
                        for row in (0, 1, 2, 4)
                        for column in (0, 1, 2, 4)
                    ),
                ),
                # Not read before the bias is known again.
                scratch=(
                    *(
                        f'._memory[0].{name}'
                        for name in ('disagreement', 'disagrees_for', 'slipping')
                    ),
                ),
            ),
        },
    ),
    SampleScheduler: Stateful(
        lambda: SampleScheduler(100.0, slack=0.002),
        drive_scheduler,
        {
            'reset': Operation(lambda s: s.reset()),
            'jump back': Operation(lambda s: s.due(5 * 10**8)),
        },
    ),
    SimulatedTime: Stateful(
        lambda: SimulatedTime(100.0, 1.0),
        drive_time,
        {
            'set_real_time_factor': Operation(
                lambda t: t.set_real_time_factor(3.0, 10**10),
                kept=('._next',),
                scratch=('._anchor',),
            )
        },
    ),
    RealTimeFactor: Stateful(
        RealTimeFactor, drive_factor, {'restart': Operation(lambda f: f.restart())}
    ),
    # simulation, emulator
    PaperRobot: Stateful(
        lambda: PaperRobot(PAPER),
        drive_robot,
        {
            'reset_odometry': Operation(
                lambda x: x._reset_odometry(),
                kept=all_of(PaperRobot(PAPER), '_odometry'),
            )
        },
    ),
    DigitalTwin: Stateful(
        lambda: DigitalTwin(TWIN),
        drive_robot,
        {
            'a loss of power': Operation(
                lambda x: x._lose_power(),
                kept=all_of(
                    DigitalTwin(TWIN),
                    *(
                        '_odometry',
                        '_drivetrain',
                        '_imu',
                        '_slip_monitor',
                        '_channel',
                        '_counters',
                    ),
                    *('_limiter', '_boots_until', '_limited_command'),
                ),
                continued=(
                    *below('._drivetrain', BODY),
                    *('._imu._generator', '._channel._generator', '._channel._clock_ns'),
                    '._channel._sent',
                    *('._limiter._ramp', '._limiter._estop', '._limited_command'),
                    *(
                        '._odometry._pose',
                        *(
                            f'._odometry._memory[0].{name}'
                            for name in GYRO_RESPONSE
                            if name != 'last_rate'
                        ),
                    ),
                    *(f'._odometry._covariance[{k}]' for k in (0, 1, 2)),
                ),
                scratch=below('._imu', IMU_TUNING),
            ),
        },
    ),
    Plant: Stateful(
        lambda: Plant(TWIN),
        drive_plant,
        {
            'boot': Operation(
                lambda p: p.boot(16),
                kept=all_of(Plant(TWIN), '_drivetrain', '_issued', '_imu', '_motor'),
                continued=(
                    *below('._drivetrain', BODY),
                    '._imu._generator',
                    '._drivetrain._arrays.filtered',
                ),
                scratch=below('._imu', IMU_TUNING),
            )
        },
    ),
    SerialLine: Stateful(
        make_line,
        drive_line,
        {
            'clear': Operation(
                clear_line,
                kept=('.line._faults.generators', '.events._numbers', '.line._events._numbers'),
            )
        },
    ),
    FaultInjection: Stateful(
        lambda: FaultInjection(lambda: 0, 1),
        drive_injection,
        {
            'clear': Operation(
                lambda f: [f.clear(kind.name) for kind in FAULT_KINDS], continued=('.generators',)
            )
        },
    ),
}

NEVER_RESET = {
    'StopHistory': 'counts since the start of the node',
    # The state is in the memory of the C core: see test_core_fresh_state.py.
    **dict.fromkeys(('Board', 'Motion', 'RobotBoard', 'Dongle', 'Emulator'), 'C core'),
    **dict.fromkeys(('c_short_Array_7', 'c_ushort_Array_9'), 'C core'),
    **dict.fromkeys(('RadioChannel', 'Medium', '_Exchange'), 'one emulator, never reset'),
    **dict.fromkeys(('PtyPort', '_ConsolePort', 'StopTimeMonitor'), 'one process, never reset'),
    **dict.fromkeys(
        (
            'OdometryMonitor',
            'Gaps',
            'ResponseGain',
            'GivenPathSource',
            'SmoothedPath',
            'PauseRamp',
        ),
        'made anew for each run or path',
    ),
    **dict.fromkeys(
        ('RoutePlanner', 'PathPlan', 'PlannedPath', '_Look'),
        'of one patrol: another seed is for what is planned next, the map and the plan are kept',
    ),
    **dict.fromkeys(('NoisyPlant', 'PlantRobot'), 'one run, no reset'),
    'FixedStepRobot': 'base of PaperRobot and DigitalTwin',
    'StateArray': 'constant',
}
"""Classes of which no object in FRESH holds one, and why."""


# -- parameters -----------------------------------------------------------------------------------


def assign(thing: object, parameters: object) -> None:
    """Replace the attribute ``parameters``."""
    thing.parameters = parameters


def configure(thing: object, parameters: object) -> None:
    """Call ``configure``."""
    thing.configure(parameters)


LATE = (
    '*._signals.bound',  # with the next torque
    '*._ramp.rate',  # with the next command
    *('*._dt', '*._colour', '*._walk_step'),  # with the next measurement
    *('*.voltage', '._supply', '._reports'),  # with the next draw, and the next report
)


COMMANDS = 'linear.', 'angular.', 'wheel.', 'cmd_', 'odometry.'


def drive_with(drive, *seeds):
    """Return a drive that uses an object with each of some seeds."""
    return lambda thing, r: [drive(thing, Random(f'{r.random()} {seed}')) for seed in seeds]


CONFIGURED = {
    PoseController: Configured(
        PoseLoopParameters(), PoseController, assign, drive_with(drive_pose_controller, 1, 2, 3)
    ),
    BodyCorrection: Configured(
        BODY_PARAMETERS, make_body, configure, drive_body, elsewhere=('enabled',)
    ),
    Controller: Configured(
        ControllerParameters.from_dict(
            {'fuzzy.sets': 3, 'friction.gamma': 5.0, 'command_shaper.straight_frequency': 14.6}
        ),
        Controller,
        configure,
        drive_controller,
        elsewhere=('pose.', 'body.'),
        triggers=('estimate_dead_time',),
        late=('.status',),
        # Pretrained weights are those of the gain before.
        settle=lambda controller: controller.law.predictive.pretrain(),
    ),
    GyroOdometry: Configured(
        GyroOdometryParameters(), lambda p: GyroOdometry(p, GEOMETRY), assign, drive_gyro
    ),
    SimulatedImu: Configured(
        SimulatedImuParameters(),
        lambda p: SimulatedImu(p, np.random.default_rng(1)),
        assign,
        drive_imu,
        late=LATE,
    ),
    SimulatedRangeSensors: Configured(
        SimulatedRangeSensorParameters(),
        lambda p: SimulatedRangeSensors(p, np.random.default_rng(1)),
        assign,
        drive_ranges,
    ),
    SimulatedBattery: Configured(
        SimulatedBatteryParameters(), SimulatedBattery, assign, drive_battery, late=LATE
    ),
    PaperRobot: Configured(
        PAPER, PaperRobot, configure, drive_robot, ('drive.speed_ceiling',), late=LATE
    ),
    DigitalTwin: Configured(
        TWIN,
        DigitalTwin,
        configure,
        drive_robot,
        elsewhere=(*COMMANDS, 'imu.', 'range_sensor.', 'battery.', 'drive.', 'slip_stop'),
        triggers=('faults.brown_out', 'faults.wheel_blocked'),
        late=LATE,
    ),
}
"""Objects whose parameters are replaceable at run time."""
