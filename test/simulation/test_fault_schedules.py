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
"""Faults as dynamic parameters and in schedules."""

from dataclasses import replace
import math
from pathlib import Path
import re
import runpy

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import setuptools
from support.properties import PROPERTY

from t3mpc_ros.simulation.fault_injection import FAULTS, FaultParameters, active_faults
from t3mpc_ros.simulation.fault_schedule import (
    SCHEDULES_FOLDER,
    FaultEvent,
    FaultSchedule,
    ScheduleError,
    load_schedule,
)
from t3mpc_ros.simulation.world import WORLDS_FOLDER

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / 'docs' / 'faults.md').read_text()
NO_FAULT = FaultParameters()
TABLES = NO_FAULT, FaultParameters(command_delay=0.7, gyro_dead=True)
SPECS = {spec.name: spec for spec in FaultParameters.specs()}
NAMES = list(FAULTS)


def some_value(name: str, generator: np.random.Generator) -> object:
    """Return a random valid value of a fault."""
    spec = SPECS[name]
    if spec.kind is bool:
        return bool(generator.integers(2))
    if spec.choices:
        return str(generator.choice(spec.choices))
    return float(generator.uniform(spec.low, spec.high))


def a_fault(name: str) -> object:
    """Return a value that makes the fault active."""
    spec = SPECS[name]
    if spec.kind is bool:
        return True
    return 'left' if spec.choices else 0.5


def write(folder: Path, text: str) -> Path:
    path = folder / 'ride.yaml'
    path.write_text(text)
    return path


# --- parameters ---------------------------------------------------------------------------------


def test_active_faults_report_name_value_and_unit():
    assert active_faults(NO_FAULT) == ()
    for name in NAMES:
        (text,) = active_faults(NO_FAULT.with_values({name: a_fault(name)}))
        assert text.split()[0] == name
    parameters = FaultParameters(
        command_delay=0.1, slippery=0.25, gyro_dead=True, wheel_blocked='left', schedule='x'
    )
    assert active_faults(parameters) == (
        'command_delay 0.1 s', 'gyro_dead', 'wheel_blocked left', 'slippery 0.25',
    )  # fmt: skip


# --- a schedule ---------------------------------------------------------------------------------


def test_empty_schedule_changes_nothing():
    dynamic = FaultParameters(command_loss=0.5)
    assert load_schedule('').at(3.0, dynamic) == dynamic
    assert load_schedule('').events == ()


def naive(events: list[FaultEvent], elapsed: float, dynamic: FaultParameters) -> FaultParameters:
    """Return the active faults by a direct evaluation of the rule, fault by fault."""
    values = {}
    for name in NAMES:
        holding = [
            (event.at, index, event.value)
            for index, event in enumerate(events)
            if event.fault == name and event.at <= elapsed < event.at + event.duration
        ]
        if holding:
            values[name] = max(holding, key=lambda one: one[:2])[2]
    return replace(dynamic, **values)


def event_of(name):
    """Draw an event on a grid of 1/4 s, so that many start and end at the same time."""
    quarter = st.integers(1, 20).map(lambda count: count / 4)
    value = st.integers(0, 2**32).map(lambda n: some_value(name, np.random.default_rng(n)))
    return st.builds(FaultEvent, quarter, st.just(name), value, quarter | st.just(math.inf))


@pytest.mark.slow
@PROPERTY
@given(
    st.lists(
        st.sampled_from(NAMES[:4]).flatmap(event_of) | st.sampled_from(NAMES).flatmap(event_of)
    ),
    st.lists(
        st.tuples(st.integers(-4, 90).map(lambda n: n / 8), st.sampled_from(TABLES)), min_size=9
    ),
)
def test_a_schedule_is_the_naive_evaluation_in_any_order(events, questions):
    schedule = FaultSchedule(events)
    for elapsed, dynamic in questions:
        assert schedule.at(elapsed, dynamic) == naive(events, elapsed, dynamic)


