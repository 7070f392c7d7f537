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
"""Parameter tables: specification, validation, names, error texts, command line."""

from argparse import ArgumentTypeError
from dataclasses import dataclass, replace
import random
from typing import ClassVar

import pytest

from t3mpc_ros.parameters.command_line import bounded_float, bounded_int, parse_assignments
from t3mpc_ros.parameters.table import (
    ParameterError,
    Parameters,
    at_least,
    at_most,
    find_names,
    group,
    parameter,
)
from t3mpc_ros.radio.link.link_parameters import LinkParameters


@dataclass(frozen=True)
class Inner(Parameters):
    gain: float = parameter(8.0, 'gain', '1/s', (0.1, 100.0), dynamic=True)
    kind: str = parameter('a', 'kind', choices=('a', 'b'))


@dataclass(frozen=True)
class Outer(Parameters):
    low: float = parameter(1.0, 'lower end')
    high: float = parameter(2.0, 'upper end')
    count: int = parameter(3, 'how many', bounds=(1, None))
    levels: tuple[float, ...] = parameter((0.1, 0.2), 'levels', bounds=(0.0, None))
    on: bool = parameter(True, 'switch')
    inner: Inner = group(Inner)

    def check_consistency(self) -> None:
        if self.low >= self.high:
            raise ParameterError(f'low must be below high: got {self.low} and {self.high}')


def test_specs_contain_type_default_unit_and_range():
    specs = {spec.name: spec for spec in Outer.specs()}
    assert list(specs) == ['low', 'high', 'count', 'levels', 'on', 'inner.gain', 'inner.kind']
    gain = specs['inner.gain']
    assert (gain.kind, gain.many, gain.default, gain.unit, gain.dynamic) == (
        float, False, 8.0, '1/s', True,
    )  # fmt: skip
    assert gain.bounds_text() == 'from 0.1 to 100 1/s'
    assert specs['inner.kind'].bounds_text() == 'one of a, b'
    assert specs['count'].bounds_text() == 'at least 1'


def test_to_dict_and_from_dict_are_inverse():
    table = Outer.from_dict({'inner.gain': 5, 'levels': [1, 2.5], 'count': 7})
    assert table.inner.gain == 5.0
    assert isinstance(table.inner.gain, float)
    assert table.levels == (1.0, 2.5)
    assert Outer.from_dict(table.to_dict()) == table


@pytest.mark.parametrize(
    'values, words',
    [
        ({'inner.gain': -1.0}, ['inner.gain', 'from 0.1 to 100', '-1']),
        ({'inner.gain': float('nan')}, ['inner.gain', 'finite', 'nan']),
        ({'inner.gain': 'fast'}, ['inner.gain', 'a number', 'fast']),
        ({'inner.gain': True}, ['inner.gain', 'a number', 'True']),
        ({'inner.kind': 'c'}, ['inner.kind', 'one of a, b', 'c']),
        ({'count': 2.5}, ['count', 'a whole number', '2.5']),
        ({'levels': [0.1, -2.0]}, ['levels', 'at least 0', '-2']),
        ({'levels': 3.0}, ['levels', 'a list', '3.0']),
        ({'inner.gian': 1.0}, ['inner.gian', 'did you mean inner.gain']),
        ({'low': 3.0}, ['low must be below high', '3.0', '2.0']),
    ],
)
def test_invalid_values_are_rejected_with_name_bound_and_value(values, words):
    with pytest.raises(ParameterError) as caught:
        Outer.from_dict(values)
    for word in words:
        assert word in str(caught.value)


@dataclass(frozen=True)
class Limits(Parameters):
    speed: float = parameter(1.0, 'speed', name='linear.x.max_velocity', bounds=(0.0, None))
    rate: float = parameter(2.0, 'rate', bounds=(0.0, None))


@dataclass(frozen=True)
class Robot(Parameters):
    size: float = parameter(0.5, 'size', bounds=(0.0, None))
    limits: Limits = group(Limits, inline=True, rate=3.0)
    spare: Limits = group(Limits)


