# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""HTML page of the reproduction: each figure and table beside the claims it decides."""

from collections.abc import Mapping, Sequence

from t3mpc_ros.evaluation.paper.claims import Claim
from t3mpc_ros.evaluation.paper.exhibits import EXHIBITS, Exhibit
from t3mpc_ros.evaluation.reporting import (
    Block,
    Details,
    Group,
    Heading,
    Items,
    Mark,
    Paragraph,
    Picture,
    Table,
    html_page,
)

_KINDS = {
    'held': 'yes',
    'not held': 'no',
    'inconclusive': 'open',
    'not measured': 'open',
    'not comparable': 'apart',
}


def page(
    title: str,
    origin: str,
    claims: Sequence[Claim],
    tables: Mapping[str, Sequence[Table]],
    pictures: Mapping[str, bytes],
    findings: Mapping[str, str],
) -> str:
    """Return the page as HTML that loads nothing from anywhere.

    Parameters
    ----------
    title, origin
        What it is about, and where its numbers come from.
    claims
        Every claim, decided.
    tables
        By heading, :func:`t3mpc_ros.evaluation.paper.result_tables.all_tables`.
    pictures
        PNG files by stem.
    findings
        Words by stem where no claim decides, by ``findings`` of the same module.
    """
    return html_page(
        title,
        [
            Paragraph(origin, 'quiet'),
            Heading('Claims'),
            _claims('What this project claims', [c for c in claims if c.origin == 'ours']),
            _claims('What the paper claims', [c for c in claims if c.origin == 'paper']),
            *(_exhibit(exhibit, claims, tables, pictures, findings) for exhibit in EXHIBITS),
        ],
    )


def counted(claims: Sequence[Claim]) -> str:
    """Return how many claims are held, not held, inconclusive and not measured."""
    verdicts = [claim.verdict for claim in claims]
    return ', '.join(f'{verdicts.count(kind)} {kind}' for kind in list(_KINDS)[:4])


def _claims(title: str, claims: Sequence[Claim]) -> Details:
    rows = [(claim.text, claim.found, _mark(claim.verdict)) for claim in claims]
    table = Table('', ('claim', 'found', ''), rows, text=3, wrap=True)
    return Details(f'{title}: {counted(claims)}', [table], opened=True)


def _exhibit(
    exhibit: Exhibit,
    claims: Sequence[Claim],
    tables: Mapping[str, Sequence[Table]],
    pictures: Mapping[str, bytes],
    findings: Mapping[str, str],
) -> Group:
    found: list[Sequence[str | Mark]] = [
        (f'{claim.text}: {claim.found}', _mark(claim.verdict))
        for claim in exhibit.decided_by(claims)
    ] or [(findings.get(exhibit.stem, exhibit.caption),)]
    sides = [
        Items([(exhibit.paper,)], 'side', 'The paper'),
        Items(found, 'side', 'Found here'),
    ]
    blocks: list[Block] = [
        Heading(exhibit.title, _mark(exhibit.mark(claims))),
        Group(sides, 'div', 'sides'),
    ]
    if png := pictures.get(exhibit.stem):
        blocks.append(Picture(exhibit.title, png, exhibit.caption))
    elif exhibit.stem:
        blocks.append(Paragraph('Left out: nothing of it was measured.', 'quiet'))
    shown = tables.get(exhibit.tables, ())
    blocks += shown[:2]
    if more := shown[2:]:
        blocks.append(Details(f'{len(more)} more tables', more))
    return Group(blocks)


def _mark(verdict: str) -> Mark:
    return Mark(verdict, _KINDS[verdict])