def test_rounding_does_not_change_event_duration():
    """The floats 0.1 + 0.2 and 3 * 0.1 are more than 0.3, which extended an event by a step."""
    schedule = FaultSchedule([FaultEvent(0.2, 'gyro_dead', True, 0.1)])
    assert schedule.at(0.2, NO_FAULT).gyro_dead
    assert not schedule.at(0.3, NO_FAULT).gyro_dead
    assert not schedule.at(300_000_000 / 1e9, NO_FAULT).gyro_dead
    for at in range(1, 200):
        late = FaultSchedule([FaultEvent(at / 100, 'gyro_dead', True)])
        ticks = [tick for tick in range(202) if late.at(0.01 * tick, NO_FAULT).gyro_dead]
        assert ticks[0] == at


def test_result_is_cached_until_something_changes():
    schedule = FaultSchedule([FaultEvent(1.0, 'gyro_dead', True, 2.0)])
    first = schedule.at(1.0, NO_FAULT)
    assert schedule.at(2.9, NO_FAULT) is first
    assert schedule.at(2.9, FaultParameters()) is first  # an equal table is not a change
    with pytest.raises(ValueError, match='elapsed must be finite'):
        schedule.at(math.nan, NO_FAULT)


# --- files --------------------------------------------------------------------------------------


def test_list_and_mapping_with_events_are_equivalent(tmp_path):
    lines = [f'- {{at: 1.5, fault: {name}, value: {a_fault(name)}, for: 2}}\n' for name in NAMES]
    read = load_schedule(write(tmp_path, ''.join(lines))).events
    assert read == tuple(FaultEvent(1.5, name, a_fault(name), 2.0) for name in NAMES)
    entry = '- {at: 1, fault: slippery, value: 0, for: 2}\n'
    alone = load_schedule(write(tmp_path, entry)).events
    below = load_schedule(str(write(tmp_path, 'events:\n' + entry))).events
    assert alone == below == (FaultEvent(1.0, 'slippery', 0.0, 2.0),)
    assert isinstance(alone[0].value, float)


ENTRY = '- {at: 1, fault: gyro_dead, value: true, for: 2}\n'
TOO_MUCH = ENTRY * 3 + '- {at: 1, fault: command_loss, value: 3}'
BAD = {
    'hello': ['events must be a list', 'hello'],
    'events: []\nfaults: []': ["the schedule has no 'faults'"],
    ENTRY + '- {at: 1': ['not YAML', 'line 2'],
    ENTRY + '- gyro_dead': ['events[1] must hold at, fault, value, for', 'gyro'],
    '- {at: 1, fault: gyro_dead}': ['events[0] must have value'],
    ENTRY + '- {at: 1, fault: comand_delay, value: 0.1}': [
        'events[1].fault', 'comand_delay', 'did you mean command_delay?', 'brown_out',
    ],
    '- {at: 1, fault: schedule, value: x}': ["got 'schedule'"],
    '- {at: 1, fault: [gyro_dead], value: true}': ["got ['gyro_dead']"],
    TOO_MUCH: ['events[3].value: command_loss must be from 0 to 1: got 3'],
    f'- {{at: 1, fault: command_loss, value: 1{"0" * 400}}}': [
        'events[0].value: command_loss must be from 0 to 1'
    ],
    '- {at: 1, fault: gyro_dead, value: 1}': [
        'events[0].value: gyro_dead must be true or false: got 1'
    ],
    '- {at: .inf, fault: gyro_dead, value: true}': ['events[0].at', 'got inf'],
    '- {at: 1, fault: gyro_dead, value: true, for: }': [
        'events[0].for must be a number from 0.02 to 1e+06 s: got None'
    ],
}  # fmt: skip


