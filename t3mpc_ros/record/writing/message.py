# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What comes from a topic, on its way into a bag."""

from dataclasses import dataclass
from typing import NamedTuple

from t3mpc_ros.record.quality import QualityProfile

OVERHEAD = 256
"""Bytes that a message costs in memory besides its data."""


class Message(NamedTuple):
    """One serialised message, unopened; stamps in nanoseconds since 1970."""

    topic: str
    received_ns: int
    published_ns: int
    data: bytes

    @property
    def cost(self) -> int:
        """Bytes that it takes in memory."""
        return len(self.data) + OVERHEAD


@dataclass(frozen=True, slots=True)
class Announcement:
    """What a bag has to know of a topic before its first message."""

    topic: str
    type_name: str
    profiles: tuple[QualityProfile, ...] = ()
    """What its publishers offer."""
    type_hash: str | None = None