def test_explicit_and_inline_names():
    assert [(spec.name, spec.default) for spec in Robot.specs()] == [
        ('size', 0.5),
        ('linear.x.max_velocity', 1.0),
        ('rate', 3.0),
        ('spare.linear.x.max_velocity', 1.0),
        ('spare.rate', 2.0),
    ]
    robot = Robot.from_dict({'linear.x.max_velocity': 4, 'spare.linear.x.max_velocity': 5.0})
    assert (robot.limits.speed, robot.spare.speed, robot.limits.rate) == (4.0, 5.0, 3.0)


def test_named_parameters_survive_the_round_trip():
    generator = random.Random(1)
    names = [spec.name for spec in Robot.specs()]
    for _ in range(200):
        chosen = generator.sample(names, generator.randrange(len(names) + 1))
        values = {name: generator.uniform(0.0, 9.0) for name in chosen}
        robot = Robot().with_values(values)
        assert robot.to_dict() == Robot().to_dict() | values
        assert list(robot.to_dict()) == names
        assert Robot.from_dict(robot.to_dict()) == robot


def test_errors_name_the_parameter_by_its_full_name():
    with pytest.raises(ParameterError, match='did you mean linear.x.max_velocity'):
        Robot.from_dict({'linear.x.max_velocty': 1.0})
    with pytest.raises(ParameterError, match='there is no parameter limits.rate'):
        Robot.from_dict({'limits.rate': 1.0})
    with pytest.raises(ParameterError, match='spare.linear.x.max_velocity must be at least 0'):
        Robot.from_dict({'spare.linear.x.max_velocity': -1.0})
    with pytest.raises(ParameterError, match='linear.x.max_velocity must be at least 0'):
        Limits(speed=-1.0)


def test_a_table_with_clashing_names_is_rejected():
    @dataclass(frozen=True)
    class Twice(Parameters):
        rate: float = parameter(1.0, 'rate')
        limits: Limits = group(Limits, inline=True)

    @dataclass(frozen=True)
    class Prefix(Parameters):
        first: float = parameter(1.0, 'first', name='linear.x')
        limits: Limits = group(Limits, inline=True)

    for table, message in (
        (Twice, 'Twice has two parameters rate'),
        (Prefix, 'Prefix has the parameters linear.x and linear.x.max_velocity'),
    ):
        for use in (table.specs, table, lambda table=table: table.from_dict({})):
            with pytest.raises(ParameterError, match=message):
                use()


@dataclass(frozen=True)
class Wheel(Parameters):
    width: ClassVar[float] = 0.02
    radius: float = parameter(0.1, 'radius')


@dataclass(frozen=True)
class Cart(Parameters):
    sizes: ClassVar[tuple[float, ...]] = (1.0, 2.0)
    wheel: Wheel = group(Wheel)
    front: Wheel = group(Wheel, inline=True)
    rear: Wheel = group(Wheel, fixed=('radius',), radius=0.3)
    spare: ClassVar[Wheel] = Wheel(radius=0.2)


def test_a_former_parameter_is_accepted_with_its_value_alone():
    constants = {
        'sizes': (1.0, 2.0),
        'wheel.width': 0.02,
        'width': 0.02,
        'rear.radius': 0.3,
        'rear.width': 0.02,
        'spare.radius': 0.2,
        'spare.width': 0.02,
    }
    assert Cart.class_constants() == constants
    assert [spec.name for spec in Cart.specs()] == ['wheel.radius', 'radius']
    assert Cart.from_dict(constants | {'sizes': [1.0, 2.0]}) == Cart()
    assert Cart().rear.radius == 0.3
    assert 'rear.radius' not in Cart().to_dict()
    with pytest.raises(ParameterError) as caught:
        Cart.from_dict({'wheel.width': 0.03})
    assert str(caught.value) == 'wheel.width is no longer a parameter, it is always 0.02: got 0.03'
    with pytest.raises(ParameterError, match=r'rear.radius is no longer .* always 0.3: got 0.1'):
        Cart.from_dict({'rear.radius': 0.1})


