# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tables and sizes for a terminal."""

from collections.abc import Sequence


def columns(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Return the rows below each other; columns whose numbers are in ``right`` end flush."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if i in right else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append('  '.join(cells).rstrip())
    return '\n'.join(lines)


def size_text(count: int) -> str:
    """Return a number of bytes in the unit that suits it."""
    if count < 1000:
        return f'{count} B'
    value = float(count)
    for unit in ('kB', 'MB', 'GB'):
        value /= 1000.0
        if value < 999.5:
            return f'{value:.3g} {unit}'
    return f'{value:.0f} GB'
