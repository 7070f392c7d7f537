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
"""``t3mpc``: the command-line program; each subcommand has a module of its name."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from datetime import datetime
from importlib import import_module
import os
from pathlib import Path
import sys
from typing import Any
import webbrowser

from t3mpc_ros.cli import (
    compare,
    faults,
    paper,
    patrol,
    sweep,
    topic_param_call,
    train,
    tune,
    view,
)
from t3mpc_ros.cli.shared_options import (
    ArgumentParser,
    add_json,
    add_seeds,
    new_folder,
    print_result,
    reject_removed,
    run_command,
)
from t3mpc_ros.missing_library import remedy
from t3mpc_ros.parameters.command_line import bounded_float

SECONDS = bounded_float(1.0, 86_400.0, 'seconds')

UNSOUND, TOO_SLOW = 3, 4
"""Exit codes of a demo that was recorded but is no valid measurement."""
DEMO_EXIT_CODES = """\
Exit code: 0 sound; 1 failed; 2 wrong use; 128 + N ended by signal N; the run is recorded, but no
valid measurement: 3 the robot did not follow, or data is missing; 4 the machine was too slow,
which may be why: repeat it."""
"""The last words of the help of the demo."""

PROGRAMS = {
    'bag': 'inspect, report, animate, recover, replay, compare bags, and train from them',
    'robot': 'settings, key, log, link test, channel scan, wheel jog of the real robot',
    'emulator': 'emulated dongle and robot board behind a serial port',
}
"""Subcommands with their own parser, in the module of the same name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Return the exit code: 0 done, 1 failed with a reason, 2 wrong command line."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _run(words)
    except ModuleNotFoundError as error:
        if not (problem := remedy(error)):
            raise
        print(f'error: {problem}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('stopped', file=sys.stderr)
        return 130


def _run(words: Sequence[str]) -> int:
    if words and words[0] in PROGRAMS:
        # Imported only when it is used: `t3mpc --help` stays fast.
        code: int = _program(words[0]).main(words[1:])
        return code
    parser = _parser()
    reject_removed(parser, ' '.join(['t3mpc', *words[:1]]))
    return run_command(parser, words)


def _demo(options: argparse.Namespace) -> int:
    from t3mpc_ros.cli.demo import DemoInterruptedError, DemoOptions, parse_settings, run_demo

    if options.patrol and options.robot != 'twin':
        print(f'error: --patrol needs --robot twin: got {options.robot}', file=sys.stderr)
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


def _estimation(options: argparse.Namespace) -> None:
    from t3mpc_ros.evaluation.open_loop_estimation import compare, records
    from t3mpc_ros.evaluation.paper.paper_tables import estimation

    results = compare(
        seeds=options.seeds, duration=options.duration, normalised_gain=options.gain, progress=True
    )
    print_result(
        options,
        lambda: '\n\n'.join(table.markdown() for table in estimation(results)),
        lambda: records(results),
    )


def _exponents(options: argparse.Namespace) -> None:
    from t3mpc_ros.chaos.system import hyperchaotic_system
    from t3mpc_ros.evaluation.lyapunov_exponents import lyapunov_exponents

    values = lyapunov_exponents(hyperchaotic_system(orders=(1.0,) * 4), duration=options.duration)
    text = ', '.join(f'{value:.3f}' for value in values)
    print_result(
        options,
        lambda: (
            f'Lyapunov exponents of (85) at q = 1: {text}\n'
            f'their sum: {sum(values):.3f} (trace of the Jacobian: -38)'
        ),
        lambda: {'exponents': [*values], 'sum': sum(values), 'duration': options.duration},
    )


def _compile(options: argparse.Namespace) -> None:
    """Compile the kernels in two processes, each with about half of the work; or remove them."""
    if options.remove:
        from t3mpc_ros.kernels import remove_compiled

        for folder in remove_compiled(os.environ):
            print(f'removed {folder}')
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(2, get_context('spawn')) as pool:
        for part in [pool.submit(_compile_controllers), pool.submit(_compile_robots)]:
            part.result()


def _compile_robots() -> None:
    """Compile parts of a controller before it needs them, robots and reference."""
    import numpy as np

    from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
    from t3mpc_ros.control.body_correction import BodyCorrection, BodyCorrectionParameters
    from t3mpc_ros.control.controller import StepperControllerParameters
    from t3mpc_ros.control.dead_time_estimator import DeadTimeEstimator
    from t3mpc_ros.control.input_shaper import InputShaper
    from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters
    from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters, SpeedKalmanFilter
    from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
    from t3mpc_ros.geometry.kinematics import WheelGeometry
    from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters, make_robot

    zero, controller = np.zeros(2), StepperControllerParameters()
    FuzzyEstimator(controller.fuzzy, controller.adaptation, outputs=2).warm_up()
    SpeedKalmanFilter(controller.speed_filter, 'velocity', 0.01).update(
        zero, zero, 0.01, sent=True
    )
    InputShaper(controller.command_shaper, 0.01).step(zero, 0.01)
    DeadTimeEstimator(SpeedFilterParameters(), 0.01).step(zero, zero, 0.01)
    BodyCorrection(BodyCorrectionParameters(), 0.04, 0.1, 0.01).step(
        0.0, 0.01, zero, zero, zero, 0.0
    )
    JumpTransition(JumpTransitionParameters(), 0.1, 0.01).step(0, zero, zero)
    for kind in ('stepper', 'velocity'):
        make_robot(DigitalTwinParameters.from_dict({'drive.kind': kind})).warm_up()
    ChaoticReference(ReferenceParameters(), WheelGeometry()).advance()


def _compile_controllers() -> None:
    from t3mpc_ros.control.controller import Controller, StepperControllerParameters
    from t3mpc_ros.evaluation.cases import NOMINAL, PLANTS
    from t3mpc_ros.evaluation.drivers import MethodSpec
    from t3mpc_ros.evaluation.loop import run
    from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
    from t3mpc_ros.evaluation.scenario import Scenario

    Controller(StepperControllerParameters()).warm_up()
    for robot in PLANTS:
        spec = MethodSpec('full', ProposedController, ProposedParameters())
        run(Scenario(robot, NOMINAL, 1, 1.0), spec)


def _complete(options: argparse.Namespace) -> None:
    """Print what a shell reads to complete commands and options."""
    import shtab

    parser = _parser({name: _program(name).program_parser() for name in PROGRAMS})
    print(shtab.complete(parser, options.shell))


def _program(name: str) -> Any:
    return import_module(f't3mpc_ros.cli.{name}')


def _parser(
    programs: Mapping[str, argparse.ArgumentParser] | None = None,
) -> argparse.ArgumentParser:
    """Return the parser of the command line; ``programs`` are those of :data:`PROGRAMS`."""
    parser: argparse.ArgumentParser = ArgumentParser(
        prog='t3mpc',
        description='Tools of t3mpc_ros; topic, param, call, stop, view and demo use a ROS graph.',
    )
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')

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
    demo.add_argument('--seed', type=int, help='seed of reference and robot')
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
    demo.set_defaults(run=_demo)

    for name, text in PROGRAMS.items():
        commands.add_parser(name, help=text, add_help=False)
        if programs:
            commands.choices[name] = programs[name]

    estimation = commands.add_parser(
        'estimation', help='the kinds of fuzzy systems as estimators, without a controller (86)'
    )
    add_seeds(estimation, '1-5', 'the runs', counted=True)
    estimation.add_argument('--duration', type=SECONDS, default=60.0, help='seconds (default 60)')
    text = 'normalised gain of all kinds, 1/s² (default 40)'
    estimation.add_argument(
        '--gain', type=bounded_float(0.0, 1e6, '1/s²'), default=40.0, help=text
    )
    add_json(estimation)
    estimation.set_defaults(run=_estimation)

    exponents = commands.add_parser('exponents', help='Lyapunov exponents of the generator')
    exponents.add_argument(
        '--duration', type=SECONDS, default=200.0, help='system seconds (default 200)'
    )
    add_json(exponents)
    exponents.set_defaults(run=_exponents)

    for module in (paper, compare, sweep, patrol, tune, train, faults, view, topic_param_call):
        module.add_parser(commands)
    completing = commands.add_parser(
        'completion', help='print what bash or zsh completes: eval "$(t3mpc completion bash)"'
    )
    completing.add_argument('shell', choices=('bash', 'zsh'))
    completing.set_defaults(run=_complete)
    compiling = commands.add_parser('compile', help='compile every kernel into the cache')
    compiling.add_argument(
        '--remove',
        action='store_true',
        help='instead: remove what every version has compiled, from T3MPC_CACHE_DIR if it is set, '
        "else from the user's cache, which other installations share",
    )
    compiling.set_defaults(run=_compile)
    return parser


def _share(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f'must be from 0 to below 1: got {text}')
    return value


if __name__ == '__main__':
    sys.exit(main())
