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
"""Layouts for RViz, Foxglove and PlotJuggler: each topic, field and frame in them exists."""

from fnmatch import fnmatchcase
import json
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest
import yaml

from t3mpc_ros.control.controller import SCALAR_NAMES
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.nodes.registry import INTERFACES
from t3mpc_ros.nodes.sim_robot import SimRobotParameters

pytestmark = pytest.mark.ros

CONFIG = Path(__file__).resolve().parents[1] / 'config'
NODES = ('reference_generator', 'controller', 'sim_robot')
LATCHED = {'/robot_description', '/reference/path'}
MESSAGES = {
    '/odom': 'nav_msgs/Odometry',
    '/reference': 'nav_msgs/Odometry',
    '/cmd_vel': 'geometry_msgs/Twist',
}


def published(topic):
    """Return whether a node of the loop, or robot_state_publisher, publishes a topic."""
    if topic == '/robot_description':
        return True
    for node in NODES:
        for name in INTERFACES[node].publishes:
            absolute = name.replace('~', f'/{node}')
            absolute = absolute if absolute.startswith('/') else f'/{absolute}'
            if fnmatchcase(topic, absolute):
                break
        else:
            continue
        if topic.startswith('/controller/'):
            return topic.removeprefix('/controller/') in SCALAR_NAMES
        if topic.startswith('/range/'):
            return topic.removeprefix('/range/') in RANGE_SENSORS
        return True
    return False


def is_field(topic, path):
    """Return whether the message of a topic has the field, whose parts are in ``path``."""
    if topic.startswith('/controller/'):
        return path == ['data']
    package, name = MESSAGES[topic].split('/')
    message = getattr(__import__(f'{package}.msg', fromlist=[name]), name)()
    for part in path:
        if not hasattr(message, part):
            return False
        message = getattr(message, part)
    return isinstance(message, float)


def test_rviz_shows_topics_and_frames_that_exist():
    manager = yaml.safe_load((CONFIG / 't3mpc.rviz').read_text())['Visualization Manager']
    parameters = SimRobotParameters()
    assert manager['Global Options']['Fixed Frame'] == parameters.odom_frame_id
    displays = list(manager['Displays'])
    topics = set()
    while displays:
        display = displays.pop()
        displays += display.get('Displays', [])
        assert display.get('Reference Frame', '<Fixed Frame>') == '<Fixed Frame>'
        for key in ('Topic', 'Description Topic'):
            if key in display:
                topic = display[key]['Value']
                assert published(topic), topic
                # A volatile subscription never receives what was latched before it.
                latched = display[key]['Durability Policy'] == 'Transient Local'
                assert latched == (topic in LATCHED), topic
                topics.add(topic)
    assert {'/odom', '/reference', *(f'/range/{name}' for name in RANGE_SENSORS)} <= topics


def test_foxglove_shows_topics_and_fields_that_exist():
    layout = json.loads((CONFIG / 't3mpc_foxglove.json').read_text())
    panels = layout['configById']
    placed, branches = set(), [layout['layout']]
    while branches:
        branch = branches.pop()
        if isinstance(branch, str):
            placed.add(branch)
        else:
            branches += [branch['first'], branch['second']]
    assert placed == set(panels), 'each panel is on the screen'
    for name, panel in panels.items():
        for topic in panel.get('topics', ()):
            assert published(topic), topic
        for curve in panel.get('paths', ()):
            topic, *path = re.split(r'\.', curve['value'])
            assert published(topic), f'{name}: {topic}'
            assert is_field(topic, path), f'{name}: {curve["value"]}'
    assert panels['3D!floor']['followTf'] == SimRobotParameters().odom_frame_id
    assert published(panels['DiagnosticSummary!diagnostics']['topicToRender'])


def test_plotjuggler_draws_curves_of_subscribed_topics():
    root = ElementTree.parse(CONFIG / 't3mpc_plotjuggler.xml').getroot()
    topics = [topic.get('name') for topic in root.iter('topic')]
    curves = [curve.get('name') for curve in root.iter('curve')]
    assert all(map(published, topics))
    drawn = set()
    for curve in curves:
        (topic,) = (name for name in topics if curve.startswith(f'{name}/'))
        assert is_field(topic, curve.removeprefix(f'{topic}/').split('/')), curve
        drawn.add(topic)
    assert drawn == set(topics)
    for splitter in root.iter('DockSplitter'):
        assert len(splitter) == int(splitter.get('count')) == splitter.get('sizes').count(';') + 1
