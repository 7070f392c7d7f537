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
"""Noise of a script: a law of one's own for the measured wheel speeds."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import math
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.evaluation.api.one_sentence_errors import described, one_sentence
from t3mpc_ros.geometry.types import Array, WheelSpeeds, read_only
from t3mpc_ros.script_error import ScriptError


@dataclass(frozen=True)
class NoiseLaw:
    """Noise of the measured wheel speeds by a law of one's own.

    Parameters
    ----------
    draw
        Gets a generator (:class:`numpy.random.Generator`), the time (s) and the true wheel speeds
        (rad/s, shape (2,)); returns what is added to them, shape (2,).
    variance
        What the estimator of every method assumes, (rad/s)².
    """

    draw: Callable[[np.random.Generator, float, Array], Any]
    variance: float

    @one_sentence
    def __post_init__(self) -> None:
        if not callable(self.draw):
            raise ScriptError(
                f'draw must be a function of generator, time and speeds: got {self.draw!r}'
            )
        if not (isinstance(self.variance, int | float) and 0.0 <= self.variance <= 100.0):
            raise ScriptError(f'variance must be from 0 to 100 (rad/s)²: got {self.variance!r}')

    def simulation(self, seed: int) -> 'LawNoise':
        """Return the noise of a run."""
        return LawNoise(self.draw, np.random.default_rng((seed, 5)))


class LawNoise(NamedTuple):
    """Noise of a run, drawn by a law."""

    draw: Callable[[np.random.Generator, float, Array], Any]
    generator: np.random.Generator

    def measure(self, wheels: WheelSpeeds, time: float) -> WheelSpeeds:
        """Return wheel speeds (rad/s) with noise at a time (s)."""
        time, true = round(time, 9), np.array(wheels)  # a law may compare the time
        try:
            drawn = self.draw(self.generator, time, read_only(true))
            noise = np.asarray(drawn, dtype=np.float64)
        except Exception as error:
            raise ScriptError(
                f'the noise law raised {described(error)}, at {time:.2f} s'
            ) from None
        if noise.shape != (2,) or not np.isfinite(noise).all():
            raise ScriptError(
                f'the noise law must return two finite numbers: got {noise} at {time:.2f} s'
            )
        return WheelSpeeds(*(true + noise).tolist())


def gaussian_noise(variance: float) -> NoiseLaw:
    """Return the law of white noise with a variance in (rad/s)²."""
    return NoiseLaw(partial(_white_noise, math.sqrt(variance)), variance)


def _white_noise(deviation: float, generator: np.random.Generator, *_: object) -> Array:
    return deviation * generator.standard_normal(2)
