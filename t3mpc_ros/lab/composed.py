# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Our own controller behind the interface of its rivals: the same objects that the node runs."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.composition import CompositionSettings
from t3mpc_ros.control.pursuit import Pursuit
from t3mpc_ros.lab.rivals.rival import Knowledge, Rival, View
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.settings import Settings, setting

Array = NDArray[np.float64]

JUMP = 0.3
"""A change of r in one period (rad/s), beyond its slope, that is taken as a switch."""


@dataclass(frozen=True)
class ComposedSettings(CompositionSettings):
    """The controller's settings, and what a study may change about its predictor."""

    random_predictor: bool = setting(
        False,
        'replace what the predictor was taught by random output weights, and let it not learn: '
        'to show what the teaching is worth',
    )


@lru_cache(maxsize=8)
def _untouched(settings: ComposedSettings, drive: str) -> Pursuit:
    """Return a controller to be copied: teaching its predictor takes a tenth of a second."""
    return Pursuit(settings, drive)


class Composed(Rival):
    """The law of :mod:`t3mpc_ros.control`, with its plan across switches."""

    settings_type = ComposedSettings

    def __init__(self, settings: Settings, knowledge: Knowledge) -> None:
        if not isinstance(settings, ComposedSettings):
            raise ValueError(f'settings must be ComposedSettings: got {type(settings).__name__}')
        self.preview: bool = settings.switches.preview  # type: ignore[misc]
        self._period = knowledge.period
        self._period_ns = round(knowledge.period * NANOSECONDS)
        self._pursuit = deepcopy(_untouched(settings, knowledge.drive))
        self._random = settings.predictive.seed if settings.random_predictor else None
        if self._random is not None:
            self._forget(self._random)
        self._steps = 0
        self._expected: Array = np.zeros(2)
        self._slope: Array = np.zeros(2)
        self.terms = self._pursuit.law.terms
        """The law's terms of the last step, rows as in ``law.TERMS``, rad/s², shape (5, 2)."""

    @property
    def skill(self) -> Array:
        """Skill of the predictor in the middle of its horizon, shape (2,)."""
        return self._pursuit.law.predictive.skill

    def learnt(self) -> dict[str, Array]:
        """Return fuzzy coefficients and predictor weights, as a model file keeps them."""
        return self._pursuit.law.learnt()

    def restore(self, learnt: Mapping[str, Array]) -> None:
        """Begin with another run's; random output weights stay random."""
        self._pursuit.law.restore(learnt)
        if self._random is not None:
            self._forget(self._random)

    def step(self, view: View) -> Array:
        """Return u (rad/s²) of (66)-(67) on the reference with its switches crossed."""
        now_ns = self._steps * self._period_ns
        if self._steps == 0:
            self._pursuit.begin(now_ns, view.speeds, view.wanted)
            if view.future is not None:
                for j in range(1, len(view.future) - 1):
                    self._look(now_ns + j * self._period_ns, view.future, j)
        elif view.future is None:
            self._notice(now_ns, view)
        else:
            j = len(view.future) - 2
            self._look(now_ns + j * self._period_ns, view.future, j)
        self._expected = view.wanted_next.copy()
        self._slope = (view.wanted_next - view.wanted) / self._period
        self._steps += 1
        return self._pursuit.step(now_ns, view.speeds, view.wanted, view.wanted_next, self._period)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of the u that the drive's limits let through."""
        self._pursuit.applied(acceleration, limited=limited)

    def _look(self, instant_ns: int, future: Array, j: int) -> None:
        """Announce a jump at row j of the future, seen by the rows around it."""
        for i in range(2):
            here, was = float(future[j, i]), float(future[j - 1, i])
            slope = was - float(future[j - 2, i]) if j > 1 else 0.0
            if abs(here - was - slope) > JUMP and abs(slope) <= JUMP:
                break
        else:
            return
        before = future[j - 1] - future[j - 2] if j > 1 else np.zeros(2)
        if np.max(np.abs(before)) <= JUMP:
            jump = future[j] - future[j - 1] - before
            after = (future[j + 1] - future[j]) / self._period
            self._pursuit.plan.announce(instant_ns, jump, after)

    def _notice(self, now_ns: int, view: View) -> None:
        """Announce a jump that has just happened."""
        jump = view.wanted - self._expected
        if np.max(np.abs(jump)) > JUMP:
            slope = (view.wanted_next - view.wanted) / self._period
            self._pursuit.plan.announce(now_ns, jump, slope)

    def _forget(self, seed: int) -> None:
        """Give the predictor random output weights of the size of the taught ones."""
        predictive = self._pursuit.law.predictive
        weights = predictive.weights()
        generator = np.random.default_rng((seed, 7))
        for name in ('output_weights', 'anchor'):
            taught = weights[name]
            size = float(np.sqrt(np.mean(taught**2)))
            weights[name] = generator.normal(scale=size, size=taught.shape)
        predictive.set_weights(weights)
