# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A claim about measured runs, and the one rule for its verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
import math
from typing import NamedTuple, Self

from t3mpc_ros.evaluation.confidence_intervals import Difference


class Finding(NamedTuple):
    """What the runs say about a claim."""

    held: bool
    """Whether they satisfy its criterion."""
    text: str
    numbers: Mapping[str, object]
    margins: Sequence[Difference]
    """By how much each part of the claim is satisfied, with its interval over the seeds."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim with its verdict."""

    name: str
    origin: str
    """``'ours'`` or ``'paper'``."""
    text: str
    """The claim and its criterion."""
    found: str = 'not measured'
    held: bool | None = None
    """None: not measured, or inconclusive."""
    numbers: dict[str, object] = field(default_factory=dict)
    inconclusive: bool = False
    """Whether too little was measured to decide."""

    @property
    def verdict(self) -> str:
        """``'held'``, ``'not held'``, ``'inconclusive'`` or ``'not measured'``."""
        if self.held is None:
            return 'inconclusive' if self.inconclusive else 'not measured'
        return 'held' if self.held else 'not held'

    def decided(self, finding: Finding | None, *, complete: bool) -> Self:
        """Return the claim with its verdict; without a finding it was not measured.

        With ``complete``, where as much was measured as the claim is about, its criterion decides.
        Otherwise the claim is inconclusive, unless all its parts are satisfied beyond doubt, one
        of them is not, or a run diverged.
        """
        if finding is None:
            return self
        margins = finding.margins
        sure = (
            complete
            or not all(math.isfinite(margin.mean) for margin in margins)
            or all(margin.mean > margin.half for margin in margins)
            or any(margin.mean < -margin.half for margin in margins)
        )
        return replace(
            self,
            found=finding.text,
            held=bool(finding.held) if sure else None,
            numbers=dict(finding.numbers),
            inconclusive=not sure,
        )

    def record(self) -> dict[str, object]:
        """Return the claim as plain data."""
        found = asdict(self) | {'verdict': self.verdict}
        del found['inconclusive']
        return found