def test_direct_construction_is_validated():
    with pytest.raises(ParameterError):
        Inner(gain=0.0)
    with pytest.raises(ParameterError):
        replace(Outer(), high=0.5)


def test_assignments_are_parsed_by_the_type_of_the_parameter():
    """``link.rate=2M`` and the address 5433 remain text, ``true`` does not."""
    words = ['address=5433', 'channel=3', 'cycle_rate=25', 'robot.invert_left=true', 'rate=2M']
    found = parse_assignments(LinkParameters, words)
    assert found == {
        'address': '5433',
        'channel': 3,
        'cycle_rate': 25,
        'robot.invert_left': True,
        'rate': '2M',
    }
    with pytest.raises(ParameterError, match="NAME=VALUE: got 'channel'"):
        parse_assignments(LinkParameters, ['channel'])
    with pytest.raises(ParameterError, match='name each parameter once: got channel again'):
        parse_assignments(LinkParameters, ['channel=3', 'rate=250k', 'channel=4'])
    with pytest.raises(ParameterError, match='nothing_such'):
        LinkParameters.from_dict(parse_assignments(LinkParameters, ['nothing_such=1']))


def test_bounded_numbers_reject_values_out_of_range():
    read = bounded_float(0.0, 1e6, '1/s²')
    assert (read('0'), read('1e6'), bounded_int(1, 5)('5')) == (0.0, 1e6, 5)
    for text in ('-1', '1000001', 'nan', 'inf'):
        with pytest.raises(ArgumentTypeError, match=f'must be from 0 to 1000000 1/s²: got {text}'):
            read(text)
    for text in ('x', '1.5', ''):
        with pytest.raises(ValueError, match='invalid literal'):
            bounded_int(1, 5)(text)


def test_names_that_are_not_known_are_refused_with_the_nearest():
    known = ['PI + feed-forward', 'linear MPC preview', 'DMC']
    words = r'must be one of PI \+ feed-forward, linear MPC preview, DMC: got linear mpc p; '
    with pytest.raises(ValueError, match=words + 'did you mean linear MPC preview'):
        find_names('method', ['linear mpc p'], known)
    with pytest.raises(ValueError, match='got xyz$'):
        find_names('method', ['xyz'], known)
    assert find_names('method', [], known) == ()
    assert find_names('method', ['dmc', 'pi-feed-forward'], known) == ('PI + feed-forward', 'DMC')


def test_names_that_differ_by_a_sign_are_told_apart():
    """``compare --cases "mass +30 %"`` once ran the lighter robot."""
    known = ['mass +30 %', 'mass -30 %', 'Friction x3']
    for name in known:
        assert find_names('case', [name], known) == (name,)
    assert find_names('case', ['friction-X3'], known) == ('Friction x3',)
    with pytest.raises(ValueError, match='got mass 30; did you mean mass'):
        find_names('case', ['mass 30'], known)


@pytest.mark.parametrize('digits', [2, 3, 4])
def test_a_computed_bound_is_named_by_a_value_that_it_admits(digits):
    """An error once named 116 as the greatest gain, where 115.6 was, and then refused 116."""
    source = random.Random(5)
    for _ in range(500):
        bound = source.choice((-1.0, 1.0)) * 10.0 ** source.uniform(-6.0, 6.0)
        below, above = float(at_most(bound, digits)), float(at_least(bound, digits))
        assert below <= bound <= above
        assert above - below <= 1.001 * 10.0 ** (1 - digits) * abs(bound)
    assert (at_most(0.3), at_least(0.3), at_most(1e5), at_most(0.0)) == (
        '0.3',
        '0.3',
        '100000',
        '0',
    )
