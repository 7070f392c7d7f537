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
"""Changes of the map in a bag: what a patrol found, as a table and as points on the floor."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from t3mpc_ros.bag.reader import BagReader
from t3mpc_ros.evaluation.html_page import Block, Heading, Paragraph
from t3mpc_ros.evaluation.report_table import Table
from t3mpc_ros.geometry.types import Array

TOPIC = 'map_changes'
NUMBERS = ('x_m', 'y_m', 'size_m', 'confidence', 'first_seen_s', 'found_s', 'last_seen_s')


class RecordedChange(NamedTuple):
    """What contradicted the map, as last published."""

    kind: str
    state: str
    """there, gone or withdrawn"""
    x: float
    """m"""
    y: float
    """m"""
    size: float
    """m"""
    confidence: float
    found: float
    """Time of the first message with it, s."""
    seen_before: float
    """Time for which it was seen before that, s."""
    seen_for: float
    """Time from the first to the last sight, s."""


def read_map_changes(
    recording: BagReader, namespace: str, local: Callable[[Array], Array]
) -> tuple[RecordedChange, ...]:
    """Return the changes in a bag; ``local`` maps receive times to times of the run, s."""
    topic = recording.topics.get(f'{namespace}/{TOPIC}')
    if topic is None or not topic.type_name.endswith('DiagnosticArray'):
        return ()
    found: dict[str, RecordedChange] = {}
    for received, message in recording.messages(topic.name):
        for status in message.status:
            values = {each.key: each.value for each in status.values}
            before = found.get(status.name)
            with suppress(KeyError, ValueError):  # of another publisher
                x, y, size, confidence, first, event, last = (
                    float(values[key]) for key in NUMBERS
                )
                gone = 'withdrawn' if values.get('withdrawn') == 'True' else 'gone'
                found[status.name] = RecordedChange(
                    values['kind'], 'there' if values['present'] == 'True' else gone,
                    x, y, size, confidence,
                    before.found if before else float(local(np.array([received]))[0]),
                    event - first, last - first,
                )  # fmt: skip
    return tuple(found.values())


def map_change_blocks(changes: tuple[RecordedChange, ...]) -> Iterator[Block]:
    """Yield the section; nothing without changes."""
    if not changes:
        return
    yield Heading('What contradicts the map')
    head = ['found / s', 'kind', 'place', 'size', 'confidence', 'seen before', 'seen for', 'state']
    rows = [
        [
            f'{each.found:.1f}', each.kind, f'x {each.x:.2f} m, y {each.y:.2f} m',
            f'{each.size:.2f} m', f'{each.confidence:.2f}', f'{each.seen_before:.1f} s',
            f'{each.seen_for:.1f} s', each.state,
        ]
        for each in changes
    ]  # fmt: skip
    yield Table('', head, rows, text=4)
    yield Paragraph(
        'New: a thing that the map lacks; missing: one that is not where the map has it; moving: '
        'it was seen, and then that it was gone. The place is the middle of what was seen of it. '
        'Withdrawn: the robot was lost, and had not been where it took itself to be.',
        'quiet',
    )
