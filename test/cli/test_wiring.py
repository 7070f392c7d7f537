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
"""Every option of every command changes what it names.

What a command calls is replaced by functions that record their arguments. A row holds the words
of an option and the recorded values that differ from those of the command without them.
"""

from argparse import ArgumentTypeError, Namespace
from contextlib import nullcontext
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
import re
import shlex
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock
import webbrowser

import numpy as np
import pytest
from support.parsers import commands, options

from t3mpc_ros.bag.recovery import RecoveryResult
from t3mpc_ros.cli.main import main
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.nodes.registry import NODES, parameter_class
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import key_check
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, StoredSettings, settings_file
from t3mpc_ros.robot.calibration import Calibration

pytestmark = pytest.mark.slow

KEY = bytes(range(1, 17))
OTHER_ROBOT = RobotSettings(channel=7)


def flat(path, value):
    """Return the plain values in what a function was given, by their path."""
    if value is None or isinstance(value, str | bool | int | float | bytes):
        return {path: value}
    if isinstance(value, Path):
        return {path: str(value)}
    if isinstance(value, np.ndarray):
        return {path: tuple(value.tolist())}
    if is_dataclass(value) and not isinstance(value, type):
        items = {each.name: getattr(value, each.name) for each in fields(value)}
    elif isinstance(value, tuple) and hasattr(value, '_asdict'):
        items = value._asdict()
    elif isinstance(value, dict | Namespace):
        items = value if isinstance(value, dict) else vars(value)
    elif isinstance(value, list | tuple | range):
        items = dict(enumerate(value))
        if all(isinstance(each, str | int | float) for each in value):
            return {path: tuple(value)}
    else:
        return {path: 'callable'} if callable(value) else {}
    names = {path: tuple(value)} if isinstance(value, dict) else {}
    return names | {
        name: found
        for key, item in items.items()
        for name, found in flat(f'{path}.{key}', item).items()
    }


class Recorder:
    """Replaces what a command calls."""

    def __init__(self, monkeypatch):
        self._patch = monkeypatch
        self.found = {}

    def replace(self, target, result):
        """Replace a function; ``result`` is what it returns, or makes that of its arguments."""
        module, _, name = target.rpartition('.')
        parameters = signature(getattr(import_module(f't3mpc_ros.{module}'), name))

        def instead(*arguments, **named):
            given = parameters.bind(*arguments, **named)
            given.apply_defaults()
            for each, value in given.arguments.items():
                self.found |= flat(f'{name}.{each}', value)
            return result(**given.arguments) if callable(result) else result

        instead.__signature__ = parameters
        self._patch.setattr(f't3mpc_ros.{target}', instead)


def text(**_):
    return 'text'


def context(value):
    return lambda **_: nullcontext(value)


SHARED = {'evaluation.api.parameter_sweep.cluster': context(5)}
CSV = 'time,right,left\n' + ''.join(f'{k},1.0,2.0\n' for k in range(100))
OWN_RATE = tuple([0.0, 0.0] for _ in range(6100))
"""Slope of that reference over a run and a second."""
FILES = {
    'speeds.csv': CSV,
    'mine.py': 'import numpy as np\ndef step(observation):\n    return np.zeros(2)\n',
    'key': KEY.hex() + '\n',
    'robot.yaml': settings_file(OTHER_ROBOT),
    'bag/x.mcap': '',
    'page.md': '',
}
"""Made in the working folder of every command."""

WORKERS = {'--workers 3': 3, '--scheduler tcp://h:1': 5}


def workers(path):
    """Return the rows of who computes."""
    rows = {words: {path: value} for words, value in WORKERS.items()}
    rows['--scheduler tcp://h:1']['cluster.address'] = 'tcp://h:1'
    return rows


def topics(path):
    """Return the rows of the topics of a bag."""
    return {
        '--namespace r1': {f'{path}.namespace': 'r1'},
        '--odom o': {f'{path}.odom': 'o'},
        '--cmd-vel c': {f'{path}.cmd_vel': 'c'},
        '--wheel-radius 0.1 --track 0.2': {f'{path}.wheel_radius': 0.1, f'{path}.track': 0.2},
    }


