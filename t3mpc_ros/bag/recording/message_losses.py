# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Metadata record of the messages that are missing in a bag."""

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
    dropped: Mapping[str, int],
    lost: Mapping[str, int],
    undiscovered: Mapping[str, int],
) -> dict[str, str]:
    """Return the metadata record of missing messages, by cause (:data:`LOSS_CAUSES`) and topic."""
    causes = dict(zip(LOSS_CAUSES, (dropped, lost, undiscovered), strict=True))
    table = {cause: str(sum(counts.values())) for cause, counts in causes.items()}
    for cause, counts in causes.items():
        table |= {f'{cause} {topic}': str(count) for topic, count in sorted(counts.items())}
    return table


def message_loss_notes(records: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return a sentence for each topic and cause in the loss record of a bag.

    ``records`` are the metadata records of the bag, by name.
    """
    notes = []
    for key, count in records.get(LOSSES, {}).items():
        cause, _, topic = key.partition(' ')
        if topic and cause in LOSS_CAUSES:
            notes.append(f'{count} messages of {topic} are missing: {LOSS_CAUSES[cause]}.')
    return notes
