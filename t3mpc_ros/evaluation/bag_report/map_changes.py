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
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.bag.reader import BagReader
from t3mpc_ros.evaluation.reporting import Block, Heading, Paragraph, Table
from t3mpc_ros.geometry.types import Array

TOPIC = 'map_changes'


class RecordedChange(NamedTuple):
    """What contradicted the map, as last published."""

    name: str
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
    """Return the changes in a bag, in the order in which they were found.

    local : maps receive times to times of the run, s
    """
    topic = recording.topics.get(f'{namespace}/{TOPIC}')
    if topic is None or not topic.type_name.endswith('DiagnosticArray'):
        return ()
    found: dict[str, RecordedChange] = {}
    for received, message in recording.messages(topic.name):
        for status in message.status:
            try:
                begin = found[status.name].found if status.name in found else None
                change = _change(
                    status, float(local(np.array([received]))[0]) if begin is None else begin
                )
            except (KeyError, ValueError):  # of another publisher
                continue
            found[status.name] = change
    return tuple(found.values())


def _change(status: Any, found: float) -> RecordedChange:
    values = {each.key: each.value for each in status.values}
    first, event, last = (
        float(values[f'{key}_s']) for key in ('first_seen', 'found', 'last_seen')
    )
    gone = 'withdrawn' if values.get('withdrawn') == 'True' else 'gone'
    return RecordedChange(
        status.name,
        values['kind'],
        'there' if values['present'] == 'True' else gone,
        float(values['x_m']),
        float(values['y_m']),
        float(values['size_m']),
        float(values['confidence']),
        found,
        event - first,
        last - first,
    )


def map_change_blocks(changes: tuple[RecordedChange, ...]) -> Iterator[Block]:
    """Yield the section; nothing without changes."""
    if not changes:
        return
    yield Heading('What contradicts the map')
    head = ['found / s', 'kind', 'place', 'size', 'confidence', 'seen before', 'seen for', 'state']
    rows = [
        [
            f'{each.found:.1f}',
            each.kind,
            f'x {each.x:.2f} m, y {each.y:.2f} m',
            f'{each.size:.2f} m',
            f'{each.confidence:.2f}',
            f'{each.seen_before:.1f} s',
            f'{each.seen_for:.1f} s',
            each.state,
        ]
        for each in changes
    ]
    yield Table('', head, rows, text=4)
    yield Paragraph(
        'New: a thing that the map lacks; missing: one that is not where the map has it; moving: '
        'it was seen, and then that it was gone. The place is the middle of what was seen of it. '
        'Withdrawn: the robot was lost, and had not been where it took itself to be.',
        'quiet',
    )
