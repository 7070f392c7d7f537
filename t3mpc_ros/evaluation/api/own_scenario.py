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
"""Scenario of the runs of a script: its robot, reference, noise and faults."""

from collections.abc import Mapping
from typing import Any

from t3mpc_ros.evaluation.api.plants import NoiseLaw, OdePlant, Robot, StateSpace, gaussian_noise
from t3mpc_ros.evaluation.api.references import sampled
from t3mpc_ros.evaluation.cases import NOMINAL, ROBOTS
from t3mpc_ros.evaluation.scenario import KINDS, OwnParts, Scenario
from t3mpc_ros.evaluation.simulated_links import LinkFaults
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_injection import FaultEvent, FaultSchedule, load_schedule


def own_scenario(
    plant: Any = 'twin',
    reference: Any = None,
    noise: Any = 0.04,
    faults: Any = None,
    duration: Any = 60.0,
    *,
    case: str = NOMINAL,
    seed: int = 1,
    robot_parameters: Mapping[str, Any] | None = None,
    gyro: bool = False,
) -> Scenario:
    """Return one run without its method; arguments as of :func:`simulate`.

    ``robot_parameters`` are changes of the true robot by name, unknown to all methods; ``gyro`` as
    of :class:`Scenario`. ValueError: wrong use, an unknown name, or a number out of range.
    """
    robot, own, text = _robot_of(plant)
    if isinstance(noise, bool) or not isinstance(noise, int | float | NoiseLaw):
        raise ScriptError(
            'noise must be a variance in (rad/s)² or a NoiseLaw: got '
            f'{type(noise).__name__} {noise!r}'
        )
    if isinstance(duration, bool) or not isinstance(duration, int | float):
        raise ScriptError(f'duration must be a number of seconds: got {duration!r}')
    law = noise if isinstance(noise, NoiseLaw) else None
    variance = noise.variance if isinstance(noise, NoiseLaw) else float(noise)
    own_plant = plant if isinstance(plant, OdePlant | StateSpace) else None
    if own_plant is not None:
        law = law or gaussian_noise(variance)
        if robot_parameters:
            raise ScriptError(
                'parameters of the robot must not be given for a plant of your own: got '
                f'{", ".join(robot_parameters)}'
            )
    course = None
    if reference is not None:
        geometry = WheelGeometry() if own is None else own.plant_parameters().geometry
        course, text = sampled(reference, duration, geometry), f'{text}, your reference'
    links = faults if isinstance(faults, LinkFaults) else None
    parts = OwnParts(
        reference=course,
        links=links,
        events=_events_of(faults, robot) if links is None else (),
        noise=law,
        nominal=None if own is None else own.plant_parameters(KINDS[robot].drive),
        limits=None if own is None else own.limits(),
        plant=own_plant,
        robot_parameters=robot_parameters or {},
        text=text,
    )
    found = Scenario(robot, case, seed, duration, variance, gyro, parts)
    found.true_robot()  # a wrong parameter of the robot is an error before the runs
    return found


def _robot_of(plant: Any) -> tuple[str, Robot | None, str]:
    """Return the robot whose methods and metrics apply, a robot of one's own, and what it is."""
    if isinstance(plant, str):
        (name,) = find_names('plant', [plant], ROBOTS)
        return name, None, KINDS[name].text
    if isinstance(plant, Robot):
        return 'servo', plant, 'Your robot'
    if isinstance(plant, OdePlant | StateSpace):
        robot = 'torque' if plant.drive == 'torque' else 'servo'
        return robot, plant.robot, f'Your plant ({plant.name})'
    raise ScriptError(
        f'plant must be {", ".join(ROBOTS)}, a Robot, an OdePlant or a StateSpace: got '
        f'{type(plant).__name__} {plant!r}'
    )


def _events_of(faults: Any, robot: str) -> tuple[FaultEvent, ...]:
    if faults is None:
        return ()
    if robot != 'twin':
        raise ScriptError(
            'faults must be LinkFaults on a robot other than the twin: got '
            f'{type(faults).__name__}'
        )
    schedule = faults if isinstance(faults, FaultSchedule) else load_schedule(faults)
    return schedule.events