JSON = {'--json new.json': {'files': 'new.json'}}
PAPER = 'evaluation.paper.reproduce.reproduce'
COMPARE = {
    'evaluation.comparison.run_plan': {},
    'evaluation.comparison.step_times': {},
    'evaluation.comparison.markdown': '',
    'evaluation.comparison.record': {},
    'evaluation.comparison.page': '',
    'evaluation.method_table.require_libraries': None,
}
PATROL = {
    f'evaluation.patrol.{name}_comparison.{function}': result
    for name in ('patrol', 'path_tracker')
    for function, result in (('markdown', ''), ('record', {}), ('page', ''))
} | {
    'evaluation.figure_style.write_pictures': {},
    'evaluation.patrol.patrol_comparison.compare_patrols': SimpleNamespace(
        table=SimpleNamespace(keys=())
    ),
    'evaluation.patrol.path_tracker_comparison.compare_trackers': SimpleNamespace(
        table=SimpleNamespace(keys=())
    ),
    'evaluation.patrol.path_tracker_comparison.tune_trackers': {},
    'evaluation.patrol.safety_study.compare_safety': SimpleNamespace(rows=[]),
    'evaluation.patrol.safety_study.safety_table': SimpleNamespace(markdown=str),
    'evaluation.patrol.path_tracker_comparison.tuning_markdown': '',
    'evaluation.patrol.localization_study.compare_localizations': SimpleNamespace(rows=[]),
    'evaluation.patrol.localization_study.markdown': '',
}
TUNE = {
    'evaluation.method_table.require_libraries': None,
    'evaluation.tuning.tune_methods.tune_methods': SimpleNamespace(table=text, to_dict=dict),
    'evaluation.tuning.tune_methods.tune_twin': SimpleNamespace(table=text, to_dict=dict),
    'evaluation.tuning.drive_identification.identify_bag': ('drive', 'paper'),
    'evaluation.tuning.drive_identification.drive_file': 'a: 1\n',
    'evaluation.tuning.drive_identification.drive_record': {},
}
MODEL = SimpleNamespace(
    text='', learnt={}, parameters=SimpleNamespace(to_dict=dict), origin={}, to_dict=dict
)
TRAIN = {
    'evaluation.training.train_models.fit_simulated_runs': ({}, MODEL),
    'evaluation.training.train_models.assess': '',
    'evaluation.training.train_models.fit_bags': MODEL,
    'model_file.save_model': None,
}
OF_BAGS = {
    'bag': {'fit_bags.folders.1': 'bag'},
    '--keep-predictor': {'fit_bags.keep_predictor': True},
    '--folds 3': {'fit_bags.count': 3},
    '--output new.npz': {'save_model.path': 'new.npz'},
}
FAULTS = {
    'evaluation.fault_outcomes.study_faults': [],
    'evaluation.fault_outcomes.console_text': '',
    'evaluation.fault_outcomes.update_page': None,
    'evaluation.fault_outcomes.page': '',
}
REPLAYED = SimpleNamespace(steps=100, parameters=SimpleNamespace(rate=100.0))
OUTCOME = SimpleNamespace(table=text, same=True, to_dict=dict)
REPLAY = {
    'model_file.load_model': {'w': np.ones(1)},
    'evaluation.process_replay.controller_inputs.load_inputs': 'inputs',
    'evaluation.process_replay.controller_replay.make_controllers': [],
    'evaluation.process_replay.controller_replay.replay_controller': REPLAYED,
    'evaluation.process_replay.replay_comparison.compare': OUTCOME,
    'evaluation.process_replay.replay_comparison.compare_bags': OUTCOME,
    'evaluation.process_replay.controller_replay.write_replay': 'there',
    'evaluation.process_replay.replay_comparison.write_divergence_figure': None,
}
REPORT = SimpleNamespace(verdict=SimpleNamespace(text=text), summary=text, to_dict=dict)
BAG = {
    'evaluation.bag_report.report_page.write_report': REPORT,
    'evaluation.bag_report.run_comparison.write_comparison': ('there', 'text', {}),
    'evaluation.bag_report.animation_file.animate_bag': Path('page.md'),
    'bag.recovery.recover_bag': lambda output, **_: RecoveryResult(output, ()),
}
VIEW = {
    'nodes.viewer.view_node': context(SimpleNamespace(spin=lambda stop: None, command=print)),
    'view.server.PageServer': context(SimpleNamespace(url='http://page')),
    'cli.bag_on_live_page.recorded_run': 'run',
    'cli.live_page_recording.RunRecorder': SimpleNamespace(close=lambda: None),
}
GRAPH = MagicMock()
GRAPH.topics.return_value = {'/odom': ['nav_msgs/msg/Odometry']}
GRAPH.messages.return_value = ['one', 'two']
GRAPH.nodes.return_value = ['/controller']
GRAPH.parameter_names.return_value = ['rate']
GRAPH.parameter_text.return_value = '1.0'
GRAPH.topic_text.return_value = 'of /odom'
GRAPH.parameter_description.return_value = 'a rate'
GRAPH.set_parameter.return_value = ''
GRAPH.stop_robots.return_value = {'/e_stop': ''}
SEEN = {
    'nodes.graph_client.graph': context(GRAPH),
    'nodes.graph_client.message_text': lambda message, field: f'{message} {field}\n',
}
BOARD = MagicMock()
EMULATOR = {
    'emulator.emulator.Emulator': lambda **_: BOARD,
    'emulator.pty_port.PtyPort': lambda **_: MagicMock(),
    'emulator.pty_port.serve': None,
}
STORED = StoredSettings(frames.SETTINGS_GOOD, RobotSettings())


def at_port(script, path, interrupted, board):
    return STORED if script is None else script


