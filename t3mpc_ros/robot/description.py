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
"""Description of the robot: its fixed frames, and the URDF.

The origin of the base frame is on the floor below the middle of the axle, x forward, y to the
left (REP 103), so that the pose of the odometry has no height. The description has simple shapes
and no meshes; masses are those of the simulation and stand in its parameters.
"""

import math
from typing import NamedTuple
from xml.etree import ElementTree

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters

_TYRE_WIDTH = 0.02  # m
_SENSOR_SIZE = '0.013 0.037 0.013'  # m: depth, width and height of the GP2Y0A21YK0F


class FrameNames(NamedTuple):
    """Names of the frames and wheel joints of a robot, without the prefix of its namespace."""

    base: str = 'base_link'
    imu: str = 'imu_link'
    range_prefix: str = ''  # the frame of a range sensor is this, then ``<sensor>_range_link``
    right_wheel_joint: str = 'right_wheel_joint'
    left_wheel_joint: str = 'left_wheel_joint'

    def range_sensor(self, sensor: str) -> str:
        """Return the frame of a range sensor of :data:`RANGE_SENSORS`."""
        return f'{self.range_prefix}{sensor}_range_link'


class Masses(NamedTuple):
    """Masses (kg) and inertias (kg m²) of the body and of a wheel, as in (14)."""

    body: float
    body_inertia: float  # about the vertical through the centre of mass
    com_offset: float  # centre of mass ahead of the axle, m
    wheel: float
    wheel_inertia: float  # about the axle
    wheel_turn_inertia: float  # about a diameter


class FixedFrame(NamedTuple):
    """A frame that does not move in the base frame."""

    name: str
    x: float  # m, forward
    y: float  # m, to the left
    z: float  # m above the floor
    yaw: float  # rad


def fixed_frames(
    names: FrameNames, geometry: WheelGeometry, sensors: RangeSensorParameters
) -> list[FixedFrame]:
    """Return the frames of the IMU and of the eight range sensors, at the height of the axle.

    The IMU lies on the middle of the axle with its axes parallel to those of the base. The x axis
    of a range sensor is its beam, the origin its face.
    """
    height = geometry.wheel_radius
    ranges = [
        FixedFrame(names.range_sensor(sensor), float(x), float(y), height, float(direction))
        for sensor, (x, y, direction) in zip(RANGE_SENSORS, sensor_mounts(sensors), strict=True)
    ]
    return [FixedFrame(names.imu, 0.0, 0.0, height, 0.0), *ranges]


