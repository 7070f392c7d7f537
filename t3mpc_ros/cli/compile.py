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
"""``t3mpc compile``: compiles every kernel into the cache, or removes what is in it."""

import argparse
import os

from t3mpc_ros.cli.shared_options import Commands


def add_parser(commands: Commands) -> None:
    """Add the subcommand ``compile``."""
    parser = commands.add_parser('compile', help='compile every kernel into the cache')
    parser.add_argument(
        '--remove',
        action='store_true',
        help='instead: remove what every version has compiled, from T3MPC_CACHE_DIR if it is set, '
        "else from the user's cache, which other installations share",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Compile the kernels in two processes, each with about half of the work; or remove them."""
    if options.remove:
        from t3mpc_ros.kernels import remove_compiled

        for folder in remove_compiled(os.environ):
            print(f'removed {folder}')
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(2, get_context('spawn')) as pool:
        for part in [pool.submit(_compile_controllers), pool.submit(_compile_robots)]:
            part.result()


def _compile_robots() -> None:
    """Compile parts of a controller before it needs them, robots and reference."""
    import numpy as np

    from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
    from t3mpc_ros.control.body_correction import BodyCorrection, BodyCorrectionParameters
    from t3mpc_ros.control.controller import StepperControllerParameters
    from t3mpc_ros.control.dead_time_estimator import DeadTimeEstimator
    from t3mpc_ros.control.input_shaper import InputShaper
    from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters
    from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters, SpeedKalmanFilter
    from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
    from t3mpc_ros.geometry.kinematics import WheelGeometry
    from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters, make_robot

    zero, controller = np.zeros(2), StepperControllerParameters()
    FuzzyEstimator(controller.fuzzy, controller.adaptation, outputs=2).warm_up()
    SpeedKalmanFilter(controller.speed_filter, 'velocity', 0.01).update(
        zero, zero, 0.01, sent=True
    )
    InputShaper(controller.command_shaper, 0.01).step(zero, 0.01)
    DeadTimeEstimator(SpeedFilterParameters(), 0.01).step(zero, zero, 0.01)
    BodyCorrection(BodyCorrectionParameters(), 0.04, 0.1, 0.01).step(
        0.0, 0.01, zero, zero, zero, 0.0
    )
    JumpTransition(JumpTransitionParameters(), 0.1, 0.01).step(0, zero, zero)
    for kind in ('stepper', 'velocity'):
        make_robot(DigitalTwinParameters.from_dict({'drive.kind': kind})).warm_up()
    ChaoticReference(ReferenceParameters(), WheelGeometry()).advance()


def _compile_controllers() -> None:
    from t3mpc_ros.control.controller import Controller, StepperControllerParameters
    from t3mpc_ros.evaluation.cases import NOMINAL, PLANTS
    from t3mpc_ros.evaluation.loop import MethodSpec, run
    from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
    from t3mpc_ros.evaluation.scenario import Scenario

    Controller(StepperControllerParameters()).warm_up()
    for robot in PLANTS:
        spec = MethodSpec('full', ProposedController, ProposedParameters())
        run(Scenario(robot, NOMINAL, 1, 1.0), spec)