ROBOT = {
    'radio.tool.procedure.run_script': at_port,
    'radio.tool.procedure.run_at_port': None,
    'radio.tool.link_test.run_link_test': 'result',
    'radio.tool.link_test.evaluate': [],
    'radio.tool.link_test.format_report': '',
    'radio.tool.channel_scan.scan_channels': 'result',
    'radio.tool.channel_scan.recommend': (True, ''),
    'radio.tool.robot_info.read_robot_info': 'result',
    'radio.tool.robot_info.format_robot_info': '',
    'radio.tool.manoeuvre.Jog': SimpleNamespace(result=None, error=''),
    'radio.tool.key_provisioning.write_key': 'state',
    'radio.tool.key_provisioning.read_key_state': frames.KeyState(
        0, 0, frames.KEY_HELD, key_check(KEY)
    ),
    'radio.tool.key_provisioning.format_key_state': '',
    'radio.tool.robot_info.read_log': 'log',
    'radio.tool.robot_info.format_log': '',
    'radio.tool.robot_settings.read_settings': None,
    'radio.tool.robot_settings.write_settings': STORED,
    'cli.robot_calibrate.CalibrationWizard': lambda start, **_: SimpleNamespace(
        run=lambda: None, calibration=start
    ),
    'cli.robot_calibrate.read_parameter_file': (Calibration(), {}),
    'cli.robot_calibrate.CalibrationRobot': SimpleNamespace(
        stored=Calibration, settings=RobotSettings
    ),
    'cli.robot_doctor.run_doctor': [],
}


def link(path, *, key=True):
    """Return the rows of the options of the link."""
    rows = {
        '--set link.channel=9': {f'{path}.parameters.channel': 9},
        '--set robot.invert_left=true': {f'{path}.parameters.robot.invert_left': True},
        '--params-file robot.yaml': {f'{path}.parameters.channel': 7},
    }
    return rows | ({'--key key': {f'{path}.key': KEY}} if key else {})


