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
"""The process of an executable: start of ROS, spin, shutdown, exit code."""

from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
import fcntl
import os
from pathlib import Path
import socket
import struct
import sys
import tempfile
from typing import TYPE_CHECKING, NoReturn, TypeVar

from t3mpc_ros.missing_library import remedy
from t3mpc_ros.nodes import arguments
from t3mpc_ros.nodes.registry import node_class
from t3mpc_ros.stop_signal import StopSignal
from t3mpc_ros.version import VERSION

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node

    from t3mpc_ros.nodes.base_node import BaseNode

N = TypeVar('N', bound='Node')

USAGE_ERROR = 2
"""Exit code for an unusable parameter, parameter file or command line."""
MAX_DOMAIN = 232
"""Largest domain: the ports of DDS end there."""
_SIOCGIFFLAGS, _IFF_UP = 0x8913, 1
"""Request for the flags of a network interface, and one of them (netdevice(7))."""
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
"""Variable with the settings of Fast DDS, which goes on without a word if the file is missing."""


def main(name: str, stop: StopSignal) -> NoReturn:
    """Run the executable of a node and end the process at once.

    The robot is stopped and the files are closed when :func:`run` returns. The teardown of the
    interpreter would take half a second more, in which launch sends SIGTERM on a busy machine.
    """
    try:
        code = run(name, stop, sys.argv)
    except ModuleNotFoundError as error:
        if not (problem := remedy(error)):
            raise
        print(f'{name}: {problem}', file=sys.stderr, flush=True)
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def run(name: str, stop: StopSignal, argv: Sequence[str]) -> int:
    """Spin the nodes of an executable until a signal; return the exit code of the process.

    0 after SIGINT, SIGTERM or SIGHUP, with the robot stopped, after a node has requested the
    exit, and for ``--help`` and ``--version``; 2 for an unusable parameter, parameter file or
    command line, with one line on standard error that names it and the reason; 1, with such a
    line, for a conflict with another process.
    """
    # Both before rcl, which would name neither value nor bound, and ends the process.
    if problem := environment_problem(os.environ) or arguments.parameter_file_problem(argv):
        return _usage_error(name, problem)
    import rclpy
    from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
    from rclpy.executors import ExternalShutdownException
    from rclpy.utilities import remove_ros_args

    from t3mpc_ros.parameters.table import ParameterError

    try:
        words = remove_ros_args(list(argv))[1:]
        if {'-h', '--help'} & set(words):
            print(arguments.help_text(name))
            return 0
        if '--version' in words:
            print(f't3mpc_ros {VERSION}')
            return 0
        if problem := arguments.unknown_arguments(name, words):
            return _usage_error(name, problem)
        init_ros(argv)
    except (RuntimeError, ValueError) as error:
        return _usage_error(name, f'invalid command line: {error}')
    kind = node_class(name)
    configuration_errors = (
        ParameterError,
        InvalidParameterTypeException,
        InvalidParameterValueException,
        *kind.configuration_errors,
    )
    nodes: Sequence[BaseNode] = ()
    try:
        nodes = kind.make(cli_args=list(argv))
        names = [node.get_fully_qualified_name() for node in nodes]
        alone = isolation(os.environ)
        for problem in arguments.unmatched_files(argv, names) + [alone] * bool(alone):
            for node in nodes:
                node.get_logger().warning(problem)
                node.start_warnings.append(problem)
        stop.exit_at_once = False
        if not stop():
            _spin(nodes, stop)
    except configuration_errors as error:
        code = 1 if isinstance(error, kind.conflict_errors) else USAGE_ERROR
        return _usage_error(name, str(error), code)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        stop.exit_at_once = False
        for node in nodes:
            node.on_shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    return max((node.exit_code for node in nodes), default=0)


