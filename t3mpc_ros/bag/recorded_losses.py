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
"""Messages that a recorder or a recovery has lost, as a record of metadata in the bag."""

from collections.abc import Iterable, Mapping

LOSSES = 'losses'
"""Name of the metadata record of :func:`message_loss_record`; begin of that of a recovery."""
DAMAGED = 'damaged'
"""Cause of the messages that a recovery could not read."""
_SPAN = 'span'
UNDISCOVERED = 'undiscovered'
"""Cause of the messages that a recorder misses while it starts."""
LOSS_CAUSES = {
    'dropped': 'dropped because the disk was too slow',
    'lost': 'lost by the middleware',
    UNDISCOVERED: 'published before the recorder had discovered their publisher',
    DAMAGED: 'lost in damaged parts of the file',
}
"""Why messages are missing in a bag, by key of its loss record."""


def message_loss_record(
    dropped: Mapping[str, int], lost: Mapping[str, int], undiscovered: Mapping[str, int]
) -> dict[str, str]:
    """Return the metadata record of missing messages, by cause (:data:`LOSS_CAUSES`) and topic."""
    return _record_of({'dropped': dropped, 'lost': lost, UNDISCOVERED: undiscovered})


def damage_record(lost: Mapping[str, int], spans: Iterable[tuple[int, int]]) -> dict[str, str]:
    """Return the metadata record of the messages that a recovery could not read, by topic.

    Those are of some spans of receive times, ns.
    """
    times = {f'{_SPAN} {k}': f'{low} {high}' for k, (low, high) in enumerate(spans)}
    return _record_of({DAMAGED: lost}) | times


def _record_of(causes: Mapping[str, Mapping[str, int]]) -> dict[str, str]:
    """Return the sum of each cause, and the number of each cause and topic."""
    table = {cause: str(sum(counts.values())) for cause, counts in causes.items()}
    for cause, counts in causes.items():
        table |= {f'{cause} {topic}': str(count) for topic, count in sorted(counts.items())}
    return table


def is_loss_record(title: str) -> bool:
    """Whether a metadata record, by its name, is one of missing messages."""
    return title.split(' ')[0] == LOSSES


def lost_spans(tables: Mapping[str, Mapping[str, str]]) -> list[tuple[int, int]]:
    """Return the receive times (ns) between which a recovery could not read messages."""
    found = []
    for table in _loss_tables(tables):
        for key, text in table.items():
            low, _, high = text.partition(' ')
            if key.startswith(f'{_SPAN} ') and low.isdecimal() and high.isdecimal():
                found.append((int(low), int(high)))
    return sorted(found)


def _loss_tables(tables: Mapping[str, Mapping[str, str]]) -> list[Mapping[str, str]]:
    return [table for title, table in tables.items() if is_loss_record(title)]


def message_losses(tables: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, int]]:
    """Return the number of missing messages by cause and topic, by the records of a bag."""
    found: dict[str, dict[str, int]] = {cause: {} for cause in LOSS_CAUSES}
    for table in _loss_tables(tables):
        for key, count in table.items():
            cause, _, topic = key.partition(' ')
            if topic and cause in found and count.isdecimal():
                found[cause][topic] = found[cause].get(topic, 0) + int(count)
    return found


def message_loss_notes(tables: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return a sentence for each topic and cause of :func:`message_losses`."""
    return [
        f'{count} messages of {topic} are missing: {LOSS_CAUSES[cause]}.'
        for cause, topics in message_losses(tables).items()
        for topic, count in topics.items()
    ]