def urdf(
    names: FrameNames, geometry: WheelGeometry, sensors: RangeSensorParameters, masses: Masses
) -> str:
    """Return the URDF of the robot: body, wheels, castor, IMU and range sensors.

    Its joints are the two wheels, continuous and named as in ``joint_states``, and the fixed ones
    of :func:`fixed_frames`. Body and wheels have their masses; sensors weigh nothing, and what is
    without a mass is merged with the body by simulators.
    """
    robot = ElementTree.Element('robot', name='t3mpc_robot')
    for colour, rgba in (('body', '0.85 0.87 0.9 1'), ('tyre', '0.15 0.15 0.15 1')):
        material = ElementTree.SubElement(robot, 'material', name=colour)
        ElementTree.SubElement(material, 'color', rgba=rgba)
    radius, half = geometry.wheel_radius, geometry.half_separation
    base = ElementTree.SubElement(robot, 'link', name=names.base)
    # The body ends where the sensors begin; it and the castor leave the floor to the wheels.
    width = 2.0 * min(sensors.half_width, half) - _TYRE_WIDTH
    length = 2.0 * sensors.half_length
    _add_shape(
        base, 'box', 'body', (0.0, 0.0, 1.2 * radius), size=f'{length:g} {width:g} {radius:g}'
    )
    # The parameters have no height of the mass, and the inertia about one axis only: the others
    # are those of a body that is as high as the box.
    upright_inertia = 0.5 * masses.body_inertia + masses.body * radius**2 / 12.0
    _add_inertia(
        base,
        masses.body,
        (masses.com_offset, 0.0, 1.2 * radius),
        (upright_inertia, upright_inertia, masses.body_inertia),
    )
    castor = 0.35 * radius
    for end in (1.0, -1.0):
        place = (end * (sensors.half_length - castor), 0.0, castor)
        _add_shape(base, 'sphere', 'tyre', place, radius=f'{castor:.9g}')
    for joint, side in ((names.right_wheel_joint, -half), (names.left_wheel_joint, half)):
        name = f'{joint.removesuffix("_joint")}_link'
        wheel = ElementTree.SubElement(robot, 'link', name=name)
        upright = (0.5 * math.pi, 0.0, 0.0)
        tyre = {'radius': f'{radius:.9g}', 'length': f'{_TYRE_WIDTH:g}'}
        _add_shape(wheel, 'cylinder', 'tyre', (0.0, 0.0, 0.0), upright, **tyre)
        turn, axle = masses.wheel_turn_inertia, masses.wheel_inertia
        _add_inertia(wheel, masses.wheel, (0.0, 0.0, 0.0), (turn, axle, turn))
        found = _add_joint(robot, 'continuous', joint, names.base, name, (0.0, side, radius), 0.0)
        ElementTree.SubElement(found, 'axis', xyz='0 1 0')
    for frame in fixed_frames(names, geometry, sensors):
        link = ElementTree.SubElement(robot, 'link', name=frame.name)
        if frame.name != names.imu:
            _add_shape(link, 'box', 'tyre', (-0.0065, 0.0, 0.0), size=_SENSOR_SIZE)
        joint = f'{frame.name.removesuffix("_link")}_joint'
        place = (frame.x, frame.y, frame.z)
        _add_joint(robot, 'fixed', joint, names.base, frame.name, place, frame.yaw)
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def _add_shape(
    link: ElementTree.Element,
    shape: str,
    material: str,
    place: tuple[float, float, float],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **size: str,
) -> None:
    """Add a shape to a link, to be seen and to collide; ``turn`` is roll, pitch, yaw (rad)."""
    for purpose in ('visual', 'collision'):
        element = ElementTree.SubElement(link, purpose)
        ElementTree.SubElement(element, 'origin', xyz=_numbers(place), rpy=_numbers(turn))
        geometry = ElementTree.SubElement(element, 'geometry')
        ElementTree.SubElement(geometry, shape, size)
        if purpose == 'visual':
            ElementTree.SubElement(element, 'material', name=material)


def _add_inertia(
    link: ElementTree.Element,
    mass: float,
    centre: tuple[float, float, float],
    moments: tuple[float, float, float],
) -> None:
    """Add mass and moments of inertia about the axes of a link, none if it weighs nothing."""
    if not mass:
        return
    element = ElementTree.SubElement(link, 'inertial')
    ElementTree.SubElement(element, 'origin', xyz=_numbers(centre), rpy='0 0 0')
    ElementTree.SubElement(element, 'mass', value=f'{mass:.9g}')
    values = dict.fromkeys(('ixy', 'ixz', 'iyz'), '0')
    values |= {key: f'{v:.9g}' for key, v in zip(('ixx', 'iyy', 'izz'), moments, strict=True)}
    ElementTree.SubElement(element, 'inertia', values)


def _add_joint(
    robot: ElementTree.Element,
    kind: str,
    name: str,
    parent: str,
    child: str,
    place: tuple[float, float, float],
    yaw: float,
) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, 'joint', name=name, type=kind)
    ElementTree.SubElement(joint, 'parent', link=parent)
    ElementTree.SubElement(joint, 'child', link=child)
    ElementTree.SubElement(joint, 'origin', xyz=_numbers(place), rpy=_numbers((0.0, 0.0, yaw)))
    return joint


def _numbers(values: tuple[float, float, float]) -> str:
    return ' '.join(f'{value:.9g}' for value in values)
