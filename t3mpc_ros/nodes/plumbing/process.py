# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The life of a node's process: start, spin, stop the robot, end with 0."""

from collections.abc import Callable, Sequence
from pathlib import Path
import sys
from typing import TYPE_CHECKING

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
import yaml

from t3mpc_ros.nodes.plumbing.stop_request import StopRequest
from t3mpc_ros.radio.authentication import KeyFileError
from t3mpc_ros.record.model import ModelError
from t3mpc_ros.record.schema import RecordError
from t3mpc_ros.robot.arena.world import WorldError
from t3mpc_ros.robot.twin.faults import ScheduleError
from t3mpc_ros.settings import SettingError

if TYPE_CHECKING:
    from t3mpc_ros.nodes.plumbing.package_node import PackageNode

Make = Callable[[], Sequence['PackageNode']]

USAGE_ERROR = 2

UNUSABLE = (
    SettingError,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ModelError,
    RecordError,
    WorldError,
    ScheduleError,
    KeyFileError,
)
"""What a node raises while it is made when it was given something it cannot use."""


def run(name: str, make: Make, request: StopRequest, argv: Sequence[str]) -> int:
    """Return the exit code of a process that spins the nodes of ``make`` until asked to stop.

    0 after SIGINT or SIGTERM, with the robot stopped, or when a node is done; 2 when a setting, a
    parameter file or the command line cannot be used, after one line on standard error that says
    which and why.
    """
    if problem := parameter_file_problem(argv):
        return _refuse(name, problem)
    try:
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        return _refuse(name, f'the command line cannot be used: {error}')
    nodes: Sequence[PackageNode] = ()
    try:
        nodes = make()
        request.starting = False
        if not request.wanted:
            _spin(nodes, request)
    except UNUSABLE as error:
        return _refuse(name, str(error))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        request.starting = False
        for node in nodes:
            node.finish()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return max((node.exit_code for node in nodes), default=0)


def parameter_file_problem(argv: Sequence[str]) -> str:
    """Return what is wrong with a ``--params-file`` of the command line; empty when nothing is."""
    for flag, name in zip(argv, list(argv)[1:], strict=False):
        if flag != '--params-file':
            continue
        try:
            content = yaml.safe_load(Path(name).read_text(encoding='utf-8'))
        except OSError as error:
            return f'cannot read the parameter file {name}: {error.strerror}'
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            where = ' '.join(str(error).split())
            return f'the parameter file {name} is not valid YAML: {where}'
        if not isinstance(content, dict):
            return (
                f'the parameter file {name} must hold "<node>: ros__parameters: ...": got nothing'
            )
    return ''


def _spin(nodes: Sequence['PackageNode'], request: StopRequest) -> None:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
        node.get_logger().info(f'{node.get_name()} ready')
    try:
        # A Python signal handler runs only between two calls: wake up often enough for it.
        while not request.wanted and not any(node.exit_code or node.done for node in nodes):
            executor.spin_once(timeout_sec=0.1)
    finally:
        for node in nodes:
            executor.remove_node(node)
        executor.shutdown()


def _refuse(name: str, problem: str) -> int:
    print(f'{name}: {problem}', file=sys.stderr, flush=True)
    return USAGE_ERROR