TABLE = {
    'estimation': (
        {'evaluation.fuzzy_estimation_error.compare': ResultTable([])},
        {
            '--seeds 6-7': {'compare.seeds': (6, 7)},
            '--duration 9': {'compare.duration': 9.0},
            '--gain 3': {'compare.normalised_gain': 3.0},
            '--json new.json': {'files': 'new.json'},
        },
    ),
    'exponents': (
        {'evaluation.lyapunov_exponents.lyapunov_exponents': (2.0, 1.0, -1.5)},
        {
            '--duration 9': {'lyapunov_exponents.duration': 9.0},
            '--json new.json': {'files': 'new.json'},
        },
    ),
    'paper': (
        {PAPER: ('', {}), 'evaluation.method_table.require_libraries': None, **SHARED},
        {
            '': {'reproduce.output': 'runs/paper', 'reproduce.seeds': None},
            '--quick': {
                'reproduce.quick': True,
                'reproduce.output': 'runs/paper-quick',
            },
            '--seeds 104-105': {'reproduce.seeds': (104, 105)},
            '--estimation-seeds 5-6': {'reproduce.estimation_seeds': (5, 6)},
            '--output new': {'reproduce.output': 'new'},
            '--json new.json': {'files': 'new.json'},
            '--fresh': {'reproduce.fresh': True},
            **workers('reproduce.workers'),
        },
    ),
    'compare': (
        COMPARE | SHARED,
        {
            '--robot servo': {'run_plan.plan.scenario.robot': 'servo'},
            '--seeds 3-4': {'run_plan.plan.seeds': (3, 4)},
            '--duration 9': {'run_plan.plan.scenario.duration': 9.0},
            '--noise 0.01': {'run_plan.plan.scenario.noise': 0.01},
            '--cases nominal': {'run_plan.plan.cases': ('nominal',)},
            '--methods full DMC': {'run_plan.plan.methods': ('full', 'DMC')},
            '--gyro': {'run_plan.plan.scenario.gyro': True},
            '--json new.json': {'files': 'new.json'},
            '--html new.html': {'files': 'new.html'},
            '--csv new.csv': {'files': 'new.csv'},
            **workers('run_plan.workers'),
        },
    ),
    'compare --robot servo mine.py:step': (
        COMPARE | SHARED,
        {
            'ADRC': {'run_plan.plan.methods': ('full', 'step', 'ADRC')},
            '--robot torque': {'run_plan.plan.scenario.robot': 'torque'},
            '--seeds 3-4': {'run_plan.plan.seeds': (3, 4)},
            '--duration 9': {'run_plan.plan.scenario.duration': 9.0},
            '--noise 0.01': {'run_plan.plan.scenario.noise': 0.01},
            '--cases nominal disturbance': {'run_plan.plan.cases': ('nominal', 'disturbance')},
            '--methods DMC': {'run_plan.plan.methods': ('DMC', 'step')},
            '--html new.html': {'files': 'new.html'},
            '--reference speeds.csv': {'run_plan.plan.scenario.own.reference.rate': OWN_RATE},
        },
    ),
    'sweep': (
        {
            'evaluation.api.parameter_sweep.sweep': SimpleNamespace(table=str, rows=[]),
            **SHARED,
        },
        {
            'ADRC DMC': {'sweep.controllers': ('ADRC', 'DMC')},
            '--set gain=1,2 noise=0.1': {
                'sweep.parameters.gain': (1, 2),
                'sweep.parameters.noise': (0.1,),
            },
            '--robot servo': {'sweep.plant': 'servo'},
            '--reference speeds.csv': {'sweep.reference': 'speeds.csv'},
            '--noise 0.01': {'sweep.noise': 0.01},
            '--duration 9': {'sweep.duration': 9.0},
            '--seeds 3-4': {'sweep.seeds': (3, 4)},
            '--cases disturbance': {'sweep.cases': ('disturbance',)},
            '--output new.parquet': {'sweep.output': 'new.parquet'},
            '--metric "with switches"': {'text': 'overall\n0 runs: runs/sweep.parquet\n'},
            '--json new.json': {'files': 'new.json'},
            **workers('sweep.executor'),
        },
    ),
    'patrol': (
        PATROL | SHARED,
        {
            '--robot twin': {'compare_patrols.plan.robot': 'twin'},
            '--planned': {
                'compare_patrols.plan.planned': True,
                'compare_patrols.plan.robot': 'twin',
            },
            '--seeds 3-4': {'compare_patrols.plan.seeds': (3, 4)},
            '--minutes 2': {'compare_patrols.plan.duration': 120.0},
            '--arena -1 -2 3 4': {'compare_patrols.plan.arena': (-1.0, -2.0, 3.0, 4.0)},
            '--paths Lorenz': {'compare_patrols.plan.paths': ('Lorenz',)},
            '--json new.json': {'files': 'new.json'},
            '--output new': {'compare_patrols.store': 'new/patrol.runs.jsonl'},
            **workers('compare_patrols.workers'),
        },
    ),
    'patrol --tracking': (
        PATROL | SHARED,
        {
            '--seeds 3-4': {'compare_trackers.plan.seeds': (3, 4)},
            '--paths square': {'compare_trackers.plan.paths': ('square',)},
            '--output new': {'write_pictures.folder': 'new/figures'},
            **workers('compare_trackers.workers'),
        },
    ),
    'patrol --safety': (
        PATROL | SHARED,
        {
            '--seeds 3-4': {'compare_safety.seeds': (3, 4)},
            '--minutes 2': {'compare_safety.duration': 120.0},
            '--planned': {'compare_safety.planned': True},
            **workers('compare_safety.workers'),
        },
    ),
    'patrol --localization': (
        PATROL | SHARED,
        {
            '--seeds 3-4': {'compare_localizations.plan.seeds': (3, 4)},
            '--minutes 2': {'compare_localizations.plan.duration': 120.0},
            '--planned': {'compare_localizations.plan.planned': True},
            "--paths 'odometry alone'": {'compare_localizations.plan.cases': ('odometry alone',)},
            '--output new': {'compare_localizations.store': 'new/localization.runs.jsonl'},
            **workers('compare_localizations.workers'),
        },
    ),
    'patrol --tracking tune': (PATROL | SHARED, workers('tune_trackers.workers')),
    'tune': (
        TUNE | SHARED,
        {
            '': {
                'tune_methods.drives': ('torque', 'velocity'),
                'tune_methods.budget.evaluations': 120,
                'tune_methods.path': 'runs/tuned.json',
            },
            'DMC': {'tune_methods.methods.0.name': 'DMC'},
            '--robot servo': {'tune_methods.drives': ('velocity',)},
            '--evaluations 7': {'tune_methods.budget.evaluations': 7},
            '--json new.json': {'files': 'new.json'},
            '--output new.json': {'tune_methods.path': 'new.json'},
            '--resume': {'tune_methods.resume': True},
            **workers('tune_methods.workers'),
        },
    ),
    'tune --robot twin': (
        TUNE | SHARED,
        {
            '': {'tune_twin.evaluations': 30, 'tune_twin.path': 'runs/tuned.json'},
            'DMC': {'tune_twin.selected.0.name': 'DMC'},
            '--evaluations 7': {'tune_twin.evaluations': 7},
            '--output new.json': {'tune_twin.path': 'new.json'},
            '--resume': {'tune_twin.resume': True},
            **workers('tune_twin.workers'),
        },
    ),
    'tune --robot bag': (
        TUNE,
        {**topics('identify_bag.options'), '--output new.yaml': {'files': 'new.yaml'}},
    ),
    'train': (
        TRAIN,
        {
            '--robot torque': {'fit_simulated_runs.drive': 'torque'},
            '--seeds 104-105': {'assess.seeds': (104, 105)},
            '--output new.npz': {'save_model.path': 'new.npz'},
        },
    ),
    'train bag': (TRAIN, OF_BAGS),
    'faults': (
        FAULTS | SHARED,
        {
            'brown_out': {'study_faults.fault_runs.0.event.fault': 'brown_out'},
            '--output page.md': {'update_page.page': 'page.md'},
            '--html new.html': {'files': 'new.html'},
            '--json new.json': {'files': 'new.json'},
            **workers('study_faults.workers'),
        },
    ),
    'view': (
        VIEW,
        {
            '--bag bag': {'recorded_run.bag': 'bag', 'PageServer.command': None},
            '--namespace r1': {'view_node.namespace': 'r1'},
            '--port 0': {'PageServer.port': 0},
            '--read-only': {'PageServer.command': None},
            '--runs new': {'RunRecorder.runs': 'new'},
            '--headless': {'browser': None},
        },
    ),
    'topic list': (SEEN, {'-t': {'text': '/odom [nav_msgs/msg/Odometry]\n'}}),
    'topic info /odom': (
        SEEN,
        {'': {'text': 'of /odom\n', 'graph': ('topic_text', '/odom')}},
    ),
    'topic echo /odom': (
        SEEN,
        {
            '--once': {'text': 'one \n---\n'},
            '--field pose': {'text': 'one pose\n---\ntwo pose\n---\n'},
            '': {'graph': ('messages', '/odom')},
        },
    ),
    'topic hz /odom': (SEEN, {'': {'graph': ('messages', '/odom')}}),
    'param list': (
        SEEN,
        {'/player': {'text': 'rate\n', 'graph': ('parameter_names', '/player')}},
    ),
    'param describe /player rate': (
        SEEN,
        {'': {'text': 'a rate\n', 'graph': ('parameter_description', '/player', 'rate')}},
    ),
    'param get /player rate': (SEEN, {'': {'graph': ('parameter_text', '/player', 'rate')}}),
    'param set /player rate 0.3': (
        SEEN,
        {'': {'graph': ('set_parameter', '/player', 'rate', 0.3)}},
    ),
    'call /e_stop': (
        SEEN,
        {
            '': {'graph': ('call_by_name', '/e_stop', {})},
            '"{data: true}"': {'graph': ('call_by_name', '/e_stop', {'data': True})},
        },
    ),
    'stop': (SEEN, {}),
    'bag recover bag': (
        BAG,
        {'--output new': {'recover_bag.output': 'new'}, '--json new.json': {'files': 'new.json'}},
    ),
    'bag report bag': (
        BAG,
        {
            **JSON,
            'page.md': {'write_comparison.folders.1': 'page.md'},
            '--output new': {'write_report.output': 'new'},
            '--reference r': {'write_report.wanted.reference': 'r'},
            **topics('write_report.wanted'),
        },
    ),
    'bag animate bag --output x.gif': (
        BAG,
        {
            '--output new.gif': {'animate_bag.output': 'new.gif'},
            '--start 2': {'animate_bag.options.start': 2.0},
            '--duration 3': {'animate_bag.options.duration': 3.0},
            '--speed 4': {'animate_bag.options.speed': 4.0},
            '--rate 5': {'animate_bag.options.rate': 5.0},
            '--width 600': {'animate_bag.options.width': 600},
            '--namespace r1': {'animate_bag.wanted.namespace': 'r1'},
        },
    ),
    'bag replay bag': (
        REPLAY,
        {
            **JSON,
            '--namespace r1': {'load_inputs.namespace': 'r1'},
            '--model key': {'load_inputs.model.w': (1.0,), 'load_model.path': 'key'},
            '--set law.gain=3': {
                'make_controllers.changes.law.gain': 3,
                'replay_controller.changes.law.gain': 3,
            },
            '--output new': {'write_replay.folder': 'new'},
        },
    ),
    'bag compare bag': (
        REPLAY,
        {
            **JSON,
            'page.md': {'load_inputs.bag': 'page.md', 'compare_bags.one': 'inputs'},
            '': {'compare.tolerances.absolute': 1e-9, 'compare.tolerances.relative': 1e-9},
            '--abs 0.1': {'compare.tolerances.absolute': 0.1},
            '--rel 0.1': {'compare.tolerances.relative': 0.1},
            '--field terms/*=2': {'compare.tolerances.fields.terms/*': 2.0},
            '--picture new.png': {'write_divergence_figure.path': 'new.png'},
            '--set law.gain=3': {'replay_controller.changes.law.gain': 3},
            '--model key': {'load_inputs.model.w': (1.0,)},
            '--namespace r1': {'load_inputs.namespace': 'r1'},
        },
    ),
    'bag train bag': (TRAIN, OF_BAGS),
    'emulator --link l': (
        EMULATOR,
        {
            '--link m': {'PtyPort.link': 'm'},
            '--robot-link r': {'PtyPort.link': 'r'},
            '--world room': {'Emulator.parameters.twin.world': 'room'},
            '--key key': {'Emulator.key': KEY},
            '--erased': {'Emulator.erased': True},
            '--seed 5': {'Emulator.seed': 5, 'Emulator.parameters.twin.seed': 5},
            '--real-time-factor 4': {'serve.real_time_factor': 4.0},
            '--restart-on-open': {'serve.restart_on_open': True},
            '--set robot_clock_error=0.001': {'Emulator.parameters.robot_clock_error': 0.001},
            '--loss 0.25': {'fault': ('loss', 0.0, np.inf, 0.25)},
            '--fault loss:1:2:0.5': {'fault': ('loss', 1.0, 2.0, 0.5)},
        },
    ),
    'robot setup --port p --yes': (
        ROBOT,
        {
            '--port q': {'run_script.path': 'q'},
            '--channel 9': {'write_settings.settings.channel': 9},
            '--address 0102030405': {'write_settings.settings.address': bytes(range(1, 6))},
            '--rate 2M': {'write_settings.settings.rate': '2M'},
            '--power -12': {'write_settings.settings.power': '-12'},
            '--microsteps 8': {'write_settings.settings.microsteps': 8},
            '--steps-per-turn 400': {'write_settings.settings.steps_per_turn': 400},
            '--invert left': {
                'write_settings.settings.invert_left': True,
                'write_settings.settings.invert_right': False,
            },
            '--invert right': {
                'write_settings.settings.invert_left': False,
                'write_settings.settings.invert_right': True,
            },
            '--divider 3': {'write_settings.settings.divider': 3.0},
            '--battery wired': {'write_settings.settings.battery_wired': True},
            '--sensors none': {'write_settings.settings.sensors': 8 * ('none',)},
            '--load robot.yaml': {'write_settings.settings.channel': 7},
            '--diff robot.yaml': {'code': 1},
            '--save new.yaml': {'files': 'new.yaml'},
        },
    ),
    'robot log --port p': (ROBOT, {'--port q': {'run_script.path': 'q'}} | JSON),
    'robot key create new': (ROBOT, {}),
    'robot key check key': (ROBOT, JSON),
    'robot key write key --port p': (ROBOT, {'--port q': {'run_script.path': 'q'}}),
    'robot key erase --port p': (ROBOT, {'--port q': {'run_script.path': 'q'}}),
    'robot key state --port p': (
        ROBOT,
        {'--port q': {'run_script.path': 'q'}, '--key key': {'text': '\nequal to the file\n'}}
        | JSON,
    ),
    'robot ping --port p': (
        ROBOT,
        {
            '--port q': {'run_script.path': 'q'},
            '--count 9': {'run_link_test.count': 9},
            **link('run_link_test', key=False),
            **JSON,
        },
    ),
    'robot scan --port p': (
        ROBOT,
        {
            '--port q': {'run_script.path': 'q'},
            '--all-rates': {'scan_channels.rates': ('250k', '1M', '2M')},
            **link('scan_channels', key=False),
            **JSON,
        },
    ),
    'robot parameters --port p': (
        ROBOT,
        {
            '--port q': {'run_script.path': 'q'},
            **link('read_robot_info'),
            **JSON,
        },
    ),
    'robot jog --port p --yes left 1': (
        ROBOT,
        {
            '--port q': {'run_at_port.path': 'q'},
            '--speed 3': {'Jog.speed': 3.0},
            **link('Jog'),
        },
    ),
    'robot calibrate --port p': (
        ROBOT,
        {
            '--port q': {'CalibrationRobot.port': 'q'},
            '--robot-port r': {'CalibrationRobot.robot_port': 'r'},
            '--save robot.yaml': {'read_parameter_file.path': 'robot.yaml'},
            '--steps rest,radius': {'CalibrationWizard.options.steps': ('rest', 'radius')},
            '--wheel-radius 0.05': {'CalibrationWizard.options.geometry.wheel_radius': 0.05},
            '--wheel-separation 0.2': {'CalibrationWizard.options.geometry.wheel_separation': 0.2},
            '--distance 3': {'CalibrationWizard.options.distance': 3.0},
            '--turns 4': {'CalibrationWizard.options.turns': 4},
            '--speed 5': {'CalibrationWizard.options.speed': 5.0},
            '--distances 0.1,0.2,0.3,0.4': {
                'CalibrationWizard.options.distances': (0.1, 0.2, 0.3, 0.4)
            },
            '--mark-distance 5': {'CalibrationWizard.options.marks.distance': 0.005},
            '--mark-angle 90': {'CalibrationWizard.options.marks.angle': np.pi / 2},
            '--mark-range 7': {'CalibrationWizard.options.marks.range': 0.007},
            '--mark-voltage 0.5': {'CalibrationWizard.options.marks.voltage': 0.5},
            **link('CalibrationRobot'),
        },
    ),
    'robot doctor --port p --robot-port r --no-questions': (
        ROBOT,
        {
            '--port q': {'run_doctor.options.port': 'q'},
            '--robot-port q': {'run_doctor.options.robot_port': 'q'},
            '--count 11': {'run_doctor.options.count': 11},
            '--drive': {'run_doctor.options.drive': True},
            '--report new.html': {'run_doctor.options.report': 'new.html'},
            **link('run_doctor'),
        },
    ),
}


