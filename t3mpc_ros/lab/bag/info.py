# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag info``: what a bag holds, on one screen."""

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
import json
from pathlib import Path

from t3mpc_ros.lab.bag.columns import columns, size_text
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.record.recovery.overview import Overview, overview

_SHORT = 6  # rows of a table that are written out; longer ones are only counted


def add_info_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    """Add ``info`` to the commands of ``bag``."""
    parser = commands.add_parser(
        'info',
        help='files, time, topics, settings of a bag',
        description='Says what a bag holds. Exit code 0, or 1 when nothing of it can be read.',
    )
    parser.add_argument('bag', type=Path, help='an MCAP file, or the folder of a bag')
    parser.add_argument('--json', action='store_true', help='everything, as JSON')
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    held = overview(options.bag)
    if options.json:
        rates = {topic.name: held.rate(topic) for topic in held.topics}
        print(json.dumps(asdict(held) | {'rates': rates}, indent=1, ensure_ascii=False))
    else:
        print(_page(held))
    return 0


def _page(held: Overview) -> str:
    size = size_text(sum(held.files.values()))
    rows = [
        ('bag', held.path),
        ('storage', f'{held.storage}, {size} in {len(held.files)} file(s)'),
        ('start', _date(held.start_ns) if held.message_count else 'no message'),
        ('duration', f'{held.duration_ns / NANOSECONDS:.3f} s'),
        ('messages', str(held.message_count)),
    ]
    rows += [(f'file {name}', size_text(size)) for name, size in held.files.items()]
    rows += [
        (f'UNFINISHED {name}', f'{size_text(size)}, not counted above')
        for name, size in held.unfinished.items()
    ]
    parts = [columns(rows)]
    if held.unfinished:
        parts.append(
            f'A file without its end is still being written, or its writer broke off: '
            f'`bag recover {held.path}` writes what is in it into a new bag.'
        )
    if held.topics:
        parts.append(_topics(held))
    for title, table in held.details.items():
        parts.append(_table(title, table))
    if held.attachments:
        items = [(item.name, item.media_type, size_text(item.size)) for item in held.attachments]
        parts.append('attachments\n' + columns(items, right=(2,)))
    return '\n\n'.join(parts)


def _topics(held: Overview) -> str:
    rows = [('topic', 'type', 'messages', 'Hz', 'quality of service')]
    for topic in held.topics:
        quality = '; '.join(topic.qualities) or '-'
        rate = f'{held.rate(topic):.2f}'
        rows.append((topic.name, topic.type_name, str(topic.message_count), rate, quality))
    return columns(rows, right=(2, 3))


def _table(title: str, table: Mapping[str, str]) -> str:
    if len(table) > _SHORT:
        return f'{title}: {len(table)} entries (--json shows them)'
    return f'{title}\n' + columns([(f'  {key}', value) for key, value in table.items()])


def _date(time_ns: int) -> str:
    return f'{datetime.fromtimestamp(time_ns // NANOSECONDS, UTC):%Y-%m-%d %H:%M:%S} UTC'
