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
"""Cases: what differs from the nominal robot and links, once for all robots."""

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path

from t3mpc_ros.parameters.yaml_loader import EntryError, check_list, check_number
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.plant.disturbances import DisturbanceParameters

ROBOTS = ('twin', 'servo', 'torque')
"""The digital twin with stepper motors; the paper's plant with velocity or with torque drive."""
PLANTS = ('servo', 'torque')
PATCHES = Path(__file__).with_name('patches.yaml')
"""World with slippery patches."""
NOMINAL = 'nominal'


MAX_DELAY = 10.0
"""Largest delay of a message, s."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Faults of the links between robot and controller."""

    command_loss: float = 0.0
    """Fraction of the commands that is lost."""
    command_delay: tuple[float, float] = (0.0, 0.0)
    """Least and largest additional delay of a command, s; uniform between them. A command that
    arrives after a later one is ignored."""
    odometry_loss: float = 0.0
    """Fraction of the measurements that is lost."""
    odometry_delay: tuple[float, float] = (0.0, 0.0)
    """Least and largest delay of a measurement, s; they arrive in order but for the swapped."""
    begin: float = 0.0
    """Begin of the faults, as a share of the run."""
    lasting: float = math.inf
    """Duration of the faults, s."""
    odometry_swapped: int = 0
    """Of so many measurements each the last arrives after its successor; 0: none."""
    odometry_repeated: int = 1
    """How often each measurement arrives."""
    odometry_kept: int = 1
    """Of so many measurements each only the last is sent: a lower rate than the nodes assume."""

    def __post_init__(self) -> None:
        try:
            for name in ('command_loss', 'odometry_loss', 'begin'):
                check_number(getattr(self, name), name, 0.0, 1.0)
            check_number(self.lasting, 'lasting', 0.0, math.inf, 's')
            for name in ('command_delay', 'odometry_delay'):
                pair = getattr(self, name)
                given = list(pair) if isinstance(pair, tuple) else pair
                least, most = check_list(given, name, 2, 2)
                check_number(least, f'the least {name}', 0.0, MAX_DELAY, 's')
                check_number(most, f'the largest {name}', least, MAX_DELAY, 's')
        except EntryError as error:
            raise ScriptError(str(error)) from None
        if self.begin == 1.0 or self.lasting == 0.0:
            raise ScriptError(
                'begin must be less than 1 and lasting more than 0 s, or there are no faults: got '
                f'begin {self.begin:g} and lasting {self.lasting:g} s'
            )
        for name, least in (('swapped', 0), ('repeated', 1), ('kept', 1)):
            count = getattr(self, f'odometry_{name}')
            if isinstance(count, bool) or not isinstance(count, int) or count < least:
                raise ScriptError(
                    f'odometry_{name} must be a whole number of at least {least}: got {count!r}'
                )

    def span(self, duration: float) -> tuple[float, float]:
        """Return begin and end (s) of the faults in a run of ``duration`` seconds."""
        begin = self.begin * duration
        return begin, begin + self.lasting


NO_FAULTS = LinkFaults()


