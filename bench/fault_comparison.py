#!/usr/bin/env python3
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
"""Faults and wrong assumptions: the controller of the node beside simple ones on the twin.

Usage: fault_comparison.py [--seeds 2001-2006] [--nmpc-seeds 2001-2006] [--only TEXT] [--workers N]
                           [--page docs/faults.md]

For each row the errors, settled and with switches, of full, of the simple methods and of the NMPC
with the exact model (means over the seeds); the larger ratio of full to the best of the simple
ones; the time for which the controller stops the robot; and what its diagnostics say within 5 s of
the fault. Where the wheels do not move the body as assumed the errors are those of the yaw rate.
The exit code is 1 if a ratio is above 1.15 and the controller does not stop, or if a fault that
costs more than 15 % of the errors without it is not named on every seed.
"""

import argparse
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
import math
from pathlib import Path
import re
import sys
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from t3mpc_ros.control.controller import Controller
from t3mpc_ros.control.odometry_monitor import OdometryMonitor
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation import loop
from t3mpc_ros.evaluation.baselines.feed_forward import FeedForwardParameters
from t3mpc_ros.evaluation.cases import NO_FAULTS, LinkFaults
from t3mpc_ros.evaluation.experiment import ResultTable, Row, map_jobs
from t3mpc_ros.evaluation.loop import NodeDriver, NodeMethod, ReportLink
from t3mpc_ros.evaluation.method_table import (
    EXACT_MODEL,
    FEED_FORWARD,
    FULL,
    LMS,
    NMPC,
    SHAPED_IN_TIME,
    methods_for,
)
from t3mpc_ros.evaluation.result_output import replace_section
from t3mpc_ros.evaluation.run_record import RATE, measure, stamp_of
from t3mpc_ros.evaluation.scenario import OwnParts, Scenario
from t3mpc_ros.geometry.kinematics import twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, State, WheelSpeeds
from t3mpc_ros.robot.interface import RobotState
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_schedule import FaultEvent

DURATION, BEGIN, NAMED = 30.0, 15.0, 5.0
"""Length of a run, begin of what does not last for the whole run, and time to name it, s."""
MARGIN = 1.15  # largest ratio to the errors of the best simple method
ROBOT = DigitalTwinParameters()  # the exact robot
DEAD_TIME = ROBOT.drive.dead_time
SIMPLE = FEED_FORWARD, SHAPED_IN_TIME, LMS
EXACT = NMPC + EXACT_MODEL
WHEELS, BODY = ('settled', 'overall'), ('yaw_rate_settled', 'yaw_rate')
"""Metrics of a row."""
BEGIN_MARK, END_MARK = '<!-- comparison -->', '<!-- end of comparison -->'
HEAD = (
    *('fault', FULL, FEED_FORWARD, 'with shaper, dead time', 'LMS', 'NMPC, exact', 'ratio'),
    *('stops / s', 'named', 'diagnostics'),
)

Send = Callable[[Any, int, RobotState], Iterable[RobotState]]


@dataclass(frozen=True)
class Fault:
    """What differs from the exact robot, or from what the controller assumes of it."""

    changes: Mapping[str, Any] = field(default_factory=dict)  # parameters of the robot
    events: Mapping[str, Any] = field(default_factory=dict)
    """Faults of the twin from :data:`BEGIN` on."""
    links: LinkFaults = NO_FAULTS
    send: Send = lambda link, k, state: [state]
    """What becomes of a report of the robot, with its number."""
    assumed: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of the controller; lag, dead time and noise of the drive are those of all."""
    spread: bool = False
    """Whether a delay is longer or shorter by up to half a period, by seed: the simple methods use
    whole periods alone."""
    body: bool = False
    """Whether the wheels do not move the body as assumed, so that the yaw rate alone counts."""
    lasting: float = math.inf  # duration of the events, s
    begin: float = 2.0  # when the fault shows, s
    forward_links: LinkFaults | None = None
    """Links of feed-forward, where they differ: it has no ``rate``."""
    comparable: tuple[str, ...] = SIMPLE  # simple methods that get the same false information


def with_odometry(changed: Callable[[Any, int, State], Mapping[str, Any]]) -> Send:
    """Return a fault of the odometry in each report, by its link and number."""

    def send(link: Any, k: int, state: RobotState) -> list[RobotState]:
        odometry = state.odometry
        return [state._replace(odometry=odometry._replace(**changed(link, k, odometry)))]

    return send


def with_twist(change: Callable[[BodyTwist], BodyTwist]) -> Send:
    """Return a fault of the twist in each report."""
    return with_odometry(lambda link, k, odometry: {'twist': change(odometry.twist)})


def jittering(link: Any, k: int, odometry: State) -> Mapping[str, int]:
    """Return a stamp that is up to 3 ms off."""
    off = np.random.default_rng(k).uniform(-0.003, 0.003)
    return {'stamp_ns': odometry.stamp_ns + round(off * NANOSECONDS)}


def of_the_world(link: Any, k: int, odometry: State) -> Mapping[str, BodyTwist]:
    """Return the velocity along the x axis of the world for that along the robot's."""
    linear, angular = odometry.twist
    return {'twist': BodyTwist(linear * math.cos(odometry.pose.yaw), angular)}


