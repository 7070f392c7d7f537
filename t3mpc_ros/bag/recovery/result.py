# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Result of a recovery: messages kept and lost by topic, damaged spans."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from t3mpc_ros.geometry.types import NANOSECONDS


@dataclass(frozen=True)
class Damage:
    """A stretch of a file that could not be used, or only in part."""

    start: int
    end: int
    reason: str
    harmless: bool = False
    """Nothing was lost with it: it only repeated what stands elsewhere."""
    messages: int | None = None
    """How many messages were lost in it; None when nobody knows."""
    span_ns: tuple[int, int] | None = None
    """Times of receipt between which messages were lost; None when nobody knows."""

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self.end - self.start


@dataclass
class TopicResult:
    """What became of one topic."""

    name: str
    type_name: str
    kept: int = 0
    unchecked: int = 0
    """How many of the kept ones no checksum vouches for."""
    lost: int = 0
    """How many are known to be lost."""


@dataclass
class FileResult:
    """What became of one file."""

    name: str
    size: int
    """Bytes."""
    copied: bool = False
    """It was sound, and copied as it is."""
    ended: bool = False
    """The end of its data was there: its writer had nothing more to write."""
    topics: dict[str, TopicResult] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    exact: bool = False
    """The file says how many messages there were, so :attr:`TopicResult.lost` is all."""
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        """Whether nothing was lost; never so when the end of the data was not there."""
        return self.ended and all(damage.harmless for damage in self.damages)

    @property
    def lost_bytes(self) -> int:
        """Bytes of the file that could not be used, or only in part."""
        return sum(damage.size for damage in self.damages if not damage.harmless)


@dataclass(frozen=True)
class RecoveryResult:
    """What became of a bag."""

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
        """Bytes of the input that could not be used, or only in part."""
        return sum(file.lost_bytes for file in self.files)

    @property
    def lost_seconds(self) -> float | None:
        """Seconds of recording in which messages were lost; None when nobody knows."""
        damages = [d for file in self.files for d in file.damages if not d.harmless]
        spans = [damage.span_ns for damage in damages if damage.span_ns is not None]
        if len(spans) < len(damages) or not all(file.ended for file in self.files):
            return None
        return _union_length(spans) / NANOSECONDS

    @property
    def topics(self) -> dict[str, TopicResult]:
        """Topics of all files together, by name."""
        merged: dict[str, TopicResult] = {}
        for file in self.files:
            for topic in file.topics.values():
                total = merged.setdefault(topic.name, TopicResult(topic.name, topic.type_name))
                total.kept += topic.kept
                total.unchecked += topic.unchecked
                total.lost += topic.lost
        return dict(sorted(merged.items()))


def _union_length(spans: Iterable[tuple[int, int]]) -> int:
    """Return how long the spans are together; where they overlap, once."""
    total = 0
    reached = -1
    for first, last in sorted(spans):
        total += max(0, last - max(first, reached)) if last > reached else 0
        reached = max(reached, last)
    return total
