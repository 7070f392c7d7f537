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
"""``t3mpc bag``: info, recover, report, animate, replay, compare and train."""

import argparse
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
import math
from pathlib import Path
import sys
import time
from typing import TYPE_CHECKING, Any

from t3mpc_ros.cli.shared_options import (
    ArgumentParser,
    Commands,
    RemovedOption,
    add_json,
    add_topic_options,
    new_folder,
    print_result,
    report_options,
    run_command,
)
from t3mpc_ros.cli.train import add_bag_options, run_bags
from t3mpc_ros.parameters.command_line import bounded_float, bounded_int, parse_assignments

if TYPE_CHECKING:  # help and completion do without the libraries for bags, which load slowly
    from t3mpc_ros.bag.reader import BagReader
    from t3mpc_ros.bag.recovery import Damage, FileResult, RecoveryResult
    from t3mpc_ros.evaluation.process_replay.controller_inputs import ControllerInputs
    from t3mpc_ros.evaluation.process_replay.replay_comparison import Tolerances


def columns(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Return the rows as aligned columns; those numbered in ``right`` are right-aligned."""
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
    """Return a number of bytes in a suitable unit."""
    if count < 1000:
        return f'{count} B'
    value = float(count)
    for unit in ('kB', 'MB', 'GB'):
        value /= 1000.0
        if value < 999.5:
            return f'{value:.3g} {unit}'
    return f'{value:.0f} GB'


_MAX_LISTED_ENTRIES = 6  # longer tables are only counted
_CALIBRATED = ('calibration.', 'odometry.gyro_scale', 'wheel_radius', 'wheel_separation')


def _add_info(commands: Commands) -> None:
    parser = commands.add_parser(
        'info',
        help='files, time, topics, parameters of a bag',
        description='Prints the contents of a bag. Exit code 0, or 1 when nothing can be read.',
    )
    parser.add_argument('bag', type=Path, help='an MCAP file, or the folder of a bag')
    # Without FILE, as when this was a flag: the standard output.
    add_json(parser, 'write everything', nargs='?', const=Path('-'))
    parser.set_defaults(run=_run_info)


def _run_info(options: argparse.Namespace) -> None:
    from t3mpc_ros.bag.reader import open_bag

    with open_bag(options.bag) as bag:
        print_result(options, lambda: _info_text(bag), lambda: _info(bag))


def _info(bag: 'BagReader') -> dict[str, Any]:
    """Return the contents of a bag as JSON data."""
    from t3mpc_ros.bag.mcap_file import McapFile

    return {
        'path': str(bag.folder),
        'storage': bag.storage,
        'files': {file.path.name: _size(file.path) for file in bag.files},
        'incomplete_files': {name: _size(bag.folder / name) for name in bag.incomplete_files},
        'message_count': bag.message_count,
        'start_ns': bag.start_ns,
        'duration_ns': bag.end_ns - bag.start_ns,
        'topics': [
            {
                'name': topic.name,
                'type_name': topic.type_name,
                'message_count': topic.message_count,
                'qos_profiles': [
                    *dict.fromkeys(
                        f'{each.reliability}, {each.durability}, {each.history} {each.depth}'
                        for each in topic.offered_qos_profiles
                    )
                ],
            }
            for topic in bag.topics.values()
        ],
        'metadata_records': bag.metadata_records,
        'attachments': [
            {'file': file.path.name, 'name': name, 'media_type': media_type, 'size': size}
            for file in bag.files
            if isinstance(file, McapFile)
            for name, media_type, size in file.attachment_sizes()
        ],
        'rates': {  # mean, Hz; 0 for a bag without duration
            topic.name: topic.message_count / bag.duration if bag.duration > 0.0 else 0.0
            for topic in bag.topics.values()
        },
    }


def _info_text(bag: 'BagReader') -> str:
    from t3mpc_ros.bag.recording_metadata import message_loss_notes

    info = _info(bag)
    start = datetime.fromtimestamp(bag.start_ns // 10**9, UTC)
    size = size_text(sum(info['files'].values()))
    rows = [
        ('bag', info['path']),
        ('storage', f'{bag.storage}, {size} in {len(bag.files)} file(s)'),
        ('start', f'{start:%Y-%m-%d %H:%M:%S} UTC' if bag.message_count else 'no message'),
        ('duration', f'{bag.duration:.3f} s'),
        ('messages', str(bag.message_count)),
    ]
    rows += [(f'file {name}', size_text(size)) for name, size in info['files'].items()]
    rows += [
        (f'UNFINISHED {name}', f'{size_text(size)}, not counted above')
        for name, size in info['incomplete_files'].items()
    ]
    parts = [columns(rows)]
    if bag.incomplete_files:
        parts.append(
            f'A file without its end is still being written, or its writer was interrupted: '
            f'`t3mpc bag recover {bag.folder}` writes its messages to a new bag.'
        )
    if notes := message_loss_notes(bag.metadata_records):
        parts.append('\n'.join(notes))
    if bag.topics:
        topics = [('topic', 'type', 'messages', 'Hz', 'quality of service')]
        for topic in info['topics']:
            name, count = topic['name'], str(topic['message_count'])
            quality = '; '.join(topic['qos_profiles']) or '-'
            topics.append((name, topic['type_name'], count, f'{info["rates"][name]:.2f}', quality))
        parts.append(columns(topics, right=(2, 3)))
    parts += [_info_table(title, table) for title, table in bag.metadata_records.items()]
    parts += _calibrations(bag.metadata_records)
    if info['attachments']:
        items = [(e['name'], e['media_type'], size_text(e['size'])) for e in info['attachments']]
        parts.append('attachments\n' + columns(items, right=(2,)))
    return '\n\n'.join(parts)


def _size(path: Path) -> int:
    """Return the size of a file, or of the files in a folder, in bytes."""
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files)


def _info_table(title: str, table: Mapping[str, str]) -> str:
    if len(table) > _MAX_LISTED_ENTRIES:
        return f'{title}: {len(table)} entries (--json shows them)'
    return f'{title}\n' + columns([(f'  {key}', value) for key, value in table.items()])


def _calibrations(records: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return the values and uncertainties of each calibrated robot."""
    return [
        f'calibration of {node}\n'
        + columns([(f'  {name}', table[name]) for name in table if name.startswith(_CALIBRATED)])
        for node, table in records.items()
        if table.get('calibration.date', '')
    ]


EXIT_LOSS = 3
"""Exit code: a bag was written, but messages were lost or may have been."""

EXIT_USAGE = 2
"""Exit code: the output folder cannot be written."""

_MAX_LISTED_DAMAGES = 20  # further damaged spans are only counted


def _add_recover(commands: Commands) -> None:
    parser = commands.add_parser(
        'recover',
        help='write what a damaged bag still holds into a new one',
        description='Writes what an MCAP file, or every MCAP file of a folder, still holds into '
        'a new folder, with index and metadata.yaml, and reports what was kept and lost. The '
        'input is only read. Exit code 0: nothing was lost; 3: something was, or a file has no '
        'end, so that its writer may have written more; 1: nothing can be read, or the output '
        'cannot be written; 2: the output is no new or empty folder, or in the input.',
    )
    parser.add_argument('bag', type=Path, metavar='FILE', help='an MCAP file, or a folder of such')
    parser.add_argument(
        '--output',
        type=new_folder,
        help='new or empty folder (default: FILE_recovered beside FILE)',
    )
    add_json(parser, 'write what was kept and lost')
    parser.set_defaults(run=_run_recover)


def _run_recover(options: argparse.Namespace) -> int:
    from t3mpc_ros.bag.recovery import RecoveryOutputError, default_output, recover_bag

    output = options.output or default_output(options.bag)
    progress = _RecoveryProgress()
    try:
        result = recover_bag(options.bag, output, progress)
    except RecoveryOutputError as error:
        print(f'error: {error}', file=sys.stderr)
        return EXIT_USAGE
    finally:
        progress.close()
    print_result(options, lambda: _recovery_text(result), lambda: _recovered(result))
    return 0 if result.clean else EXIT_LOSS


def _recovered(result: 'RecoveryResult') -> dict[str, Any]:
    """Return what was kept and lost as JSON data; counts that are not exact are lower bounds."""
    return {
        'output': str(result.output),
        'clean': result.clean,
        'exact': result.exact,
        'kept': result.kept,
        'lost': result.lost,
        'lost_seconds': result.lost_seconds,
        'lost_bytes': result.lost_bytes,
        'topics': {
            topic.name: {'kept': topic.kept, 'unchecked': topic.unchecked, 'lost': topic.lost}
            for topic in result.topics.values()
        },
        'files': {file.name: _file(file) for file in result.files},
    }


def _recovery_text(result: 'RecoveryResult') -> str:
    least = '' if result.exact else '>= '
    rows = [('topic', 'type', 'kept', 'unchecked', 'lost')]
    for topic in result.topics.values():
        lost = f'{least}{topic.lost}' if topic.lost else ('0' if result.exact else '?')
        rows.append((topic.name, topic.type_name, str(topic.kept), str(topic.unchecked), lost))
    parts = [columns(rows, right=(2, 3, 4))]
    parts += [_file(file) for file in result.files]
    if any(topic.unchecked for topic in result.topics.values()):
        parts.append('unchecked: no checksum of the file covers these messages')
    parts.append(_verdict(result, least))
    return '\n\n'.join(parts)


def _file(file: 'FileResult') -> str:
    if file.copied:
        return f'{file.name}: sound, copied'
    lines = [f'{file.name}: written anew']
    lines += [f'  {note}' for note in file.notes]
    lines += [f'  {_damage(damage)}' for damage in file.damages[:_MAX_LISTED_DAMAGES]]
    if len(file.damages) > _MAX_LISTED_DAMAGES:
        lines.append(f'  and {len(file.damages) - _MAX_LISTED_DAMAGES} more')
    return '\n'.join(lines)


def _damage(damage: 'Damage') -> str:
    where = f'bytes {damage.start} to {damage.end}: ' if damage.size else ''
    text = where + damage.reason
    if damage.harmless:
        return f'{text} (nothing is lost with it)'
    if damage.messages:
        text += f'; {damage.messages} messages lost'
    if damage.span_ns:
        from t3mpc_ros.geometry.types import NANOSECONDS

        text += f'; within {(damage.span_ns[1] - damage.span_ns[0]) / NANOSECONDS:.3f} s'
    return text


def _verdict(result: 'RecoveryResult', least: str) -> str:
    kept = f'{result.kept} messages are kept in {result.output}'
    if result.clean:
        return f'{kept}; nothing is lost'
    seconds = result.lost_seconds
    during = '' if seconds is None else f', within {seconds:.3f} s'
    number = f'{least}{result.lost}' if result.lost or result.exact else 'an unknown number of'
    return (
        f'{kept}; lost: {number} messages{during}, '
        f'{size_text(result.lost_bytes)} of the input not usable'
    )


class _RecoveryProgress:
    """A progress bar for each file that takes longer than a second."""

    def __init__(self) -> None:
        self._name = ''
        self._bar: Any = None

    def __call__(self, name: str, done: int, size: int) -> None:
        from t3mpc_ros.evaluation.result_output import progress_bar

        if self._bar is None or name != self._name or done < self._bar.n:
            self.close()
            self._name, self._bar = name, progress_bar(size, 'B', title=name, delay=1.0)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


def _add_report(commands: Commands) -> None:
    parser = commands.add_parser(
        'report',
        help='draw the report of a bag, or compare several',
        description='Writes report.html, one file with verdict, charts and tables. The bag may be '
        'of any robot: MCAP or sqlite3, with a topic of odometry (nav_msgs/Odometry), of commands '
        '(geometry_msgs/Twist or TwistStamped), or both; they are found by name, else by type. '
        'Several bags are compared with the first in comparison.html. Exit code 0: written, '
        'whatever the verdict; 1: nothing can be read.',
    )
    add = parser.add_argument
    add('bags', type=Path, nargs='+', metavar='BAG', help='folder of a bag, or its one file')
    add('--output', type=new_folder, help='folder for the report (default: beside it)')
    add_topic_options(parser)
    text = 'what the robot was to follow: odometry or a twist'
    add('--reference', default='', metavar='TOPIC', help=text)
    add_json(parser, 'write verdict and numbers')
    parser.set_defaults(run=_run_report)


def _run_report(options: argparse.Namespace) -> None:
    from t3mpc_ros.evaluation.bag_report.report_page import write_report

    wanted = report_options(options)
    output = options.output or options.bags[0].resolve().parent
    print('reading the bag', file=sys.stderr, flush=True)
    if len(options.bags) > 1:
        from t3mpc_ros.evaluation.bag_report.run_comparison import write_comparison

        path, text, record = write_comparison(options.bags, output, wanted)
        print_result(options, lambda: f'{text}\n{path}', lambda: record)
        return
    figures = write_report(options.bags[0], output, wanted)
    print_result(
        options, lambda: f'{figures.verdict.text()}\n{figures.summary()}', figures.to_dict
    )


def _add_animate(commands: Commands) -> None:
    parser = commands.add_parser(
        'animate',
        help='draw the animation of a bag as GIF',
        description='Draws the floor with the path of the robot, the reference, walls and range '
        'rays where they are known, and beside it the speeds against their references with the '
        'errors below. The bag may be of any robot with odometry.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='folder of the bag, or its one file')
    add('--output', type=Path, required=True, metavar='FILE', help='a .gif')
    for name, default, metavar, kind, text in (
        ('start', 0.0, 'S', bounded_float(0.0, 1e9, 's'), 'start, s (default 0)'),
        ('duration', math.inf, 'S', bounded_float(0.0, math.inf, 's'), 's (default: to the end)'),
        ('speed', 1.0, 'X', bounded_float(1e-3, 1e4), 'seconds of the run in a second of the '
         'animation (default 1)'),
        ('rate', 10.0, 'HZ', bounded_float(0.1, 50.0, 'Hz'), 'frames per second (default 10)'),
        ('width', 760, 'PIXELS', bounded_int(200, 4000), 'of the picture (default 760)'),
    ):  # fmt: skip
        add(f'--{name}', type=kind, default=default, metavar=metavar, help=text)
    add('--namespace', help='of the robot, where the bag holds several')
    parser.set_defaults(run=_run_animate)


def _run_animate(options: argparse.Namespace) -> None:
    from t3mpc_ros.evaluation.bag_report.animation_file import AnimationOptions, animate_bag
    from t3mpc_ros.evaluation.topic_roles import ReportOptions

    chosen = AnimationOptions(
        options.start, options.duration, options.speed, options.rate, options.width
    )
    wanted = ReportOptions(namespace=options.namespace)
    written = animate_bag(options.bag, options.output, chosen, wanted, progress=True)
    print(f'{written}: {size_text(written.stat().st_size)}')


def _add_replay(commands: Commands) -> None:
    parser = commands.add_parser(
        'replay',
        help='compute a recorded run again',
        description='Feeds the recorded odometry and reference to the current controller, '
        'offline and without waiting, in the order in which the recorded controller processed '
        'them. With other parameters it computes what would have been commanded; the recorded '
        'robot does not respond to that.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='folder of the bag, or its file')
    add('--output', type=new_folder, metavar='DIR', help='write a bag of what was computed')
    add('--method', action=RemovedOption, nargs='?', help=argparse.SUPPRESS)
    add_input_options(parser)
    add_json(parser, 'write speed and comparison')
    parser.set_defaults(run=_run_replay)


def add_input_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the controller inputs of a bag."""
    add = parser.add_argument
    text = 'another setting than the recorded one, law.gain=90 say; may be given again'
    add('--set', dest='parameters', action='append', default=[], metavar='NAME=VALUE', help=text)
    add(
        '--model', type=Path, metavar='FILE', help='model file to begin with (default: as the bag)'
    )
    add('--namespace', help='of the robot, where the bag holds several')


def _changed_inputs(options: argparse.Namespace) -> tuple['ControllerInputs', dict[str, object]]:
    """Return the inputs of the recorded controller, and the parameters that are to change."""
    from t3mpc_ros.control.controller import ControllerParameters
    from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
    from t3mpc_ros.model_file import load_model

    changes = parse_assignments(ControllerParameters, options.parameters)
    model = load_model(options.model) if options.model else None
    return load_inputs(options.bag, options.namespace, model), changes


def _run_replay(options: argparse.Namespace) -> None:
    from t3mpc_ros.evaluation.process_replay import controller_replay
    from t3mpc_ros.evaluation.process_replay.replay_comparison import compare

    begin = time.perf_counter()
    inputs, changes = _changed_inputs(options)
    read = time.perf_counter()
    controllers = controller_replay.make_controllers(inputs, changes)
    ready = time.perf_counter()
    again = controller_replay.replay_controller(inputs, changes, controllers)
    end = time.perf_counter()
    reading, starting, running = read - begin, ready - read, end - ready
    span = again.steps / again.parameters.rate
    whole, alone = span / (reading + running), span / running
    outcome = compare(inputs, again)
    text = (
        f'{again.steps} steps, {span:.1f} s of control, in {reading + running:.2f} s: '
        f'{whole:.0f} x real time, {alone:.0f} x without reading; '
        f'{starting:.2f} s to compile and to warm up are not counted\n{outcome.table()}'
    )
    if changes or options.model:
        text += f'\n{controller_replay.OPEN_LOOP}'
    record: dict[str, Any] = {
        'steps': again.steps,
        'seconds': span,
        'reading': round(reading, 3),
        'running': round(running, 3),
        'output': None,
        **outcome.to_dict(),
    }
    if options.output:
        from t3mpc_ros.evaluation.process_replay.controller_replay import write_replay

        record['output'] = str(write_replay(inputs, again, options.output))
        text += f'\nwritten to {record["output"]}'
    print_result(options, lambda: text, lambda: record)


SAME, DIFFERS = 0, 3
"""Exit codes; an error is 1, as for every command."""


def _add_compare(commands: Commands) -> None:
    parser = commands.add_parser(
        'compare',
        help='compare a recorded run with its replay, or with another bag',
        description='With one bag: it is computed again, see bag replay, and each field compared. '
        'With two: what they hold of one run. Exit code 0: all within the tolerances; 3: '
        'something differs; 1: it cannot be compared.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='folder of the bag, or its file')
    add('other', type=Path, nargs='?', metavar='OTHER', help='another bag')
    text = (
        'absolute tolerance, SI units (default 1e-9; elsewhere than where it was recorded '
        'take 1e-6)'
    )
    add('--abs', type=float, metavar='TOL', help=text)
    add('--rel', type=float, metavar='TOL', help='share of the recorded number (default 1e-9)')
    text = 'absolute tolerance of one field, or of several by a name with *; may be given again'
    add('--field', dest='fields', action='append', default=[], metavar='F=TOL', help=text)
    add('--picture', type=Path, metavar='FILE', help='draw the first divergence as PNG')
    add('--update-golden', action=RemovedOption, nargs='?', help=argparse.SUPPRESS)
    add_input_options(parser)
    add_json(parser, 'write the comparison')
    parser.set_defaults(run=_run_compare)


def _run_compare(options: argparse.Namespace) -> int:
    """Print the comparison; return 0 when all is within the tolerances, 3 otherwise."""
    from t3mpc_ros.evaluation.process_replay import (
        controller_inputs,
        controller_replay,
        replay_comparison,
    )

    tolerances = _tolerances(options)
    inputs, changes = _changed_inputs(options)
    changed = changes or options.model
    if options.other is not None:
        if changed:
            raise ValueError('--set and --model are for a replay: give one bag only')
        other = controller_inputs.load_inputs(options.other, options.namespace)
        outcome = replay_comparison.compare_bags(inputs, other, tolerances)
    else:
        again = controller_replay.replay_controller(inputs, changes)
        outcome = replay_comparison.compare(inputs, again, tolerances)
    text = outcome.table() + (f'\n{controller_replay.OPEN_LOOP}' if changed else '')
    print_result(options, lambda: text, outcome.to_dict)
    if options.picture:
        replay_comparison.write_divergence_figure(outcome, options.picture)
        print(f'drawn to {options.picture}', file=sys.stderr)
    return SAME if outcome.same else DIFFERS


def _tolerances(options: argparse.Namespace) -> 'Tolerances':
    """Return the tolerances given on the command line."""
    from t3mpc_ros.evaluation.process_replay.replay_comparison import Tolerances

    own = {}
    for text in options.fields:
        name, _, value = text.rpartition('=')
        try:
            own[name] = float(value)
        except ValueError:
            raise ValueError(f'--field must be FIELD=NUMBER: got {text!r}') from None
    given = {'absolute': options.abs, 'relative': options.rel}
    chosen = {name: value for name, value in given.items() if value is not None}
    return Tolerances(**chosen, fields=own)


def _add_train(commands: Commands) -> None:
    parser = commands.add_parser(
        'train',
        help='learn a model file that the controller starts from',
        description='Learns the weights of the predictor and the first fuzzy coefficients from '
        "one or more bags that were recorded with this package's controller, and reports their "
        'cross-validated skill on held-out runs. The controller loads the file by its parameter '
        'model. While the bags are recorded, '
        "the controller's predictive.dither should be a few rad/s².",
    )
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='folder of a bag')
    add_bag_options(parser)
    parser.set_defaults(run=run_bags)


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code: 0 done, 1 failed with a reason, 2 wrong command line.

    3: done, but the bag is damaged or differs; see each command.
    """
    return run_command(program_parser(), arguments)


def program_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser: argparse.ArgumentParser = ArgumentParser(
        prog='t3mpc bag', description='Bags without a ROS graph.'
    )
    commands = parser.add_subparsers(dest='command', required=True)
    _add_info(commands)
    _add_recover(commands)
    _add_report(commands)
    _add_animate(commands)
    _add_replay(commands)
    _add_compare(commands)
    _add_train(commands)
    return parser


if __name__ == '__main__':
    sys.exit(main())