def right_wheel_faster(twist: BodyTwist) -> BodyTwist:
    """Return the twist by wheels of which the right one has a radius that is 5 % too large."""
    right, left = wheels_from_twist(twist, ROBOT.geometry)
    return twist_from_wheels(WheelSpeeds(1.05 * right, left), ROBOT.geometry)


@with_odometry
def repeated_twist(link: Any, k: int, odometry: State) -> Mapping[str, Any]:
    """Return a twist that stays the same for the first 0.1 s of each second."""
    if k % RATE >= 0.1 * RATE or link.kept is None:
        link.kept = odometry.twist
    return {'twist': link.kept}


def held(name: str, count: int) -> Send:
    """Return reports with a part of the odometry, 'twist' or 'pose', of every so many messages."""

    def changed(link: Any, k: int, odometry: State) -> Mapping[str, Any]:
        if k % count == 0 or link.kept is None:
            link.kept = getattr(odometry, name)
        return {name: link.kept}

    return with_odometry(changed)


def delayed(steps: int, change: Callable[[State, State], Mapping[str, Any]]) -> Send:
    """Return reports with a change of the odometry by that of some messages before and itself."""

    def changed(link: Any, k: int, odometry: State) -> Mapping[str, Any]:
        link.kept = [*(link.kept or ()), odometry][-steps - 1 :]
        return change(link.kept[0], odometry)

    return with_odometry(changed)


def late_twist(before: State, now: State) -> Mapping[str, Any]:
    """Return the twist of a message before."""
    return {'twist': before.twist}


def late_yaw_rate(before: State, now: State) -> Mapping[str, Any]:
    """Return the twist with the yaw rate of a message before."""
    return {'twist': now.twist._replace(angular=before.twist.angular)}


def late_pose(before: State, now: State) -> Mapping[str, Any]:
    """Return the pose of a message before."""
    return {'pose': before.pose}


def filtered(time: float) -> Send:
    """Return a twist behind a low-pass of first order (s)."""
    share = -math.expm1(-1.0 / RATE / time)

    def changed(link: Any, k: int, odometry: State) -> Mapping[str, BodyTwist]:
        last = link.kept or odometry.twist
        pairs = zip(last, odometry.twist, strict=True)
        link.kept = BodyTwist(*(old + share * (new - old) for old, new in pairs))
        return {'twist': link.kept}

    return with_odometry(changed)


def with_pose(changed: Callable[[Any, int, Any], Mapping[str, float]]) -> Send:
    """Return a fault of the pose in each report."""
    return with_odometry(
        lambda link, k, odometry: {
            'pose': odometry.pose._replace(**changed(link, k, odometry.pose))
        }
    )


def rounded(link: Any, k: int, pose: Any) -> Mapping[str, float]:
    """Return a pose with few digits."""
    return {'x': round(pose.x, 3), 'y': round(pose.y, 3), 'yaw': round(pose.yaw, 2)}


def frozen_yaw(link: Any, k: int, pose: Any) -> Mapping[str, float]:
    """Return the yaw of the begin of the fault."""
    if k == round(BEGIN * RATE):
        link.kept = pose.yaw
    return {'yaw': link.kept} if k >= BEGIN * RATE else {}


def late(seconds: float) -> LinkFaults:
    """Return odometry that is late from the start."""
    return LinkFaults(odometry_delay=(seconds, seconds))