@pytest.fixture
def observed(monkeypatch, tmp_path, capsys):
    """Return a function that runs a command and returns what it called, printed and wrote."""
    for name, content in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
        path.chmod(0o600)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, 'stdin', SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr('t3mpc_ros.cli.view.StopSignal', lambda: nullcontext(lambda: True))

    def run(words, cores):
        calls, opened = Recorder(monkeypatch), []
        monkeypatch.setattr(webbrowser, 'open', opened.append)
        for target, result in cores.items():
            calls.replace(target, result)
        for mock in (GRAPH, BOARD):
            mock.reset_mock()
        code = main(shlex.split(words))
        files = [each for each in tmp_path.glob('new*') if each.is_file()]
        names = ' '.join(each.name for each in files)
        for each in files:
            each.unlink()
        graph = GRAPH.method_calls[-1] if GRAPH.method_calls else ('', ())
        fault = BOARD.schedule_fault.call_args
        printed = capsys.readouterr()
        return calls.found | {
            'code': code,
            'text': printed.out,
            'error': printed.err,
            'files': names,
            'browser': opened[0] if opened else None,
            'graph': (graph[0], *graph[1]),
            'fault': tuple(fault[0][0]) if fault else (),
        }

    return run


@pytest.mark.parametrize('words', TABLE)
def test_an_option_changes_what_it_names(words, observed):
    """An option that is parsed and then dropped is not noticed by who uses it."""
    cores, rows = TABLE[words]
    base = observed(words, cores)
    for option, expected in rows.items():
        changed = observed(f'{words} {option}', cores)
        for path, value in expected.items():
            assert changed[path] == value, option
            assert not option or base.get(path, ...) != value, f'{option} must change {path}'


