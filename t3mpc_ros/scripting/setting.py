# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a controller of a script is run on: robot, reference, noise, faults."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
import os
from typing import Any

from t3mpc_ros.control.actuation import LimitParameters
from t3mpc_ros.evaluation.method_comparison.compared_runs import (
    DRIVES,
    ROBOT_TEXTS,
    AnyScenario,
    cases_for,
)
from t3mpc_ros.evaluation.method_comparison.twin_scenario import TwinScenario, check_name
from t3mpc_ros.evaluation.scenario import LoopPlant, SampledReference, Scenario
from t3mpc_ros.evaluation.simulated_links import LinkFaults
from t3mpc_ros.evaluation.tuning.search_space import find_names
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.scripting.plants import (
    LawNoise,
    NoiseLaw,
    NoisyPlant,
    OdePlant,
    Robot,
    StateSpace,
    gaussian_noise,
)
from t3mpc_ros.scripting.references import sampled
from t3mpc_ros.scripting.script_error import ScriptError
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultSchedule, load_schedule
from t3mpc_ros.simulation.plant.paper_plant import DisturbedPlant, PaperRobotParameters

NOMINAL = 'nominal'
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
            check_name('plant', self.plant, DRIVES)
        elif not isinstance(self.plant, Robot | OdePlant | StateSpace):
            raise ScriptError(
                f'plant must be {", ".join(DRIVES)}, a Robot, an OdePlant or a StateSpace: got '
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
        self.scenario(NOMINAL, 1).robot()

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
            text = ROBOT_TEXTS[self.plant]
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

    def scenario(self, case: str = NOMINAL, seed: int = 1) -> AnyScenario:
        """Return one run without its method.

        Raises
        ------
        ValueError
            An unknown case, or a number out of range.
        """
        if self.own_plant is not None and case != NOMINAL:
            raise ScriptError(f'case must be {NOMINAL} for a plant of your own: got {case!r}')
        links = self.faults if isinstance(self.faults, LinkFaults) else None
        if self.robot == 'twin':
            return ScriptedTwinScenario(
                case,
                seed,
                self.duration,
                self.variance,
                own_reference=self.own_reference,
                own_links=links,
                events=self._events,
                law=self.noise if isinstance(self.noise, NoiseLaw) else None,
                robot_parameters=self.robot_parameters,
            )
        return ScriptedScenario(
            DRIVES[self.robot],
            self.variance,
            case,
            seed,
            self.duration,
            own_reference=self.own_reference,
            own_links=links,
            own_robot=self.own_robot,
            own_plant=self.own_plant,
            law=self.noise if isinstance(self.noise, NoiseLaw) else None,
            robot_parameters=self.robot_parameters,
        )


@dataclass(frozen=True, eq=False)
class ScriptedTwinScenario(TwinScenario):
    """A run on the twin with a reference, faults or robot parameters of one's own."""

    own_reference: SampledReference | None = None
    own_links: LinkFaults | None = None
    events: FaultSchedule = field(default_factory=FaultSchedule)
    law: NoiseLaw | None = None
    robot_parameters: dict[str, Any] = field(default_factory=dict)

    __str__ = TwinScenario.__str__

    @property
    def links(self) -> LinkFaults:
        """Faults of the links between robot and controller."""
        return super().links if self.own_links is None else self.own_links

    def reference(self) -> SampledReference:
        """Return the reference over the run and the preview beyond it."""
        return super().reference() if self.own_reference is None else self.own_reference

    def robot(self) -> DigitalTwinParameters:
        """Return the true robot."""
        return super().robot().with_values(self.robot_parameters)

    def speed_noise(self) -> LawNoise | None:
        """Return the noise of the wheel speeds; None for white noise."""
        return None if self.law is None else LawNoise(self.law, self.robot().seed)

    def schedule(self) -> FaultSchedule:
        """Return the faults of robot and command link."""
        found = super().schedule()
        return FaultSchedule([*self.events.events, *found.events], found.name)


@dataclass(frozen=True, eq=False)
class ScriptedScenario(Scenario):
    """A run on the paper's plant, a robot or a plant of one's own."""

    own_reference: SampledReference | None = None
    own_links: LinkFaults | None = None
    own_robot: Robot | None = None
    own_plant: OwnPlant | None = None
    law: NoiseLaw | None = None
    robot_parameters: dict[str, Any] = field(default_factory=dict)

    __str__ = Scenario.__str__

    @property
    def links(self) -> LinkFaults:
        """Faults of the links between robot and controller."""
        return super().links if self.own_links is None else self.own_links

    @property
    def limits(self) -> LimitParameters:
        """Limits of a velocity command."""
        return super().limits if self.own_robot is None else self.own_robot.limits()

    def reference(self) -> SampledReference:
        """Return the reference over the run and the preview beyond it."""
        return super().reference() if self.own_reference is None else self.own_reference

    def plant(self) -> LoopPlant:
        """Return the plant of a new run."""
        law, seed = self.law, self.robot().seed
        if self.own_plant is not None:
            noise = law or gaussian_noise(self.noise)
            return NoisyPlant(self.own_plant.simulation(), LawNoise(noise, seed))
        if law is None:
            return DisturbedPlant(self.robot())
        quiet = self.robot().with_values({'noise.variance': 0.0})
        return NoisyPlant(DisturbedPlant(quiet), LawNoise(law, seed))

    def robot(self) -> PaperRobotParameters:
        """Return the true robot, as it is when the run begins."""
        return super().robot().with_values(self.robot_parameters)

    def _nominal(self) -> PaperRobotParameters:
        if self.own_robot is None:
            return super()._nominal()
        return self.own_robot.plant_parameters(self.drive)
