# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Process of a node: initialise rclpy, spin, shut down, return the exit code."""

from collections.abc import Callable, Sequence
from pathlib import Path
import sys
from typing import TYPE_CHECKING

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
import yaml

from t3mpc_ros.bag.run.model_file import ModelError
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.nodes.common.entry_point import StopRequest
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.protocol.authentication import KeyFileError
from t3mpc_ros.simulation.fault_injection import ScheduleError
from t3mpc_ros.simulation.world import WorldError

if TYPE_CHECKING:
    from t3mpc_ros.nodes.common.base_node import BaseNode


NodeFactory = Callable[[], Sequence['BaseNode']]

USAGE_ERROR = 2

CONFIGURATION_ERRORS = (
    ParameterError,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ModelError,
    BagError,
    WorldError,
    ScheduleError,
    KeyFileError,
)
"""What a node raises while it is made when it was given something it cannot use."""


def run(name: str, make: NodeFactory, request: StopRequest, argv: Sequence[str]) -> int:
    """Return the exit code of a process that spins the nodes of ``make`` until asked to stop.

    0 after SIGINT or SIGTERM, with the robot stopped, or when a node is done; 2 when a setting, a
    parameter file or the command line cannot be used, after one line on standard error that says
    which and why.
    """
    if problem := parameter_file_problem(argv):
        return _report_usage_error(name, problem)
    try:
        rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        return _report_usage_error(name, f'the command line cannot be used: {error}')
    nodes: Sequence[BaseNode] = ()
    try:
        nodes = make()
        request.starting = False
        if not request.wanted:
            _spin(nodes, request)
    except CONFIGURATION_ERRORS as error:
        return _report_usage_error(name, str(error))
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


def _spin(nodes: Sequence['BaseNode'], request: StopRequest) -> None:
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


def _report_usage_error(name: str, problem: str) -> int:
    print(f'{name}: {problem}', file=sys.stderr, flush=True)
    return USAGE_ERROR