WITHOUT_ROWS = 'demo', 'bag info', 'compile', 'completion'
"""Without options, or with tests of their own."""


@pytest.mark.parametrize('command', [name for name in commands() if name not in WITHOUT_ROWS])
def test_every_option_has_a_row(command):
    used = ' '.join(
        f'{words} {" ".join(rows)} '
        for words, (_, rows) in TABLE.items()
        if f'{words} '.startswith(f'{command} ')
    )
    assert used, 'the command must have a row'
    for option in options(commands()[command]).values():
        names = option.option_strings
        assert not names or any(f'{name} ' in used for name in names), option


def takes_zero(option):
    """Return whether an option is a number that may be 0 and is another one by default."""
    if option.type is None or not option.option_strings:
        return False
    try:
        value = option.type('0')
    except (ArgumentTypeError, ValueError):
        return False
    return value in (0, (0,)) and value != option.default


def with_zero(words):
    """Yield the option and the words of each row of a command with 0 in place of its number."""
    name = max((each for each in commands() if f'{words} '.startswith(f'{each} ')), key=len)
    known = options(commands()[name]).values()
    zero = {word for each in known if takes_zero(each) for word in each.option_strings}
    for row in TABLE[words][1]:
        for word, number in re.findall(r'(--\S+) (-?[\d.]\S*)', row):
            if word in zero:
                yield word, row, row.replace(f'{word} {number}', f'{word} 0')
        for word, number in re.findall(r'(--\S+) \S+=([\d.]+)$', row):
            yield word, row, f'{row.removesuffix(number)}0'


