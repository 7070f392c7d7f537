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
"""The URDF of the robot: one tree, where the parameters say."""

import math
from xml.etree import ElementTree

import numpy as np
import pytest

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.robot.description import FrameNames, Masses, fixed_frames, urdf
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters

NAMES = FrameNames('base', 'gyro', 'sharp_', 'right_hinge_joint', 'left_hinge_joint')
GEOMETRY = WheelGeometry(wheel_radius=0.06, wheel_separation=0.31)
MASSES = Masses(2.0, 0.03, 0.02, 0.1, 6e-5, 3e-5)
SENSORS = RangeSensorParameters(half_length=0.2, half_width=0.17, offset=0.11)


def numbers(element, name):
    return [float(word) for word in element.get(name).split()]


@pytest.fixture(scope='module')
def robot():
    return ElementTree.fromstring(urdf(NAMES, GEOMETRY, SENSORS, MASSES))


def test_links_and_joints_are_one_tree_below_the_base(robot):
    links = [link.get('name') for link in robot.findall('link')]
    assert len(set(links)) == len(links) == 1 + 2 + 1 + 8
    parents = {
        joint.find('child').get('link'): joint.find('parent').get('link')
        for joint in robot.findall('joint')
    }
    assert set(links) - set(parents) == {'base'}
    for link in links:
        seen = {link}
        while link in parents:
            link = parents[link]
            assert link not in seen
            seen.add(link)
        assert link == 'base'


def test_wheels_stand_on_the_floor_at_their_separation(robot):
    for name, side in (('right_hinge_joint', -1.0), ('left_hinge_joint', 1.0)):
        (joint,) = (found for found in robot.findall('joint') if found.get('name') == name)
        assert joint.get('type') == 'continuous'
        assert numbers(joint.find('origin'), 'xyz') == pytest.approx([0.0, side * 0.155, 0.06])
        # A positive angle rolls forward: about +y, the bottom of the wheel moves backwards.
        axis = np.array(numbers(joint.find('axis'), 'xyz'))
        assert np.cross(axis, [0.0, 0.0, -1.0]) == pytest.approx([-1.0, 0.0, 0.0])
        link = joint.find('child').get('link')
        (cylinder,) = robot.findall(f"link[@name='{link}']/collision/geometry/cylinder")
        assert float(cylinder.get('radius')) == 0.06


def test_fixed_joints_are_the_fixed_frames(robot):
    joints = {
        joint.find('child').get('link'): joint.find('origin')
        for joint in robot.findall("joint[@type='fixed']")
    }
    frames = fixed_frames(NAMES, GEOMETRY, SENSORS)
    assert set(joints) == {frame.name for frame in frames}
    for frame in frames:
        assert numbers(joints[frame.name], 'xyz') == pytest.approx([frame.x, frame.y, frame.z])
        assert numbers(joints[frame.name], 'rpy') == pytest.approx([0.0, 0.0, frame.yaw])


def test_beams_point_away_from_the_body():
    mounts = dict(zip(RANGE_SENSORS, sensor_mounts(SENSORS), strict=True))
    frames = {frame.name: frame for frame in fixed_frames(NAMES, GEOMETRY, SENSORS)}
    for sensor, (x, y, direction) in mounts.items():
        frame = frames[f'sharp_{sensor}_range_link']
        assert (frame.x, frame.y, frame.yaw) == (x, y, direction)
        ahead = frame.x * math.cos(frame.yaw) + frame.y * math.sin(frame.yaw)
        assert ahead == pytest.approx(0.2 if sensor[:4] in ('fron', 'rear') else 0.17)


@pytest.mark.parametrize('shape', ['box', 'sphere'])
def test_nothing_but_the_wheels_reaches_the_floor(robot, shape):
    for collision in robot.findall("link[@name='base']/collision"):
        found = collision.find(f'geometry/{shape}')
        if found is None:
            continue
        half = 0.5 * numbers(found, 'size')[2] if shape == 'box' else float(found.get('radius'))
        assert numbers(collision.find('origin'), 'xyz')[2] - half >= -1e-9


def test_the_masses_are_those_of_the_parameters_and_physical(robot):
    """Simulators refuse links without a mass below a moving joint, or ignore them."""
    found = {link.get('name'): link.find('inertial') for link in robot.findall('link')}
    heavy = {name for name, inertial in found.items() if inertial is not None}
    assert heavy == {'base', 'right_hinge_link', 'left_hinge_link'}
    masses = {name: float(found[name].find('mass').get('value')) for name in heavy}
    assert masses == {'base': 2.0, 'right_hinge_link': 0.1, 'left_hinge_link': 0.1}
    assert numbers(found['base'].find('origin'), 'xyz')[0] == 0.02
    for name in heavy:
        moments = [
            float(found[name].find('inertia').get(f'i{axis}')) for axis in ('xx', 'yy', 'zz')
        ]
        assert 2.0 * max(moments) <= sum(moments) * (1 + 1e-9), 'of no distribution of mass'
    assert float(found['base'].find('inertia').get('izz')) == 0.03
    assert float(found['left_hinge_link'].find('inertia').get('iyy')) == 6e-5
    light = ElementTree.fromstring(urdf(NAMES, GEOMETRY, SENSORS, MASSES._replace(wheel=0.0)))
    assert len(light.findall('link/inertial')) == 1
    shapes = {link.get('name'): len(link.findall('collision')) for link in robot.findall('link')}
    assert all(shapes[name] for name in heavy)