AFTER = BEGIN * RATE
FAULTS: Mapping[str, Fault] = {
    'none': Fault(),
    # messages of the odometry
    'one pair swapped': Fault(links=LinkFaults(odometry_swapped=round(AFTER)), begin=BEGIN),
    'a pair swapped every 0.2 s': Fault(links=LinkFaults(odometry_swapped=20)),
    'every third swapped': Fault(links=LinkFaults(odometry_swapped=3)),
    'each message twice': Fault(links=LinkFaults(odometry_repeated=2)),
    'half the rate': Fault(links=LinkFaults(odometry_kept=2)),
    'a fifth of the rate': Fault(links=LinkFaults(odometry_kept=5)),
    'rate set to 50, odometry has 100 Hz': Fault(
        assumed={'rate': 50.0}, forward_links=LinkFaults(odometry_kept=2)
    ),
    'rate set to 200, odometry has 100 Hz': Fault(assumed={'rate': 200.0}),
    'one in five lost in bursts': Fault(
        send=lambda link, k, state: [] if k % 50 < 10 else [state]
    ),
    '30 % of the odometry lost': Fault(links=LinkFaults(odometry_loss=0.3)),
    'odometry up to 40 ms late': Fault(links=LinkFaults(odometry_delay=(0.0, 0.04))),
    'stamps of the odometry off by up to 3 ms': Fault(send=with_odometry(jittering)),
    'odometry 50 ms late': Fault(links=late(0.05), spread=True),
    'odometry 100 ms late': Fault(links=late(0.1), spread=True),
    'odometry 200 ms late': Fault(links=late(0.2), spread=True),
    'odometry 1 s late': Fault(links=late(1.0)),
    'no twist in the odometry': Fault(send=with_twist(lambda twist: STANDSTILL)),
    'twist of the odometry + 10 %': Fault(
        send=with_twist(lambda twist: BodyTwist(1.1 * twist.linear, 1.1 * twist.angular))
    ),
    'twist of the odometry in mm/s': Fault(
        send=with_twist(lambda twist: BodyTwist(1000.0 * twist.linear, twist.angular))
    ),
    'twist of the odometry in degrees/s': Fault(
        send=with_twist(lambda twist: BodyTwist(twist.linear, math.degrees(twist.angular)))
    ),
    'twist of the odometry + 0.01 m/s, + 0.05 rad/s': Fault(
        send=with_twist(lambda twist: BodyTwist(twist.linear + 0.01, twist.angular + 0.05))
    ),
    'linear velocity of the odometry + 10 %': Fault(
        send=with_twist(lambda twist: BodyTwist(1.1 * twist.linear, twist.angular))
    ),
    'yaw rate of the odometry + 20 %': Fault(
        send=with_twist(lambda twist: BodyTwist(twist.linear, 1.2 * twist.angular))
    ),
    'right wheel of the twist + 5 %': Fault(send=with_twist(right_wheel_faster)),
    'twist of the odometry repeated for 0.1 s each second': Fault(send=repeated_twist),
    'no yaw rate in the odometry': Fault(
        send=with_twist(lambda twist: BodyTwist(twist.linear, 0.0))
    ),
    'twist of the odometry of the world': Fault(send=with_odometry(of_the_world)),
    'no twist in every second message': Fault(
        send=with_odometry(lambda link, k, odometry: {'twist': STANDSTILL} if k % 2 else {})
    ),
    'twist of the odometry held for 50 ms': Fault(send=held('twist', 5)),
    'twist of the odometry 30 ms late': Fault(send=delayed(3, late_twist)),
    'twist of the odometry 80 ms late': Fault(send=delayed(8, late_twist)),
    'twist of the odometry behind a filter of 0.2 s': Fault(send=filtered(0.2)),
    'yaw rate of the odometry 50 ms late': Fault(send=delayed(5, late_yaw_rate)),
    'pose 100 ms late': Fault(send=delayed(10, late_pose)),
    'pose 300 ms late': Fault(send=delayed(30, late_pose)),
    'pose ten times a second': Fault(send=held('pose', 10)),
    'pose rounded to 1 mm, 0.01 rad': Fault(send=with_pose(rounded)),
    'yaw rate of the odometry reversed': Fault(
        send=with_twist(lambda twist: BodyTwist(twist.linear, -twist.angular))
    ),
    'twist reversed': Fault(
        send=with_twist(lambda twist: BodyTwist(-twist.linear, -twist.angular))
    ),
    'yaw set by 0.5 rad': Fault(
        send=with_pose(lambda link, k, pose: {'yaw': pose.yaw + 0.5 * (k >= AFTER)}), begin=BEGIN
    ),
    'pose set by 1 m': Fault(
        send=with_pose(lambda link, k, pose: {'x': pose.x + (k >= AFTER)}), begin=BEGIN
    ),
    'pose drifts by 2 cm/s': Fault(
        send=with_pose(lambda link, k, pose: {'x': pose.x + 0.02 * k / RATE})
    ),
    'yaw frozen': Fault(send=with_pose(frozen_yaw), begin=BEGIN),
    'one message not finite': Fault(
        send=with_pose(lambda link, k, pose: {'x': math.nan} if k == AFTER else {}), begin=BEGIN
    ),
    # gyro
    'gyro bias + 0.05 rad/s': Fault(events={'gyro_bias_jump': 0.05}, begin=BEGIN),
    'gyro bias - 0.01 rad/s': Fault(events={'gyro_bias_jump': -0.01}, begin=BEGIN),
    'gyro bias + 0.35 rad/s': Fault(events={'gyro_bias_jump': 0.35}, begin=BEGIN),
    'gyro dead': Fault(events={'gyro_dead': True}, begin=BEGIN),
    'gyro scale within ± 3 %, stated': Fault(changes={'imu.gyro_scale_error': 0.03}),
    # No signal can tell it from wheels that are nearer by as much; only LMS follows the gyro, too.
    'gyro scale within ± 1 %, not stated': Fault(
        changes={'imu.gyro_scale_error': 0.01},
        assumed={'body.gyro_scale_tolerance': 0.001},
        comparable=(LMS,),
    ),
    'gyro scale within ± 3 %, not stated': Fault(
        changes={'imu.gyro_scale_error': 0.03},
        assumed={'body.gyro_scale_tolerance': 0.001},
        comparable=(LMS,),
    ),
    # commands
    '10 % of the commands lost': Fault(events={'command_loss': 0.1}, begin=BEGIN),
    '30 % of the commands lost': Fault(events={'command_loss': 0.3}, begin=BEGIN),
    'commands up to 50 ms late': Fault(events={'command_jitter': 0.05}, begin=BEGIN),
    'dead time + 30 ms from 15 s on': Fault(
        events={'command_delay': 0.03}, spread=True, begin=BEGIN
    ),
    'dead time + 100 ms from 15 s on': Fault(
        events={'command_delay': 0.1}, spread=True, begin=BEGIN
    ),
    'dead time 30 ms, 10 ms assumed': Fault(changes={'drive.dead_time': 0.03}, spread=True),
    'dead time 60 ms, 10 ms assumed': Fault(changes={'drive.dead_time': 0.06}, spread=True),
    'dead time 10 ms, 60 ms assumed': Fault(assumed={'speed_filter.dead_time': 0.06}),
    # robot
    'wheel radii + 2 %, - 1 %': Fault(
        changes={'right_wheel_radius_multiplier': 1.02, 'left_wheel_radius_multiplier': 0.99},
        body=True,
    ),
    'right radius + 5 %': Fault(changes={'right_wheel_radius_multiplier': 1.05}, body=True),
    'track + 6 %': Fault(changes={'wheel_separation_multiplier': 1.06}, body=True),
    'body 2 kg heavier from 15 s on': Fault(events={'load_change': 2.0}, begin=BEGIN),
    'a third of the grip for 5 s': Fault(events={'slippery': 0.3}, lasting=5.0, begin=BEGIN),
    'friction x3': Fault(changes={'friction_factor': 3.0}),
    'disturbance x10': Fault(changes={'disturbance.bound': 0.02}),
    'supply 2 V lower': Fault(events={'supply_sag': 2.0}, begin=BEGIN),
    'noise 0.2 (rad/s)², 0.04 assumed': Fault(
        changes={'noise.variance': 0.2}, assumed={'speed_filter.noise_variance': 0.04}
    ),
    'noise 0.04 (rad/s)², none assumed': Fault(assumed={'speed_filter.noise_variance': 0.0}),
    'lag 20 ms assumed, none': Fault(assumed={'speed_filter.lag': 0.02}),
    'shaper for another robot': Fault(
        assumed={'command_shaper.straight_frequency': 6.0, 'command_shaper.turning_frequency': 4.0}
    ),
}