WITH_ZERO = {words: [*with_zero(words)] for words in TABLE}


@pytest.mark.parametrize('words', [words for words, rows in WITH_ZERO.items() if rows])
def test_zero_reaches_its_function_or_is_refused(words, observed):
    """A 0 that is taken for an option that was not given changes nothing, and says nothing."""
    cores, rows = TABLE[words]
    for _, row, changed in WITH_ZERO[words]:
        found = observed(f'{words} {changed}', cores)
        if found['code'] != 0:
            assert re.search(r'got .*\b0\b', found['error']), changed
            continue
        values = [np.ravel(found.get(path)) for path in rows[row]]
        assert any(value.dtype.kind in 'if' and 0 in value for value in values), changed


# -- the demo -------------------------------------------------------------------------------------


class Processes:
    """Records what would be started; whatever else is asked of it is well."""

    def __init__(self, *_):
        self.codes = {}

    def start(self, name, *words, parameters=None, program=''):
        STARTED[name] = parameters or {}
        STARTED[name, 'words'] = (program, *words)

    def log(self, name):
        return SimpleNamespace(read_text=lambda: 'live page at http://page (stop with Ctrl-C)')

    def stop_all(self, order):
        return {}

    def __getattr__(self, name):
        return lambda *_: None


STARTED = {}
DEMO = {
    '': {'seconds': 60.0, 'nodes': 'recorder controller sim_robot reference_generator'},
    '--duration 9': {'seconds': 9.0},
    '--output new': {'recorder storage.uri': 'new/bag'},
    '--seed 5': {'reference_generator seed': 5, 'sim_robot seed': 5},
    '--seed 0': {'reference_generator seed': 0, 'sim_robot seed': 0},
    '--robot emulator --seed 0 --output new': {
        'emulator': 't3mpc emulator --link new/dongle --loss 0.0 --seed 0',
        'reference_generator seed': 0,
    },
    '--robot servo': {
        'sim_robot drive.kind': 'velocity',
        'controller composition': 'paper',
        'sim_robot noise.variance': 0.04,
    },
    '--robot emulator --output new': {
        'nodes': 'emulator recorder controller radio_bridge reference_generator',
        'radio_bridge port': 'new/dongle',
        'emulator': 't3mpc emulator --link new/dongle --loss 0.0',
    },
    '--robot emulator --loss 0.25 --seed 3 --output new': {
        'emulator': 't3mpc emulator --link new/dongle --loss 0.25 --seed 3',
        'reference_generator seed': 3,
    },
    '--patrol': {
        'controller pose.enabled': True,
        'controller keep_out.enabled': True,
        'reference_generator source': 'portrait',
        'reference_generator seed': 0,
        'sim_robot world': 'room',
    },
    '--patrol --seed 5': {'reference_generator seed': 5},
    '--set controller.law.gain=90 --set sim_robot.seed=9': {
        'controller law.gain': 90,
        'sim_robot seed': 9,
    },
    '--view': {
        'nodes': 'recorder controller sim_robot reference_generator view',
        'view': 't3mpc view --headless --port 0',
        'browser': 'http://page report',
    },
    '--headless --view': {'browser': ''},
}
"""Words of ``t3mpc demo``, and what reaches the nodes, the emulated board and the browser."""


