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
"""Environments of Gymnasium: importing this module registers ``t3mpc_ros/Tracking-v0``.

``gymnasium.make('t3mpc_ros.gym:t3mpc_ros/Tracking-v0')`` imports it by itself. A policy is a
controller for ``t3mpc_ros.compare`` whose ``step`` returns ``accelerations_of`` its action for the
``vector_of`` an observation.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.evaluation.api.own_robot import NoiseLaw
from t3mpc_ros.evaluation.api.script_inputs import Controller, OwnMethod, own_scenario
from t3mpc_ros.evaluation.baselines.baseline_controller import Observation
from t3mpc_ros.evaluation.cases import LinkFaults
from t3mpc_ros.evaluation.loop import MethodDriver, scenario_reports, with_scenario
from t3mpc_ros.evaluation.run_record import RATE, Record, measure
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.missing_library import remedy
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_schedule import FaultSchedule

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(remedy(error) or str(error), name=error.name) from error

__all__ = ['TrackingEnv', 'accelerations_of', 'vector_of']
Vector = NDArray[np.float32]

ACCELERATION = 60.0
"""Acceleration that an action of 1 asks for, rad/s²; the limits of the robot cut more."""
SPEED = 10.0
"""Wheel speed that is 1 in an observation, rad/s."""
AHEAD = (1, 5, 10, 20, 40)
"""Periods by which the previewed reference is ahead."""
LARGEST = 10.0
"""Entries of an observation are cut here."""
SIZE = 2 * (4 + len(AHEAD)) + 1
ROUGHNESS = 0.001
"""Weight of the squared change of the action beside the squared error in the reward."""
FIRST_SEED = 100_000
"""Episodes without a seed draw theirs from here on: no table of the package has such ones."""


def vector_of(observation: Observation) -> Vector:
    """Return what a policy sees of an observation, shape (19,), about -1 to 1, cut at 10.

    A controller of one's own that uses a policy calls it, and has ``preview = True``. Entries, the
    right wheel first:

    - 0, 1: estimated speed less the reference, rad/s
    - 2, 3: reference over 10 rad/s
    - 4, 5: last commanded wheel speed over 10 rad/s
    - 6, 7: unexplained acceleration over 60 rad/s²
    - 8 to 17: reference 1, 5, 10, 20 and 40 control periods ahead less that of now, over 10 rad/s
    - 18: yaw rate over 8 rad/s, 0 where it is not known
    """
    reference, future = observation.reference, observation.future
    if future is None:
        raise ScriptError('a policy needs preview: set preview = True in its controller')
    ahead = [future[min(k, len(future) - 1)] - reference for k in AHEAD]
    parts = (
        observation.speeds - reference,
        reference / SPEED,
        observation.command / SPEED,
        observation.unexplained / ACCELERATION,
        np.concatenate(ahead) / SPEED,
        [np.nan_to_num(observation.yaw_rate) / 8.0],
    )
    found: Vector = np.clip(np.concatenate(parts), -LARGEST, LARGEST).astype(np.float32)
    return found


def accelerations_of(action: ArrayLike) -> Array:
    """Return the accelerations (rad/s²) of both wheels that the environment makes of an action.

    A controller whose ``step`` returns them has the numbers of the episode, to the last bit, if
    the policy gives the same action to both: one that is rounded to float32 for the environment
    alone is another.
    """
    given = np.asarray(action, dtype=np.float64)
    if given.shape != (2,) or not np.isfinite(given).all():
        raise ScriptError(f'action must be two finite numbers: got {action!r}')
    return ACCELERATION * np.clip(given, -1.0, 1.0)


class _Previewing:
    """Stands for the policy where the loop asks what a method needs."""

    preview = True

    def step(self, observation: Observation) -> Array:
        """Not called: the policy chooses outside of the loop."""
        raise NotImplementedError


class TrackingEnv(gymnasium.Env[Vector, Vector]):
    """Track a reference with two wheels; one step is one control period of 10 ms.

    Action: accelerations of the right and the left wheel over 60 rad/s², shape (2,), from -1 to 1;
    see :func:`accelerations_of`. Observation: :func:`vector_of`. Reward: less the squared error of
    both true wheel speeds, (rad/s)², and 0.001 of the squared change of the action. An episode is
    truncated at its end, where ``info['metrics']`` has the numbers of :func:`t3mpc_ros.compare`,
    and terminated if the robot diverges. Equal seeds and actions give equal episodes, to the last
    bit.

    Parameters
    ----------
    plant, reference, noise, faults, case
        As for :func:`t3mpc_ros.simulate`.
    duration
        Of an episode, s; on the twin with its standstill of 1.5 s, which takes no step.

    Raises
    ------
    ScriptError
        As for :func:`t3mpc_ros.simulate`.
    """

    metadata: dict[str, Any] = {'render_modes': []}

    @one_sentence
    def __init__(
        self,
        plant: Any = 'twin',
        *,
        reference: Any = None,
        noise: float | NoiseLaw = 0.04,
        faults: LinkFaults | FaultSchedule | str | None = None,
        case: str = 'nominal',
        duration: float = 20.0,
        render_mode: None = None,
    ) -> None:
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-LARGEST, LARGEST, (SIZE,), np.float32)
        setting = (plant, reference, noise, faults, duration)
        self._scenario: Callable[[int], Scenario] = lambda seed: own_scenario(
            *setting, case=case, seed=seed
        )
        self._scenario(0)  # wrong use is an error now
        self._episode: _Episode | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Return the first observation of a new episode; ``info['seed']`` is that of its run."""
        super().reset(seed=seed)
        chosen = int(self.np_random.integers(FIRST_SEED, 2**31)) if seed is None else seed
        self._episode = _Episode(self._scenario(chosen))
        return self._episode.observation, {'seed': chosen}

    @one_sentence
    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info of the next period."""
        if self._episode is None or self._episode.record is not None:
            raise ScriptError('an episode must begin with reset(): got step()')
        return self._episode.step(action)


class _Episode:
    """One run, in which a policy chooses the accelerations."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        method = Controller(_Previewing).method(scenario.robot)
        assert isinstance(method, OwnMethod)
        self._driver: MethodDriver = method.driver(scenario)
        self._reports = scenario_reports(scenario, self._driver)
        self._reference = scenario.reference().speeds
        self._before: Array = np.zeros(2)
        self.record: Record | None = None
        """The run, at its end."""
        self._state = next(self._reports)
        self._observe()

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Return what :meth:`TrackingEnv.step` does."""
        accelerations = accelerations_of(action)
        asked = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        self._send(self._driver.command_for(accelerations))
        change, self._before = asked - self._before, asked
        info: dict[str, Any] = {}
        if self.record is not None:
            record = with_scenario(self.record, self._scenario)
            info['metrics'] = dict(measure(record))
            if not record.finite:
                return self.observation, -(SPEED**2), True, False, info
        k = round(self._state.stamp_ns * RATE / NANOSECONDS)
        error = np.subtract(self._state.true_wheels or self._state.wheels, self._reference[k])
        reward = -float(error @ error) - ROUGHNESS * float(change @ change)
        return self.observation, reward, False, self.record is not None, info

    def _send(self, command: RobotCommand) -> None:
        """Send a command, and go on to the next report that a policy gets, or to the end."""
        try:
            self._state = self._reports.send(command)
            self._observe()
        except StopIteration as end:
            self.record = end.value

    def _observe(self) -> None:
        """Skip the reports that a method does not get: at standstill, and repeated ones."""
        while (observation := self._driver.observe(self._state)) is None:
            self._state = self._reports.send(self._driver.unchanged)
        self.observation = vector_of(observation)


gymnasium.register('t3mpc_ros/Tracking-v0', 't3mpc_ros.gym:TrackingEnv')