@dataclass(frozen=True, slots=True)
class Case:
    """Difference of the true robot of a run and its links from what every method assumes."""

    text: str
    changes: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the robot from the start, by their flat names."""
    later: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """What changes at half of the run, by robot: parameters, or faults of the twin."""
    known: bool = False
    """Whether the estimator and the methods know of ``changes``."""
    robots: tuple[str, ...] = ROBOTS
    """Robots to which the case applies."""
    links: LinkFaults = NO_FAULTS
    """Faults of the links; unknown to all methods."""
    gyro: bool = False
    """Whether the baselines take the yaw rate from the odometry with its gyro."""
    body: bool = False
    """Whether the motion of the body decides."""
    reproduced: bool = False
    """Whether it belongs to the reproduction of the paper."""


def _geometry(text: str, **multipliers: float) -> Case:
    """Return a case of a body that is unlike the nominal one, for which the gyro is needed."""
    return Case(text, multipliers, robots=('twin',), gyro=True, body=True)


def _gyro(
    text: str,
    changes: Mapping[str, object] | None = None,
    later: Mapping[str, Mapping[str, float]] | None = None,
) -> Case:
    """Return a case of a faulty gyro on the exact robot: who does not use it does not err."""
    return Case(text, changes or {}, later or {}, robots=('twin',), body=True)


_HEAVIER = {'mass_factor': 1.3, 'inertia_factor': 1.3, 'friction_factor': 2.0}

CASES: Mapping[str, Case] = {
    NOMINAL: Case('the robot as it is assumed, with friction and disturbance', reproduced=True),
    'miscalibrated': Case(
        'wheel radii +2 % and -1 %, track +3 %, slippery patches, 30 % more mass and inertia with '
        'the centre of mass 6 cm ahead of the axle instead of 2 cm',
        {
            'right_wheel_radius_multiplier': 1.02,
            'left_wheel_radius_multiplier': 0.99,
            'wheel_separation_multiplier': 1.03,
            'world': str(PATCHES),
            'mass_factor': 1.3,
            'inertia_factor': 1.3,
            'body.com_offset': 0.06,
        },
        robots=('twin',),
        gyro=True,
        body=True,
    ),
    'radii and track': _geometry(
        'wheel radii +2 % and -1 %, track +3 %',
        right_wheel_radius_multiplier=1.02,
        left_wheel_radius_multiplier=0.99,
        wheel_separation_multiplier=1.03,
    ),
    'track +6 %': _geometry('track +6 %', wheel_separation_multiplier=1.06),
    'right radius +5 %': _geometry(
        'radius of the right wheel +5 %', right_wheel_radius_multiplier=1.05
    ),
    'gyro scale +3 %': _gyro(
        'the scale of the gyro is off by up to 3 %, drawn for each seed: the bound that its data '
        'sheet states',
        changes={'imu.gyro_scale_error': 0.03},
    ),
    'gyro bias jump': _gyro(
        'at half of the run the bias of the gyro jumps by 0.05 rad/s',
        later={'twin': {'gyro_bias_jump': 0.05}},
    ),
    'gyro dead': _gyro(
        'from half of the run on the gyro does not respond', later={'twin': {'gyro_dead': True}}
    ),
    'mass +30 %': Case(
        'body mass and inertia 30 % above nominal',
        {'mass_factor': 1.3, 'inertia_factor': 1.3},
        robots=PLANTS,
        reproduced=True,
    ),
    'mass -30 %': Case(
        'body mass and inertia 30 % below nominal',
        {'mass_factor': 0.7, 'inertia_factor': 0.7},
        robots=PLANTS,
        reproduced=True,
    ),
    'friction x3': Case('three times the friction', {'friction_factor': 3.0}, reproduced=True),
    'load change': Case(
        'at half of the run body mass and inertia rise by 30 % and friction doubles; on the twin '
        '1 kg is added to the body',
        later={'servo': _HEAVIER, 'torque': _HEAVIER, 'twin': {'load_change': 1.0}},
        reproduced=True,
    ),
    'disturbance': Case(
        'three times the bound of the disturbance torque',
        {'disturbance.bound': 3.0 * DisturbanceParameters().bound},
        reproduced=True,
    ),
    'dead time': Case(
        'a command takes 30 ms instead of 10 ms, and every method knows it',
        {'drive.dead_time': 0.03},
        known=True,
        robots=('twin', 'servo'),
        reproduced=True,
    ),
    'dead time 60 ms': Case(
        'a command takes 60 ms instead of 10 ms, and every method knows it',
        {'drive.dead_time': 0.06},
        known=True,
        robots=('twin', 'servo'),
    ),
    'unknown dead time': Case(
        'a command takes 30 ms; every method assumes 10 ms',
        {'drive.dead_time': 0.03},
        robots=('twin', 'servo'),
    ),
    'unknown dead time 60 ms': Case(
        'a command takes 60 ms; every method assumes 10 ms',
        {'drive.dead_time': 0.06},
        robots=('twin', 'servo'),
    ),
    'dead time +30 ms': Case(
        'at half of the run commands begin to take 30 ms more',
        links=LinkFaults(command_delay=(0.03, 0.03), begin=0.5),
        robots=('twin', 'servo'),
    ),
    'dead time +30 ms and back': Case(
        'for 20 s from a third of the run on, commands take 30 ms more',
        links=LinkFaults(command_delay=(0.03, 0.03), begin=1.0 / 3.0, lasting=20.0),
        robots=('twin', 'servo'),
    ),
    'dropouts': Case(
        '10 % of the commands and 10 % of the measurements are lost',
        links=LinkFaults(command_loss=0.1, odometry_loss=0.1),
    ),
    'jitter': Case(
        'each command is up to 20 ms late, and each measurement up to 10 ms',
        links=LinkFaults(command_delay=(0.0, 0.02), odometry_delay=(0.0, 0.01)),
    ),
    'overload': Case(
        'for 4 s from half of the run on, each command and each measurement is 20 to 120 ms late',
        links=LinkFaults(
            command_delay=(0.02, 0.12), odometry_delay=(0.02, 0.12), begin=0.5, lasting=4.0
        ),
    ),
    'swapped': Case(
        'of 20 measurements each, one arrives after its successor',
        links=LinkFaults(odometry_swapped=20),
        robots=('twin',),
    ),
    'repeated': Case(
        'each measurement arrives twice', links=LinkFaults(odometry_repeated=2), robots=('twin',)
    ),
    'half rate': Case(
        'measurements at 50 Hz, where every method expects 100 Hz',
        links=LinkFaults(odometry_kept=2),
        robots=('twin',),
    ),
}
"""Every case by name, in the order of the tables."""


def cases_for(robot: str) -> tuple[str, ...]:
    """Return the names of the cases of a robot."""
    return tuple(name for name, case in CASES.items() if robot in case.robots)
