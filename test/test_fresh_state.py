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
"""After a reset an object is as a new one, and with other parameters as one built with them.

Every class with a state is a part of an object in a table, and the whole state is compared, not
only what a test of one class would think of: `Controller.reset` kept the status of its last step,
its count of steps since the last snapshot and the place at which range readings were entered into
the map.
"""

from dataclasses import replace

import pytest
from support.fresh_state import (
    check_all_at_once,
    check_configured,
    check_fresh,
    check_round_trip,
    classes_of,
    leaves,
)
from support.stateful_objects import CONFIGURED, FRESH, NEVER_RESET

from t3mpc_ros.mpc.predictive_controller import PredictiveParameters

PACKAGES = 'control', 'mpc', 'fuzzy', 'chaos', 'robot', 'geometry', 'simulation', 'emulator'


def _name(kind):
    return getattr(kind, '__name__', kind)


SLOW = 'PortraitSource', 'Controller', 'Controller, paper', 'DigitalTwin'
CASES = [
    pytest.param(
        entry,
        operation,
        id=f'{_name(kind)}, {name}',
        marks=pytest.mark.slow if _name(kind) in SLOW else (),
    )
    for kind, entry in FRESH.items()
    for name, operation in entry.operations.items()
]
LONG = 'Controller', 'DigitalTwin', 'PaperRobot'
"""Those with so many parameters that the effect of each takes seconds."""
OF_PARAMETERS = [pytest.param(entry, id=_name(kind)) for kind, entry in CONFIGURED.items()]
ONE_BY_ONE = [
    pytest.param(*case.values, id=case.id, marks=pytest.mark.long if case.id in LONG else ())
    for case in OF_PARAMETERS
]


@pytest.fixture(autouse=True)
def short_pretraining(monkeypatch):
    """Each new controller pretrains its networks: on a shorter run their state is as complete."""
    short = replace(PredictiveParameters.excitation, duration=15.0, epochs=1)
    monkeypatch.setattr(PredictiveParameters, 'excitation', short)


def held_classes(table):
    """Return the names of the classes of all parts of the objects of a table."""
    made = [
        entry.make(entry.parameters) if table is CONFIGURED else entry.make()
        for entry in table.values()
    ]
    return {str(value).split(' of ')[0] for thing in made for _, value in leaves(thing)}


def test_every_class_with_a_state_is_in_an_object_of_a_table():
    classes = classes_of(PACKAGES)
    assert classes.keys() - held_classes(FRESH) == NEVER_RESET.keys()
    replaceable = {
        name
        for name, kind in classes.items()
        if hasattr(kind, 'configure') or 'eplaceable at run time' in (kind.__doc__ or '')
    }
    assert replaceable - held_classes(CONFIGURED) == {'FixedStepRobot'}


@pytest.mark.parametrize(('entry', 'operation'), CASES)
def test_a_used_object_is_as_new(entry, operation):
    check_fresh(entry, operation)


@pytest.mark.parametrize('entry', OF_PARAMETERS)
def test_all_parameters_are_replaced_at_once(entry):
    check_all_at_once(entry)


@pytest.mark.parametrize('entry', ONE_BY_ONE)
def test_replaced_parameters_are_those_of_a_new_object(entry):
    check_configured(entry)


@pytest.mark.parametrize('entry', OF_PARAMETERS)
def test_replaced_and_restored_parameters_leave_no_trace(entry):
    check_round_trip(entry)