@pytest.mark.parametrize('words', DEMO)
def test_an_option_of_the_demo_reaches_its_node(words, monkeypatch, tmp_path):
    STARTED.clear()
    opened, clock = [], [0.0]
    report = SimpleNamespace(
        verdict=SimpleNamespace(text=text, sound=True, slow=False), summary=text, report=Path('r')
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, 'open', opened.append)
    for name, instead in (
        ('cli.process_group.ProcessGroup', Processes),
        ('cli.process_group.PrivateGraph', lambda: nullcontext(MagicMock(domain=1))),
        ('cli.demo.time.monotonic', lambda: clock[0]),
        ('cli.demo.time.sleep', lambda seconds: clock.append(clock.pop() + seconds)),
        ('evaluation.bag_report.report_page.write_report', lambda *_: report),
    ):
        monkeypatch.setattr(f't3mpc_ros.{name}', instead)
    assert main(['demo', *words.split()]) == 0

    nodes = [name for name in STARTED if isinstance(name, str)]
    found = {
        'seconds': pytest.approx(clock[0]),
        'nodes': ' '.join(nodes),
        'browser': ' '.join('report' if each.startswith('file:') else each for each in opened),
    }
    for node in nodes:
        found[node] = ' '.join(STARTED[node, 'words']).replace(f'{tmp_path}/', '')
        for name, value in STARTED[node].items():
            short = value.replace(f'{tmp_path}/', '') if isinstance(value, str) else value
            found[f'{node} {name}'] = short
        if node in NODES:
            parameter_class(node).from_dict(STARTED[node])
    assert DEMO[words].items() <= found.items()


def test_every_option_of_the_demo_has_a_row():
    used = f'{" ".join(DEMO)} '
    known = options(commands()['demo'])
    assert not [name for name in known if f'--{name} ' not in used]
    zero = [name for name, option in known.items() if takes_zero(option)]
    assert not [name for name in zero if f'--{name} 0 ' not in used]


@pytest.mark.parametrize('command', ['echo', 'hz'])
def test_what_arrives_is_printed_at_once(command, monkeypatch, tmp_path):
    """Into a pipe nothing was seen until kilobytes had gathered."""
    path = tmp_path / 'pipe'
    seen = []

    def messages(topic):
        yield 'one'
        for time in (1.0, 2.0, 3.0):
            clock.time = time
            yield 'two'
            yield None
            seen.append(path.read_text())

    clock = SimpleNamespace(time=0.0)
    monkeypatch.setattr('t3mpc_ros.cli.topic_param_call.time.monotonic', lambda: clock.time)
    opened = MagicMock(messages=messages)
    monkeypatch.setattr('t3mpc_ros.nodes.graph_client.graph', lambda stop: nullcontext(opened))
    monkeypatch.setattr('t3mpc_ros.nodes.graph_client.message_text', lambda message, _: message)
    with path.open('w') as pipe:
        monkeypatch.setattr(sys, 'stdout', pipe)
        assert main(['topic', command, '/odom']) == 0
    assert seen[1]
    assert seen[1] != seen[2]


@pytest.mark.parametrize('option', ['--json', '--html', '--csv'])
def test_a_folder_that_cannot_be_made_ends_it_before_the_runs(option, observed):
    """A path below a file was found out after an hour of runs."""
    Path('a_file').write_text('')
    found = observed(f'compare {option} a_file/new', TABLE['compare'][0])
    assert found['code'] == 1
    assert 'a_file' in found['error']
    assert not [path for path in found if path.startswith('run_plan')]
