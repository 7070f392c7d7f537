# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""HTML page of the reproduction: each figure and table beside the claims it decides."""

import base64
from collections.abc import Mapping, Sequence
from html import escape

from t3mpc_ros.evaluation.paper.claims import Claim
from t3mpc_ros.evaluation.paper.exhibits import EXHIBITS, Exhibit
from t3mpc_ros.evaluation.reporting import Table

_CLASS = {
    'held': 'yes',
    'not held': 'no',
    'inconclusive': 'open',
    'not measured': 'open',
    'not comparable': 'apart',
}

_CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1.2rem 1rem 4rem; color: #1f2937;
  background: #fff; font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; }
h2 { font-size: 1.15rem; margin: 3rem 0 .6rem; padding-top: .8rem; border-top: 1px solid #e5e7eb; }
p { margin: .3rem 0; }
.quiet { color: #6b7280; font-size: .9rem; }
.mark { display: inline-block; border-radius: 1rem; padding: 0 .65rem; font-size: .82rem;
  font-weight: 600; white-space: nowrap; }
.yes { background: #dcfce7; color: #166534; } .no { background: #fee2e2; color: #991b1b; }
.open { background: #fef3c7; color: #92400e; } .apart { background: #e5e7eb; color: #374151; }
.words { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem; margin: .6rem 0 1rem; }
.words > div { border-left: 3px solid #d1d5db; padding-left: .8rem; }
.words h3 { margin: 0; font-size: .82rem; color: #6b7280; }
.words ul { margin: 0; padding-left: 1.1rem; } .words li { margin: .25rem 0; }
@media (max-width: 44rem) { .words { grid-template-columns: 1fr; } }
figure { margin: .4rem 0 0; max-width: 50rem; }
figure img { display: block; width: 100%; height: auto; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; }
caption { text-align: left; font-weight: 600; padding: .2rem 0; }
th, td { text-align: right; padding: .22rem .6rem; border-bottom: 1px solid #e5e7eb;
  white-space: nowrap; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
th { color: #6b7280; font-weight: 600; }
tr.own td { background: #fff1f2; font-weight: 600; }
table.claims td, table.claims th { text-align: left; white-space: normal; vertical-align: top; }
details { margin: .6rem 0; } summary { cursor: pointer; font-weight: 600; }
"""


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
    figures
        PNG files by stem, :func:`t3mpc_ros.evaluation.paper.exhibits.figures`.
    findings
        Words by stem where no claim decides, by ``findings`` of the same module.
    """
    parts = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<title>{escape(title)}</title>\n<style>{_CSS}</style>\n</head>\n<body>',
        f'<h1>{escape(title)}</h1>',
        f'<p class="quiet">{escape(origin)}</p>',
        '<h2>Claims</h2>',
        _claims('What this project claims', [c for c in claims if c.origin == 'ours']),
        _claims('What the paper claims', [c for c in claims if c.origin == 'paper']),
    ]
    parts += [_exhibit(exhibit, claims, tables, pictures, findings) for exhibit in EXHIBITS]
    return '\n'.join([*parts, '</body>\n</html>\n'])


def counted(claims: Sequence[Claim]) -> str:
    """Return how many claims are held, not held, inconclusive and not measured."""
    verdicts = [claim.verdict for claim in claims]
    return ', '.join(f'{verdicts.count(kind)} {kind}' for kind in list(_CLASS)[:4])


def _claims(title: str, claims: Sequence[Claim]) -> str:
    rows = ''.join(
        f'<tr><td>{escape(claim.text)}</td><td>{escape(claim.found)}</td>'
        f'<td>{_mark(claim.verdict)}</td></tr>\n'
        for claim in claims
    )
    summary = f'<summary>{escape(title)}: {counted(claims)}</summary>'
    head = '<tr><th>claim</th><th>found</th><th></th></tr>'
    return (
        f'<details open>{summary}<div class="wide"><table class="claims">{head}\n{rows}'
        '</table></div></details>'
    )


def _exhibit(
    exhibit: Exhibit,
    claims: Sequence[Claim],
    tables: Mapping[str, Sequence[Table]],
    pictures: Mapping[str, bytes],
    findings: Mapping[str, str],
) -> str:
    found = ''.join(
        f'<li>{escape(claim.text)}: {escape(claim.found)} {_mark(claim.verdict)}</li>'
        for claim in exhibit.decided_by(claims)
    )
    here = (
        f'<ul>{found}</ul>'
        if found
        else f'<p>{escape(findings.get(exhibit.stem, exhibit.caption))}</p>'
    )
    parts = [
        f'<section>\n<h2>{escape(exhibit.title)} {_mark(exhibit.mark(claims))}</h2>',
        f'<div class="words"><div><h3>The paper</h3><p>{escape(exhibit.paper)}</p></div>',
        f'<div><h3>Found here</h3>{here}</div></div>',
    ]
    if png := pictures.get(exhibit.stem):
        data = base64.b64encode(png).decode()
        parts.append(
            f'<figure><img alt="{escape(exhibit.title)}" src="data:image/png;base64,{data}">'
        )
        parts.append(f'<figcaption class="quiet">{escape(exhibit.caption)}</figcaption></figure>')
    elif exhibit.stem:
        parts.append('<p class="quiet">Left out: nothing of it was measured.</p>')
    shown = [table.html() for table in tables.get(exhibit.tables, ())]
    parts += shown[:2]
    if shown[2:]:
        more = ''.join(shown[2:])
        parts.append(f'<details><summary>{len(shown) - 2} more tables</summary>{more}</details>')
    return '\n'.join([*parts, '</section>'])


def _mark(verdict: str) -> str:
    return f'<span class="mark {_CLASS[verdict]}">{verdict}</span>'
