# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a controller of a script is run on: robot, reference, noise, faults."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
import os
from typing import Any

from t3mpc_ros.evaluation.cases import NOMINAL, ROBOTS, cases_for
from t3mpc_ros.evaluation.experiment import content_of
from t3mpc_ros.evaluation.scenario import (
    KINDS,
    OwnParts,
    SampledReference,
    Scenario,
    check_name,
)
from t3mpc_ros.evaluation.simulated_links import LinkFaults
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.scripting.plants import (
    LawNoise,
    NoiseLaw,
    OdePlant,
    Robot,
    StateSpace,
    gaussian_noise,
)
from t3mpc_ros.scripting.references import sampled
from t3mpc_ros.scripting.script_error import ScriptError
from t3mpc_ros.simulation.fault_injection import FaultSchedule, load_schedule

OwnPlant = OdePlant | StateSpace


@dataclass(frozen=True, eq=False)
class Setting:
    """Robot, reference, noise, faults and duration of runs.

    Parameters
    ----------
    plant
        ``'twin'``: the stepper robot; ``'servo'`` or ``'torque'``: the paper's plant with that
        drive; or a :class:`Robot`, an :class:`OdePlant` or a :class:`StateSpace`.
    reference
        None for the chaotic one of each seed; see :func:`sampled`.
    noise
        Variance of the measured wheel speeds, (rad/s)², or a :class:`NoiseLaw`.
    faults
        :class:`LinkFaults`; on the twin also a :class:`FaultSchedule`, the name of a bundled one,
        or a YAML file.
    duration
        s
    robot_parameters
        Changes of the true robot by name, unknown to all methods.
    """

    plant: Any = 'twin'
    reference: Any = None
    noise: float | NoiseLaw = 0.04
    faults: LinkFaults | FaultSchedule | str | os.PathLike[str] | None = None
    duration: float = 60.0
    robot_parameters: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.plant, str):
            check_name('plant', self.plant, ROBOTS)
        elif not isinstance(self.plant, Robot | OdePlant | StateSpace):
            raise ScriptError(
                f'plant must be {", ".join(ROBOTS)}, a Robot, an OdePlant or a StateSpace: got '
                f'{type(self.plant).__name__} {self.plant!r}'
            )
        if isinstance(self.noise, bool) or not isinstance(self.noise, int | float | NoiseLaw):
            raise ScriptError(
                'noise must be a variance in (rad/s)² or a NoiseLaw: got '
                f'{type(self.noise).__name__} {self.noise!r}'
            )
        if self.faults is not None and not isinstance(self.faults, LinkFaults):
            if self.robot != 'twin':
                raise ScriptError(
                    'faults must be LinkFaults on a robot other than the twin: got '
                    f'{type(self.faults).__name__}'
                )
            _ = self._events
        if isinstance(self.duration, bool) or not isinstance(self.duration, int | float):
            raise ScriptError(f'duration must be a number of seconds: got {self.duration!r}')
        if self.own_plant is not None and self.robot_parameters:
            raise ScriptError(
                'parameters of the robot must not be given for a plant of your own: got '
                f'{", ".join(self.robot_parameters)}'
            )
        self.scenario(NOMINAL, 1).true_robot()

    @property
    def robot(self) -> str:
        """The robot whose methods and metrics apply: ``twin``, ``servo`` or ``torque``."""
        if isinstance(self.plant, str):
            return self.plant
        return 'torque' if getattr(self.plant, 'drive', '') == 'torque' else 'servo'

    def chosen_cases(self, cases: str | Sequence[str]) -> tuple[str, ...]:
        """Return the full names of one or more cases; a plant of one's own has the nominal one.

        Raises
        ------
        ValueError
            The robot has no case of that name.
        """
        known = (NOMINAL,) if self.own_plant is not None else cases_for(self.robot)
        return find_names('case', (cases,) if isinstance(cases, str) else cases, known)

    @property
    def robot_text(self) -> str:
        """What the plant is, in words, with a reference of one's own."""
        if isinstance(self.plant, str):
            text = KINDS[self.plant].text
        elif isinstance(self.plant, Robot):
            text = 'Your robot'
        else:
            text = f'Your plant ({self.plant.name})'
        return text if self.reference is None else f'{text}, your reference'

    @property
    def reference_text(self) -> str:
        """What the reference is: ``chaotic``, the path of a file, or the kind of the source."""
        if self.reference is None:
            return 'chaotic'
        if isinstance(self.reference, str | os.PathLike):
            return os.fspath(self.reference)
        return str(getattr(self.reference, '__name__', type(self.reference).__name__))

    @property
    def variance(self) -> float:
        """Variance that the estimators assume, (rad/s)²."""
        return self.noise.variance if isinstance(self.noise, NoiseLaw) else float(self.noise)

    @property
    def own_plant(self) -> OwnPlant | None:
        """The plant of one's own, None with a robot."""
        return self.plant if isinstance(self.plant, OdePlant | StateSpace) else None

    @property
    def own_robot(self) -> Robot | None:
        """The robot of one's own, or the one that a plant of one's own is assumed to be."""
        if isinstance(self.plant, str):
            return None
        return self.plant if isinstance(self.plant, Robot) else self.plant.robot

    @property
    def geometry(self) -> WheelGeometry:
        """Wheel radius and separation."""
        if (own := self.own_robot) is None:
            return WheelGeometry()
        return own.plant_parameters().geometry

    @cached_property
    def own_reference(self) -> SampledReference | None:
        """The reference of one's own, sampled; None for the chaotic one."""
        if self.reference is None:
            return None
        return sampled(self.reference, self.duration, self.geometry)

    @cached_property
    def _events(self) -> FaultSchedule:
        if isinstance(self.faults, FaultSchedule):
            return self.faults
        if self.faults is None or isinstance(self.faults, LinkFaults):
            return FaultSchedule()
        return load_schedule(os.fspath(self.faults))

    def content(self) -> object:
        """Return what determines its runs: the reference counts with its speeds."""
        reference = self.own_reference
        speeds = None if reference is None else reference.speeds
        parts = self.plant, self.noise, self.faults, self.duration, self.robot_parameters, speeds
        return content_of(parts)

    def scenario(self, case: str = NOMINAL, seed: int = 1) -> Scenario:
        """Return one run without its method.

        Raises
        ------
        ValueError
            An unknown case, or a number out of range.
        """
        if self.own_plant is not None and case != NOMINAL:
            raise ScriptError(f'case must be {NOMINAL} for a plant of your own: got {case!r}')
        own, law = self.own_robot, self.noise if isinstance(self.noise, NoiseLaw) else None
        if self.own_plant is not None:
            law = law or gaussian_noise(self.variance)
        parts = OwnParts(
            reference=self.own_reference,
            links=self.faults if isinstance(self.faults, LinkFaults) else None,
            events=self._events,
            noise=None if law is None else partial(LawNoise, law),
            nominal=None if own is None else own.plant_parameters(KINDS[self.robot].drive),
            limits=None if own is None else own.limits(),
            plant=None if self.own_plant is None else self.own_plant.simulation,
            robot_parameters=self.robot_parameters,
        )
        return Scenario(self.robot, case, seed, self.duration, self.variance, own=parts)
