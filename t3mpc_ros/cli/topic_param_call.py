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
"""``t3mpc topic``, ``param``, ``call`` and ``stop``: for a graph without a ROS installation."""

import argparse
from collections import deque
from collections.abc import Callable
import sys
import time
from typing import TYPE_CHECKING, Any

import yaml

from t3mpc_ros.stop_signal import StopSignal

if TYPE_CHECKING:
    from t3mpc_ros.nodes.graph_client import Graph

REPORT_PERIOD = 1.0
"""Time between two lines of a rate, s."""
WINDOW = 10_000
"""Number of messages over which a rate is averaged."""


def add_parser(commands: Any) -> None:
    """Add the subcommands for topics, parameters and services."""
    topic = commands.add_parser('topic', help='topics of the graph, as ros2 topic')
    words = topic.add_subparsers(dest='word', required=True, metavar='list|info|echo|hz')
    listing = words.add_parser('list', help='names of the topics')
    listing.add_argument('-t', '--show-types', action='store_true', help='with their types')
    listing.set_defaults(run=_with_graph(_list_topics))
    info = words.add_parser('info', help='types, publishers and subscriptions of a topic')
    info.add_argument('topic')
    info.set_defaults(run=_with_graph(lambda graph, given: print(graph.topic_text(given.topic))))
    echo = words.add_parser('echo', help='messages of a topic')
    echo.add_argument('topic')
    echo.add_argument('--field', default='', help='one field, for example pose.pose.position')
    echo.add_argument('--once', action='store_true', help='the first message only')
    echo.set_defaults(run=_with_graph(_echo))
    rate = words.add_parser('hz', help='rate of a topic')
    rate.add_argument('topic')
    rate.set_defaults(run=_with_graph(_rate))

    param = commands.add_parser('param', help='parameters of the nodes, as ros2 param')
    words = param.add_subparsers(dest='word', required=True, metavar='list|describe|get|set')
    listing = words.add_parser('list', help='names of the parameters')
    listing.add_argument('node', nargs='?', help='of this node only, for example /controller')
    listing.set_defaults(run=_with_graph(_list_parameters))
    describing = words.add_parser('describe', help='what a parameter is, with its range')
    getting = words.add_parser('get', help='value of a parameter')
    setting = words.add_parser('set', help='set a dynamic parameter')
    for parser in (describing, getting, setting):
        parser.add_argument('node')
        parser.add_argument('name')
    describing.set_defaults(
        run=_with_graph(
            lambda graph, given: print(graph.parameter_description(given.node, given.name))
        )
    )
    getting.set_defaults(
        run=_with_graph(lambda graph, given: print(graph.parameter_text(given.node, given.name)))
    )
    setting.add_argument('value', help='in YAML: 0.3, true, [1.0, 2.0], text')
    setting.set_defaults(run=_with_graph(_set_parameter))

    call = commands.add_parser('call', help='call a service, as ros2 service call')
    call.add_argument('service', help='for example /reference_generator/reseed')
    call.add_argument('values', nargs='?', default='{}', help='fields in YAML: "{data: true}"')
    call.set_defaults(run=_with_graph(_call))

    stop = commands.add_parser('stop', help='latch the e-stop of every robot in reach')
    stop.set_defaults(run=_with_graph(_stop))


def _with_graph(
    run: Callable[['Graph', argparse.Namespace], int | None],
) -> Callable[[argparse.Namespace], int | None]:
    """Return a command that runs in the graph."""

    def run_in_graph(options: argparse.Namespace) -> int | None:
        from t3mpc_ros.nodes.node_main import check_environment

        check_environment()
        from t3mpc_ros.nodes.graph_client import graph  # takes a second

        with StopSignal() as stop, graph(stop) as opened:
            return run(opened, options)

    return run_in_graph


def _list_topics(graph: 'Graph', options: argparse.Namespace) -> None:
    for name, kinds in graph.topics().items():
        print(f'{name} [{", ".join(kinds)}]' if options.show_types else name)


def _echo(graph: 'Graph', options: argparse.Namespace) -> None:
    from t3mpc_ros.nodes.graph_client import message_text

    for message in graph.messages(options.topic):
        if message is not None:
            print(f'{message_text(message, options.field)}---', flush=True)
            if options.once:
                break


def _rate(graph: 'Graph', options: argparse.Namespace) -> None:
    from t3mpc_ros.nodes.graph_client import rate_text

    arrivals: deque[float] = deque(maxlen=WINDOW)
    due = time.monotonic() + REPORT_PERIOD
    for message in graph.messages(options.topic):
        now = time.monotonic()
        if message is not None:
            arrivals.append(now)
        elif now >= due:
            due += REPORT_PERIOD
            if text := rate_text(arrivals):
                print(text, flush=True)


def _list_parameters(graph: 'Graph', options: argparse.Namespace) -> None:
    if options.node:
        print('\n'.join(graph.parameter_names(options.node)))
        return
    for node in graph.nodes():
        print('\n  '.join([f'{node}:', *graph.parameter_names(node)]))


def _set_parameter(graph: 'Graph', options: argparse.Namespace) -> int:
    value = _yaml(options.value)
    if problem := graph.set_parameter(options.node, options.name, value):
        print(f'Setting parameter failed: {problem}', file=sys.stderr)
        return 1
    print('Set parameter successful')
    return 0


def _yaml(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(
            f'value must be YAML, like 0.3, [1.0, 2.0] or {{data: true}}: got {text}'
        ) from None


def _call(graph: 'Graph', options: argparse.Namespace) -> int:
    """Print the answer of a service; return 1 if it says that it has not succeeded."""
    from t3mpc_ros.nodes.graph_client import message_text

    values = _yaml(options.values)
    if not isinstance(values, dict):
        raise ValueError(f'the fields must be a YAML mapping, like {{data: true}}: got {values!r}')
    answer = graph.call_by_name(options.service, values)
    print(message_text(answer), end='')
    return 0 if getattr(answer, 'success', True) else 1


def _stop(graph: 'Graph', options: argparse.Namespace) -> int:
    problems = graph.stop_robots()
    for name, problem in problems.items():
        print(f'{name}: {problem or "latched"}', file=sys.stderr if problem else sys.stdout)
    if not problems:
        print(
            'no robot in reach offers e_stop; is ROS_DOMAIN_ID that of the robot?', file=sys.stderr
        )
    return 0 if problems and not any(problems.values()) else 1
