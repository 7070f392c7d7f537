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
"""``t3mpc demo``: runs the nodes as processes, records them and writes the report."""

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from pathlib import Path
import signal
import sys
import time
from typing import TYPE_CHECKING
import webbrowser

from t3mpc_ros.cli.shared_options import SECONDS, Commands, new_folder
from t3mpc_ros.cli.view import PAGE_AT
from t3mpc_ros.nodes.registry import CALIBRATED_GYRO
from t3mpc_ros.parameters.command_line import bounded_int, parse_assignments
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.stop_signal import StopSignal

if TYPE_CHECKING:
    from t3mpc_ros.cli.process_group import PrivateGraph, ProcessGroup
    from t3mpc_ros.evaluation.bag_report.metrics import ReportMetrics

BOARD = 'emulator'
"""Not a node: it has no parameters and its own ready message."""
PAPER_NOISE = 0.04
"""Variance of the measured wheel speeds, (rad/s)², as in the paper's simulations."""
ROBOTS: Mapping[str, Mapping[str, Mapping[str, object]]] = {
    'twin': {'sim_robot': {'drive.kind': 'stepper'}, 'controller': CALIBRATED_GYRO},
    'servo': {
        'sim_robot': {'drive.kind': 'velocity'},
        'controller': {
            'composition': 'paper',
            'speed_filter.lag': 0.02,
            'mean_speeds': False,
            'friction.gamma': 10.0,
            'command_shaper.straight_frequency': 0.0,
            'command_shaper.turning_frequency': 0.0,
        },
    },
    'emulator': {
        'radio_bridge': {},
        # Fifty measurements a second; a command goes with the cycle after that of its sample,
        # 19 ms after the sample: test_radio_delay.py.
        'controller': {'rate': 50.0, 'speed_filter.dead_time': 0.02, **CALIBRATED_GYRO},
    },
}
"""Robots, and the parameters of each node for them: the digital twin, the paper's plant, and
the twin on an emulated board behind a serial port and a radio."""
VIEW = 'view'
FOLLOWS = 'tracking'
"""Log message of the controller when it follows the reference; discovery takes seconds."""
DISCOVERY_TIMEOUT = 60.0
"""Maximum time from the start of the last node to this message, s."""
END_TIMEOUT = 1.2
"""Time that the nodes, and then the recorder, have to end after a signal, s."""


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """Options of ``scripts/demo``."""

    duration: float = 60.0
    output: Path = Path('runs/demo')
    headless: bool = False
    seed: int | None = None
    robot: str = 'twin'
    """One of :data:`ROBOTS`."""
    loss: float = 0.0
    """Share of lost radio packets in each direction; for the emulator only."""
    view: bool = False
    """Whether the run is shown on a live page."""
    patrol: bool = False
    """Whether the robot patrols the world ``room``; without ``seed`` on a secret path."""
    settings: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """Further parameters by node, as of :func:`parse_settings`."""

    @property
    def robot_node(self) -> str:
        """Name of the robot node."""
        return 'radio_bridge' if self.robot == 'emulator' else 'sim_robot'

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes, in the order in which they are started."""
        return 'recorder', 'controller', self.robot_node, 'reference_generator'

    @property
    def port(self) -> Path:
        """Serial port of the emulated dongle."""
        return self.output.resolve() / 'dongle'

    def parameters(self) -> dict[str, dict[str, object]]:
        """Return the parameters of each node."""
        given: dict[str, dict[str, object]] = {
            name: dict(ROBOTS[self.robot].get(name, {})) for name in self.nodes
        }
        if self.robot == 'emulator':
            given['radio_bridge']['port'] = str(self.port)
        else:
            given['sim_robot']['noise.variance'] = PAPER_NOISE
        if self.patrol:
            given['controller'] |= {'pose.enabled': True, 'keep_out.enabled': True}
            # Without a seed it is a secret one from the operating system.
            given['reference_generator'] |= {
                'source': 'portrait',
                'seed': 0,
                'plan.enabled': True,
                'motion.linear.x.max_velocity': 0.33,
                'motion.wheel.max_velocity': 10.0,
            }
            given['sim_robot']['world'] = 'room'
        if self.seed is not None:
            given['reference_generator']['seed'] = self.seed
            if self.robot != 'emulator':
                given['sim_robot']['seed'] = self.seed
        for name, values in self.settings.items():
            given[name] |= values
        return given

    def board(self) -> tuple[str, ...]:
        """Return the command line of the emulated board; empty without one."""
        if self.robot != 'emulator':
            return ()
        words = ['--link', str(self.port), '--loss', str(self.loss)]
        return tuple(words if self.seed is None else [*words, '--seed', str(self.seed)])


def parse_settings(
    options: DemoOptions, texts: Iterable[str]
) -> Mapping[str, Mapping[str, object]]:
    """Return parameters by node and name from texts like ``controller.law.gain=90``."""
    from t3mpc_ros.nodes.registry import parameter_class  # takes a second

    assignments: dict[str, list[str]] = {}
    for text in texts:
        name, _, assignment = text.partition('.')
        if name not in options.nodes:
            raise ParameterError(
                f'--set must begin with one of {", ".join(options.nodes)} and a dot: got {text!r}'
            )
        assignments.setdefault(name, []).append(assignment)
    found: dict[str, Mapping[str, object]] = {}
    for name, each in assignments.items():
        table = parameter_class(name)
        found[name] = parse_assignments(table, each)
        table.from_dict({**options.parameters()[name], **found[name]})
    return found


class DemoInterruptedError(RuntimeError):
    """Signal ``number`` has ended the demo; the text says what ``bag`` holds, if it exists."""

    def __init__(self, number: int, bag: Path) -> None:
        self.number = number
        text = 'stopped before anything was recorded'
        if any(bag.glob('*.mcap')):
            text = (
                f'stopped; the recording so far is {bag}\n'
                f'its report: scripts/run t3mpc bag report {bag}\n'
                f'if a file of it is unfinished: scripts/run t3mpc bag recover {bag}'
            )
        super().__init__(text)


def run_demo(options: DemoOptions) -> 'ReportMetrics':
    """Run reference generator, controller, robot and recorder; return the report metrics.

    The bag is in ``output/bag``, the nodes' logs in ``output/log``, the report beside them.
    Whatever ends the run (a ProcessError, or a signal with DemoInterruptedError), all nodes are
    stopped.
    """
    from t3mpc_ros.cli.process_group import PrivateGraph, ProcessError, StopRequestedError

    options.output.mkdir(parents=True, exist_ok=True)
    bag = options.output / 'bag'
    if bag.exists() and any(bag.iterdir()):
        raise ProcessError(f'{bag} already holds a recording; choose another folder with --output')
    with StopSignal() as stop:
        try:
            with PrivateGraph() as graph:
                _show(f'  ROS_DOMAIN_ID {graph.domain}, on loopback')
                _run_nodes(options, graph, stop)
        except StopRequestedError:
            raise DemoInterruptedError(stop.number, bag) from None
    _show('  drawing the report from the bag')
    try:
        from t3mpc_ros.evaluation.bag_report.report_page import write_report  # takes seconds

        return write_report(bag, options.output)
    except KeyboardInterrupt:
        raise DemoInterruptedError(signal.SIGINT, bag) from None


def _run_nodes(options: DemoOptions, graph: 'PrivateGraph', stop: StopSignal) -> None:
    """Start the nodes, wait for the duration of the run, and stop them."""
    from t3mpc_ros.cli.process_group import ProcessError, ProcessGroup

    logs = options.output / 'log'
    processes = ProcessGroup(logs, graph.environment(), stop, lambda line: _show(f'    {line}'))
    parameters = options.parameters()
    parameters['recorder']['storage.uri'] = str((options.output / 'bag').resolve())
    # The nodes are stopped one after the other, which is no reason for a snapshot.
    parameters['recorder']['storage.snapshot_duration'] = 0.0
    # The robot stops after the nodes that command it, then the recorder, then the board.
    order = VIEW, 'reference_generator', 'controller', options.robot_node, 'recorder', BOARD
    try:
        if board := options.board():
            processes.start(BOARD, BOARD, *board, program='t3mpc')
            processes.wait_for(BOARD, 'stop with Ctrl-C', 120.0)
        for name in options.nodes:
            _show(f'  starting {name}')
            processes.start(name, parameters=parameters[name])
            processes.wait_ready(name)
        _show('  waiting for discovery')
        processes.wait_for('controller', FOLLOWS, DISCOVERY_TIMEOUT)
        if options.view:
            _open_view(processes, options)
        _watch(processes, options)
        codes = processes.stop_all(order)
    finally:
        # Nothing is left after a normal end.
        processes.end_all(('recorder', BOARD), END_TIMEOUT if stop() else 10.0)
    if wrong := {name: code for name, code in codes.items() if code}:
        raise ProcessError(
            'not every node ended cleanly: '
            + ', '.join(f'{name} with code {code}' for name, code in wrong.items())
            + f'; see {logs}'
        )


def _open_view(processes: 'ProcessGroup', options: DemoOptions) -> None:
    processes.start(VIEW, VIEW, '--headless', '--port', '0', program='t3mpc')
    processes.wait_for(VIEW, '(stop with', 60.0)
    text = processes.log(VIEW).read_text()
    url = text[text.rindex(PAGE_AT) :].removeprefix(PAGE_AT).split()[0]
    _show(f'  {PAGE_AT}{url}')
    if not options.headless:
        webbrowser.open(url)


def _show(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _watch(processes: 'ProcessGroup', options: DemoOptions) -> None:
    """Wait for the duration of the run; a terminal gets a bar, anything else some lines."""
    from t3mpc_ros.evaluation.result_output import progress_bar

    live = not options.headless and sys.stderr.isatty()
    start, next_line = time.monotonic(), 0.0
    with progress_bar(round(options.duration), 's', show=live) as bar:
        while (elapsed := time.monotonic() - start) < options.duration:
            processes.check()
            bar.update(int(elapsed) - bar.n)
            if not live and elapsed >= next_line:
                _show(f'  running: {elapsed:.0f} of {options.duration:.0f} s')
                next_line += max(10.0, options.duration / 6)
            time.sleep(min(0.2, options.duration - elapsed))
        bar.update(round(options.duration) - bar.n)


# -- command --------------------------------------------------------------------------------------


UNSOUND, TOO_SLOW = 3, 4
"""Exit codes of a demo that was recorded but is no valid measurement."""
DEMO_EXIT_CODES = """\
Exit code: 0 sound; 1 failed; 2 wrong use; 128 + N ended by signal N; the run is recorded, but no
valid measurement: 3 the robot did not follow, or data is missing; 4 the machine was too slow,
which may be why: repeat it."""
"""The last words of the help of the demo."""


def add_parser(commands: Commands) -> None:
    """Add the subcommand ``demo``."""
    demo = commands.add_parser(
        'demo',
        help='run all nodes as processes, record, report',
        epilog=DEMO_EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument('--duration', type=SECONDS, default=60.0, help='seconds (default 60)')
    demo.add_argument('--output', type=new_folder, help='folder (default runs/<time>)')
    demo.add_argument('--headless', action='store_true', help='no bar, no browser')
    demo.add_argument('--view', action='store_true', help='show the run on a live page')
    demo.add_argument('--seed', type=bounded_int(0, 10**15), help='seed of reference and robot')
    text = 'patrol the world room on a chaotic path; without --seed it is unpredictable'
    demo.add_argument('--patrol', action='store_true', help=text)
    text = (
        "twin: the stepper robot with all its parts (default); servo: the paper's plant; "
        'emulator: the twin on an emulated board, driven over a serial port and a radio'
    )
    demo.add_argument('--robot', choices=('twin', 'servo', 'emulator'), default='twin', help=text)
    text = 'share of radio packets lost each way, with --robot emulator (default 0)'
    demo.add_argument('--loss', type=_share, default=0.0, help=text)
    text = 'parameter of a node, such as controller.law.gain=90; may be given again'
    demo.add_argument('--set', action='append', default=[], metavar='NODE.NAME=VALUE', help=text)
    demo.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the demo, show its report and return the exit code."""
    if options.patrol and options.robot != 'twin':
        print(f'error: --patrol needs --robot twin: got {options.robot}', file=sys.stderr)
        return 2
    if options.loss and options.robot != 'emulator':
        print(f'error: --loss needs --robot emulator: got {options.robot}', file=sys.stderr)
        return 2
    names = {each.name for each in fields(DemoOptions)} - {'output'}
    wanted = DemoOptions(**{name: getattr(options, name) for name in names & {*vars(options)}})
    if options.set:
        wanted = replace(wanted, settings=parse_settings(wanted, options.set))
    wanted = replace(wanted, output=options.output or _new_run(Path('runs')))
    try:
        figures = run_demo(wanted)
    except DemoInterruptedError as interruption:
        print(interruption, file=sys.stderr)
        return 128 + interruption.number
    print(figures.verdict.text())
    print(figures.summary())
    if not options.headless:
        webbrowser.open(figures.report.resolve().as_uri())
    verdict = figures.verdict
    if verdict.sound:
        return 0
    # No lack of time damages a recording.
    return TOO_SLOW if verdict.slow and not verdict.damaged else UNSOUND


def _new_run(folder: Path) -> Path:
    """Return a new folder named after the time; the link ``latest`` beside it leads to it."""
    output = folder / f'{datetime.now():%Y%m%d-%H%M%S}'
    output.mkdir(parents=True)
    link, new_link = folder / 'latest', output / 'link'
    if link.is_symlink() or not link.exists():
        new_link.symlink_to(output.name)
        new_link.replace(link)  # at once, also for a second demo
    return output


def _share(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f'must be from 0 to below 1: got {text}')
    return value