def test_invalid_file_error_names_file_entry_bound_and_value(tmp_path):
    for text, words in BAD.items():
        path = write(tmp_path, text)
        with pytest.raises(ScheduleError) as caught:
            load_schedule(path)
        message = str(caught.value)
        assert message.startswith((f'{path}: ', f'{path} is not YAML: '))
        assert '\n' not in message
        assert len(message) < 400 + len(str(path))
        for word in words:
            assert word in message


def test_unreadable_files_are_rejected_by_name(tmp_path):
    for path, words in [(tmp_path / 'no.yaml', 'No such file'), (tmp_path, 'directory')]:
        with pytest.raises(ScheduleError, match=rf'{re.escape(str(path))} cannot be .*{words}'):
            load_schedule(path)
    (tmp_path / 'no.yaml').write_bytes(b'- \xff')
    with pytest.raises(ScheduleError, match='must be UTF-8 text'):
        load_schedule(tmp_path / 'no.yaml')


def test_unknown_schedule_name_suggests_the_nearest():
    with pytest.raises(ScheduleError, match='rough_ride, or a file.*did you mean rough_ride'):
        load_schedule('rough_rid')


# --- bundled schedule and documentation ---------------------------------------------------------


def test_bundled_schedule_covers_every_fault_and_ends_clean():
    schedule = load_schedule('rough_ride')
    assert schedule.name == 'rough_ride'
    assert {event.fault for event in schedule.events} == set(NAMES)
    assert schedule.at(0.0, NO_FAULT) == NO_FAULT
    assert schedule.at(60.0, NO_FAULT) == NO_FAULT
    for event in schedule.events:
        assert getattr(schedule.at(event.at, NO_FAULT), event.fault) == event.value
        assert active_faults(schedule.at(event.at, NO_FAULT))


def test_schedules_are_installed_with_the_package(monkeypatch):
    called = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **arguments: called.update(arguments))
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / 'setup.py'))
    package = 't3mpc_ros.simulation'
    assert package in called['packages']
    folder = ROOT / package.replace('.', '/')
    installed = {path for glob in called['package_data'][package] for path in folder.glob(glob)}
    assert installed
    assert installed == {
        path
        for data in (SCHEDULES_FOLDER, WORLDS_FOLDER)
        for path in data.iterdir()
        if path.is_file()
    }


def test_documented_example_is_a_valid_schedule(tmp_path):
    (text,) = re.findall(r'```yaml\n(.*?)```', PAGE, re.DOTALL)
    schedule = load_schedule(write(tmp_path, text))
    delays = [schedule.at(time, NO_FAULT).command_delay for time in (4.9, 5.0, 6.0, 7.0, 9.0)]
    assert delays == [0.0, 0.1, 0.3, 0.1, 0.0]
    assert active_faults(schedule.at(6.5, NO_FAULT)) == ('command_delay 0.3 s', 'command_loss 0.2')
    assert schedule.at(12.05, NO_FAULT).brown_out
    assert not schedule.at(12.1, NO_FAULT).brown_out
    assert schedule.at(3600.0, NO_FAULT) == FaultParameters(load_change=0.5)


def test_documented_error_message_is_current(tmp_path, monkeypatch):
    (text,) = re.findall(r'```text\n(.*?)\n```', PAGE, re.DOTALL)
    (tmp_path / 'faults.yaml').write_text(TOO_MUCH)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScheduleError) as caught:
        load_schedule('faults.yaml')
    assert str(caught.value) == text


def test_documentation_lists_every_fault():
    lines = []
    for spec in FaultParameters.specs():
        if spec.dynamic:
            default = f'{spec.default:g}' if spec.kind is float else str(spec.default).lower()
            first = f'`{spec.name}` | {default} {spec.unit}'.rstrip()
            middle = f'{spec.bounds_text()} ' if spec.bounds_text() else ''
            lines.append(f'| {first} | {middle}| {spec.text} |')
    assert '\n'.join(lines) + '\n\n' in PAGE
