# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Methods as plain data that can be sent to another process; each makes a driver for a run."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController, NominalModel
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.drivers import MethodDriver, NodeDriver
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.scenario import (
    PLANT_OF,
    PRETRAINING_DURATION,
    PRETRAINING_NOISE,
    PRETRAINING_SEEDS,
    Scenario,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters


@dataclass(frozen=True, slots=True)
class MethodSpec:
    """A method to be compared, as plain data that can be sent to another process.

    Calling it makes the method: ``spec(knowledge)``.
    """

    name: str
    controller_type: type[BaselineController]
    parameters: Parameters
    pretrained: bool = False
    """Whether a method with adaptation starts from the weights of :func:`pretrain`."""

    def __post_init__(self) -> None:
        expected = self.controller_type.parameters_type
        if not isinstance(self.parameters, expected):
            raise ValueError(
                f'parameters of {self.name} must be {expected.__name__}: '
                f'got {type(self.parameters).__name__}'
            )

    def __call__(self, nominal_model: NominalModel) -> BaselineController:
        """Return a new controller, with pretrained weights if so specified."""
        controller = self.controller_type(self.parameters, nominal_model)
        if self.pretrained and controller.get_weights():
            controller.set_weights(
                pretrain(self.controller_type, self.parameters, nominal_model.drive)
            )
        return controller

    def driver(self, scenario: Scenario) -> MethodDriver:
        """Return a new driver for a run."""
        return MethodDriver(self, scenario)


@lru_cache(maxsize=32)
def pretrain(
    controller_type: type[BaselineController], parameters: Parameters, drive: str
) -> Mapping[str, Array]:
    """Return the weights of a method after the runs of :data:`PRETRAINING_SEEDS` in sequence."""
    weights: Mapping[str, Array] = {}
    for seed in PRETRAINING_SEEDS:
        scenario = Scenario(
            PLANT_OF[drive], NOMINAL, seed, PRETRAINING_DURATION, PRETRAINING_NOISE
        )
        method = MadeMethod(controller_type(parameters, scenario.nominal_model()))
        if weights:
            method.controller.set_weights(weights)
        run(scenario, method)
        weights = method.controller.get_weights()
    return weights


class MadeMethod(NamedTuple):
    """A controller that is made already, for one run; its weights can be read after it."""

    controller: BaselineController
    name: str = 'made'

    def driver(self, scenario: Scenario) -> MethodDriver:
        """Return a driver with the controller."""
        return MethodDriver(lambda _: self.controller, scenario)


@dataclass(frozen=True, slots=True)
class NodeMethod:
    """The controller of the node, with changes of its parameters for the robot."""

    name: str
    changes: Mapping[str, object]

    def parameters_for(self, scenario: Scenario) -> ControllerParameters:
        """Return its parameters in a run."""
        return scenario.kind.controller_parameters(scenario).with_values(self.changes)

    def driver(self, scenario: Scenario) -> NodeDriver:
        """Return a new driver for a run."""
        controller = Controller(self.parameters_for(scenario))
        controller.warm_up()
        geometry = scenario.true_robot().geometry
        return NodeDriver(controller, geometry, scenario.reference().speeds)
