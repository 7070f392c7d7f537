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
"""Fixtures: the firmware core, robots in the states that tests start from, golden vectors."""

import json
from pathlib import Path

import pytest
from support.avr_boards import booted
from support.firmware_core import ACCELERATION, DECELERATION, KEY, OK, Robot, load_core

GOLDEN = Path(__file__).resolve().parents[1] / 'golden' / 'radio_vectors.json'


@pytest.fixture(scope='session')
def library():
    """Return the compiled core."""
    return load_core()


@pytest.fixture
def robot(library):
    """Return a robot without a key, in a session, at rest."""
    made = Robot(library)
    made.run(1000)
    made.hello()
    return made


@pytest.fixture
def slow_ramps(robot):
    """Return a robot with slow ramps: acceleration 15 rad/s², deceleration 30 rad/s²."""
    assert robot.set(ACCELERATION, 15_000) == (OK, 15_000)
    assert robot.set(DECELERATION, 30_000) == (OK, 30_000)
    return robot


@pytest.fixture
def keyed(library):
    """Return a robot with a key, in a session, at rest."""
    made = Robot(library, KEY)
    made.run(1000)
    made.hello()
    return made


@pytest.fixture(scope='session')
def golden():
    return json.loads(GOLDEN.read_text())


@pytest.fixture
def boards():
    """Yield both boards in simavr; at the end their data sheets were kept."""
    yield from booted()
