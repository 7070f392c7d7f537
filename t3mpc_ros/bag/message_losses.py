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
"""Messages that a recorder has lost, as a record of metadata in its bag."""

from collections.abc import Mapping

LOSSES = 'losses'
"""Name of the metadata record of :func:`message_loss_record`."""
UNDISCOVERED = 'undiscovered'
"""Cause of the messages that a recorder misses while it starts."""
LOSS_CAUSES = {
    'dropped': 'dropped because the disk was too slow',
    'lost': 'lost by the middleware',
    UNDISCOVERED: 'published before the recorder had discovered their publisher',
}
"""Why messages are missing in a bag, by key of its loss record."""


def message_loss_record(
    dropped: Mapping[str, int], lost: Mapping[str, int], undiscovered: Mapping[str, int]
) -> dict[str, str]:
    """Return the metadata record of missing messages, by cause (:data:`LOSS_CAUSES`) and topic."""
    causes = dict(zip(LOSS_CAUSES, (dropped, lost, undiscovered), strict=True))
    table = {cause: str(sum(counts.values())) for cause, counts in causes.items()}
    for cause, counts in causes.items():
        table |= {f'{cause} {topic}': str(count) for topic, count in sorted(counts.items())}
    return table


def message_losses(tables: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, int]]:
    """Return the number of missing messages by cause and topic, by the records of a bag."""
    found: dict[str, dict[str, int]] = {cause: {} for cause in LOSS_CAUSES}
    for key, count in tables.get(LOSSES, {}).items():
        cause, _, topic = key.partition(' ')
        if topic and cause in found and count.isdecimal():
            found[cause][topic] = int(count)
    return found


def message_loss_notes(tables: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return a sentence for each topic and cause of :func:`message_losses`."""
    return [
        f'{count} messages of {topic} are missing: {LOSS_CAUSES[cause]}.'
        for cause, topics in message_losses(tables).items()
        for topic, count in topics.items()
    ]