class Link(ReportLink):
    """Reports that a fault changes."""

    def __init__(self, changed: Send, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._changed, self.k, self.kept = changed, 0, None

    def send(self, state: RobotState) -> None:
        """Send what a fault makes of a report."""
        self.k += 1
        for each in self._changed(self, self.k, state):
            super().send(each)


class WatchedDriver(NodeDriver):
    """The controller of the node with what its diagnostics say, once a second."""

    def __init__(self, method: NodeMethod, scenario: Scenario) -> None:
        parameters = method.parameters_for(scenario)
        inner = Controller(parameters.with_values({'rate': RATE}))
        super().__init__(inner, scenario.true_robot().geometry, scenario.reference().speeds)
        self._controller = Controller(parameters)
        self._controller.warm_up()
        self._monitor = OdometryMonitor(parameters.rate)
        self._command: BodyTwist | None = None
        self._now_ns, self._ignored = 0, 0
        self.said: list[tuple[float, str]] = []

    def begin(self, k: int, *, enabled: bool) -> None:
        """Note what the diagnostics say in this period, if they are published."""
        super().begin(k, enabled=enabled)
        self._now_ns = stamp_of(k)
        if k % round(RATE) or not enabled:
            return
        controller = self._controller
        parameters = controller.parameters
        texts = self._monitor.warnings(
            simulated_time=False,
            tolerated_gap=0.5 * parameters.watchdog.odometry_timeout,
            geometry=parameters.geometry,
            response_time=controller.response_time,
        )
        texts += controller.problems()
        if controller.status.reason is not Reason.TRACKING:
            texts.insert(0, controller.status.reason.value)
        if controller.ignored_odometry > self._ignored:
            texts.append('messages of odom were ignored')
        self._ignored = controller.ignored_odometry
        self.said += [(k / RATE, text) for text in texts]

    def step(self, state: RobotState) -> Any:
        """Return the command, and watch the inputs as the node does."""
        command = super().step(state)
        controller, odometry = self._controller, state.odometry
        status = controller.status
        known = None if controller.odometry_twist.replaced else self._command
        following = status.reason is Reason.TRACKING and not controller.wheel_monitor.outside
        if not controller.doubts_odometry:
            periods = controller.stamp_filter.periods
            self._monitor.update(
                odometry, self._now_ns, known, following=following, periods=periods
            )
        self._command = controller.actuation.twist if status.reason.moves else None
        return command


@dataclass(frozen=True)
class Watched:
    """The method of a watched driver, for one run."""

    method: NodeMethod
    made: list[WatchedDriver] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name in errors."""
        return self.method.name

    def driver(self, scenario: Scenario) -> WatchedDriver:
        """Return the driver."""
        self.made.append(WatchedDriver(self.method, scenario))
        return self.made[-1]


class Job(NamedTuple):
    """One run of a method with a fault."""

    fault: str
    controller: str
    seed: int


def run_job(job: Job) -> Row:
    """Return the job, its numbers, and what the diagnostics said when."""
    fault = FAULTS[job.fault]
    changes: dict[str, Any] = {**fault.changes}
    values = {**fault.events}
    if fault.spread:
        more = float(np.random.default_rng(job.seed).uniform(-0.5, 0.5)) / RATE
        if 'command_delay' in values:
            values['command_delay'] += more
        else:
            changes['drive.dead_time'] = changes.get('drive.dead_time', DEAD_TIME) + more
    events = [FaultEvent(BEGIN, name, value, fault.lasting) for name, value in values.items()]
    method: Any = methods_for('twin')[job.controller]
    links = fault.links if isinstance(method, NodeMethod) else fault.forward_links or fault.links
    own = OwnParts(robot_parameters=changes, events=events, links=links, assumed=fault.assumed)
    scenario = Scenario('twin', 'nominal', job.seed, DURATION, own=own)
    if isinstance(method, NodeMethod):
        method = Watched(method)
    elif lag := fault.assumed.get('speed_filter.lag'):
        advance = 1.0 / RATE / -math.expm1(-1.0 / RATE / lag)
        parameters = method.parameters
        if isinstance(parameters, FeedForwardParameters):
            method = replace(method, parameters=parameters.with_values({'advance': advance}))
    with patch.object(loop, 'ReportLink', partial(Link, fault.send)):
        numbers = measure(loop.run(scenario, method))
    said = method.made[0].said if isinstance(method, Watched) else []
    return {**job._asdict(), **numbers, 'said': said}


def first_said(fault: Fault, said: Iterable[tuple[float, str]], limit: float = NAMED) -> str:
    """Return what the diagnostics said within 5 s of the begin of a fault, and not before.

    ``limit`` is another time, s.
    """
    said = [(time - fault.begin, text) for time, text in said]
    before = {kind(text) for time, text in said if time < 0.0}
    found: dict[str, str] = {}
    for time, text in said:
        if 0.0 <= time <= limit and kind(text) not in before:
            found.setdefault(kind(text), f'{text} ({time:.0f} s)')
    return '; '.join(found.values())


def kind(text: str) -> str:
    """Return a text without its numbers."""
    return re.sub(r'[-\d.]+', '', text)[:50]


def row(name: str, found: ResultTable) -> tuple[str, bool]:
    """Return a line of the table, and whether it is as it must be."""
    fault, stops = FAULTS[name], {each.value for each in Reason if not each.moves}
    counted = BODY if fault.body else WHEELS

    def mean(case: str, method: str, metric: str) -> float:
        values = found.values(metric, fault=case, controller=method)
        return float(np.mean(values)) if values else math.nan

    errors = {each: [mean(name, each, metric) for metric in counted] for each in (FULL, *SIMPLE)}
    best = np.min([errors[each] for each in fault.comparable], axis=0)
    ratio = float(np.max(np.divide(errors[FULL], best)))
    cost = max(mean(name, FULL, metric) / mean('none', FULL, metric) for metric in counted)
    stopped, texts, later = mean(name, FULL, 'stopped'), [], 0
    for said in found.values('said', fault=name, controller=FULL):
        texts.append(first_said(fault, said))
        later += bool(first_said(fault, said, DURATION))
        stopped += sum(text in stops for _, text in said) and 0.005
    named, count = sum(map(bool, texts)), len(texts)
    text = re.sub(r'(:|;| \(\d).*', '', max(texts, key=bool))
    cells = [*errors.values(), [mean(name, EXACT, metric) for metric in counted]]
    worse = ratio > MARGIN and stopped == 0.0
    silent = named < count and cost > MARGIN and name != 'none'
    said_of = f'{named} of {count}' if named else '–'
    if later > named:
        said_of = f'{named} of {count}, later {later}'
    shown = [
        f'{name} †' if fault.body else name,
        *(' / '.join('–' if math.isnan(x) else f'{x:.4f}' for x in cell) for cell in cells),
        f'**{ratio:.2f}**' if worse else f'{ratio:.2f}',
        f'{stopped:.1f}' if stopped else '–',
        f'**{said_of}**' if silent else said_of,
        text,
    ]
    return f'| {" | ".join(shown)} |', not (worse or silent)


def seeds_of(text: str) -> range:
    """Return the seeds of FIRST-LAST."""
    first, _, last = text.partition('-')
    return range(int(first), int(last or first) + 1)


def main() -> int:
    """Print the table; return 1 if full is too much worse, or a fault is not named."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', maxsplit=1)[0])
    parser.add_argument('--seeds', type=seeds_of, default='2001-2006')
    parser.add_argument('--nmpc-seeds', type=seeds_of, default='2001-2006')
    parser.add_argument('--only', default='', help='rows whose name contains this')
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--page', type=Path, help='page with the marks of the table')
    chosen = parser.parse_args()
    rows = [name for name in FAULTS if chosen.only in name]
    jobs = [
        Job(fault, name, seed)
        for fault in dict.fromkeys(('none', *rows))
        for name in (FULL, *SIMPLE, EXACT)
        for seed in (chosen.nmpc_seeds if name == EXACT else chosen.seeds)
    ]
    results = map_jobs(run_job, jobs, chosen.workers, progress=True)
    lines, failed = table(rows, ResultTable(results))
    print(lines)
    if chosen.page is not None:
        replace_section(chosen.page, BEGIN_MARK, END_MARK, f'\n{lines}\n')
    return failed


def table(rows: Iterable[str], found: ResultTable) -> tuple[str, bool]:
    """Return the table of these faults, and whether a line is not as it must be."""
    lines = [f'| {" | ".join(HEAD)} |', '|---' * len(HEAD) + '|']
    failed = False
    for name in rows:
        line, good = row(name, found)
        lines.append(line)
        failed |= not good
    return '\n'.join(lines), failed


if __name__ == '__main__':
    sys.exit(main())
