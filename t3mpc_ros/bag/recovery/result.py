# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Result of a recovery: messages kept and lost by topic, damaged spans."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from t3mpc_ros.geometry.types import NANOSECONDS


@dataclass(frozen=True)
class Damage:
    """Range of a file that was not usable, or only in part."""

    start: int
    end: int
    reason: str
    harmless: bool = False
    """Whether no information was lost, because it is duplicated elsewhere in the file."""
    messages: int | None = None
    """Number of lost messages; None if unknown."""
    span_ns: tuple[int, int] | None = None
    """Receive times between which messages were lost; None if unknown."""

    @property
    def size(self) -> int:
        """Size of the range, bytes."""
        return self.end - self.start


@dataclass
class TopicResult:
    """Messages of one topic."""

    name: str
    type_name: str
    kept: int = 0
    unchecked: int = 0
    """Number of kept messages that no checksum covers."""
    lost: int = 0
    """Number of messages known to be lost."""


@dataclass
class FileResult:
    """Result of one file."""

    name: str
    size: int
    """Bytes."""
    copied: bool = False
    """Whether the file was intact and copied."""
    ended: bool = False
    """Whether the end of the data section was found: the writer completed the file."""
    topics: dict[str, TopicResult] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    exact: bool = False
    """Whether :attr:`TopicResult.lost` is complete, because the file has its statistics."""
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        """Whether nothing was lost; False without the end of the data section."""
        return self.ended and all(damage.harmless for damage in self.damages)

    @property
    def lost_bytes(self) -> int:
        """Bytes of the file that were not usable, or only in part."""
        return sum(damage.size for damage in self.damages if not damage.harmless)


@dataclass(frozen=True)
class RecoveryResult:
    """Result of a bag."""

    output: Path
    files: tuple[FileResult, ...]

    @property
    def clean(self) -> bool:
        """Whether nothing was lost."""
        return all(file.clean for file in self.files)

    @property
    def exact(self) -> bool:
        """Whether the counts of lost messages are complete."""
        return all(file.exact or file.clean for file in self.files)

    @property
    def kept(self) -> int:
        """Messages in the output."""
        return sum(topic.kept for topic in self.topics.values())

    @property
    def lost(self) -> int:
        """Messages known to be lost."""
        return sum(topic.lost for topic in self.topics.values())

    @property
    def lost_bytes(self) -> int:
        """Bytes of the input that were not usable, or only in part."""
        return sum(file.lost_bytes for file in self.files)

    @property
    def lost_seconds(self) -> float | None:
        """Seconds of the recording in which messages were lost; None if unknown."""
        damages = [d for file in self.files for d in file.damages if not d.harmless]
        spans = [damage.span_ns for damage in damages if damage.span_ns is not None]
        if len(spans) < len(damages) or not all(file.ended for file in self.files):
            return None
        return _union_length(spans) / NANOSECONDS

    @property
    def topics(self) -> dict[str, TopicResult]:
        """Topics of all files by name."""
        merged: dict[str, TopicResult] = {}
        for file in self.files:
            for topic in file.topics.values():
                total = merged.setdefault(topic.name, TopicResult(topic.name, topic.type_name))
                total.kept += topic.kept
                total.unchecked += topic.unchecked
                total.lost += topic.lost
        return dict(sorted(merged.items()))


def _union_length(spans: Iterable[tuple[int, int]]) -> int:
    """Return the length of the union of the spans."""
    total = 0
    reached = -1
    for first, last in sorted(spans):
        total += max(0, last - max(first, reached)) if last > reached else 0
        reached = max(reached, last)
    return total