def make_executor() -> 'Executor':
    """Return the executor that takes the least processor time: events, as of rclpy 7.1.4.

    A wait set is built anew for every message: a node that only echoes 100 messages a second takes
    twice the time with it.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def _spin(nodes: Sequence['BaseNode'], stop: StopSignal) -> None:
    executor = make_executor()
    for node in nodes:
        executor.add_node(node)
        node.get_logger().info(f'{node.get_name()} ready')
    try:
        # A Python signal handler runs only between two calls of the executor. Without a limit of
        # time, the events executor of rclpy 7.1 does not wait but takes a whole core.
        while not stop() and not any(node.exit_code or node.exit_requested for node in nodes):
            executor.spin_once(timeout_sec=0.1)
    finally:
        for node in nodes:
            executor.remove_node(node)
        executor.shutdown()


def _usage_error(name: str, problem: str, code: int = USAGE_ERROR) -> int:
    print(f'{name}: {problem}', file=sys.stderr, flush=True)
    return code


@contextmanager
def own_context(make: 'Callable[[], N]') -> 'Iterator[N]':
    """Return the node that ``make`` returns, in a context that ends with the ``with`` block."""
    import rclpy

    init_ros([])
    try:
        node = make()
        try:
            yield node
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def init_ros(words: Sequence[str]) -> None:
    """Initialise rclpy with the arguments of a command line, without its signal handlers."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    check_environment()
    provide_log_directory(os.environ)
    rclpy.init(args=list(words), signal_handler_options=SignalHandlerOptions.NO)


def check_environment() -> None:
    """Raise ValueError for what ROS cannot start with: before the first import of rclpy."""
    if problem := environment_problem(os.environ):
        raise ValueError(problem)


def environment_problem(environment: Mapping[str, str]) -> str:
    """Return what is wrong with the domain, the middleware or its profile; '' if nothing is."""
    text = environment.get('ROS_DOMAIN_ID', '')
    if text and not (text.isdecimal() and int(text) <= MAX_DOMAIN):
        return f'ROS_DOMAIN_ID must be a whole number from 0 to {MAX_DOMAIN}: got {text}'
    profile = environment.get(PROFILES)
    if profile and uses_fast_dds(environment) and not Path(profile).is_file():
        return f'{PROFILES} must be an existing file, with its whole path: got {profile}'
    # The index of ROS packages; where a wheel is used without a set-up, that of its environment.
    prefixes = (environment.get('AMENT_PREFIX_PATH') or sys.prefix).split(os.pathsep)
    index = Path('share', 'ament_index', 'resource_index', 'rmw_typesupport')
    names = {path.name for prefix in prefixes for path in Path(prefix, index).glob('rmw_*')}
    known = sorted(names - {'rmw_implementation'})
    wanted = environment.get('RMW_IMPLEMENTATION')
    if not wanted or not known or wanted in known:
        return ''
    return f'RMW_IMPLEMENTATION must be one that is installed, {", ".join(known)}: got {wanted}'


def isolation(environment: Mapping[str, str]) -> str:
    """Return why no node finds one of another process; '' if nothing is known to prevent it."""
    name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    if environment.get(name) == 'OFF' and environment.get('ROS_LOCALHOST_ONLY') != '1':
        return f'no node of another process is found, because {name} is OFF: unset it'
    if not _network_is_up():
        return (
            'no node of another process is found, because no network interface is up: '
            '`ip link set lo up` is enough on one machine'
        )
    return ''


def _network_is_up() -> bool:
    """Return whether a network interface is up; also True where the kernel does not say."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
            for _, name in socket.if_nameindex():
                request = struct.pack('16s24x', name.encode())
                answer = fcntl.ioctl(asked, _SIOCGIFFLAGS, request)
                if struct.unpack_from('H', answer, 16)[0] & _IFF_UP:
                    return True
    except OSError:
        return True
    return False


def uses_fast_dds(environment: Mapping[str, str]) -> bool:
    """Return whether the middleware is Fast DDS, as it is by default."""
    return 'fastrtps' in (environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp')


def provide_log_directory(environment: MutableMapping[str, str]) -> None:
    """Set ``ROS_LOG_DIR`` to a temporary folder where ROS could not write its logs.

    ROS writes them below ``ROS_HOME`` or ``~/.ros``; in a read-only home folder, as of a service
    or a container, no node would start. A folder that the user has chosen is not replaced.
    """
    if environment.get('ROS_LOG_DIR'):
        return
    base = environment.get('ROS_HOME') or str(Path(environment.get('HOME', os.devnull), '.ros'))
    try:
        Path(base, 'log').mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=Path(base, 'log')):
            pass
    except OSError:
        folder = Path(tempfile.gettempdir(), f't3mpc_ros-{os.getuid()}', 'log')
        environment['ROS_LOG_DIR'] = str(folder)
