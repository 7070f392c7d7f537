#!/usr/bin/env python3
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
"""Search of the dynamic parameters of the controller for values that destabilise the twin.

Usage: parameter_search.py [--points N] [--seed S] [--composition body|paper] [--case CASE]
                           [--workers N]

First every parameter alone at five values from bound to bound, then random points, each with a
third of the parameters at values drawn log-uniformly from their ranges. What the parameters refuse
is counted, all else drives the twin of a case for 10 s beside feed-forward under the same limits
and with the same ramp. A point is bad if its settled error, of wheels or of yaw rate, is more than
``ALLOWED`` times that of feed-forward while the controller tracks. Each bad point is reduced to
the fewest values that make it so; the exit code is 1 if there is one. On the exact robot, which is
the default case, the correction of the body has no authority: only another body, as in ``radii and
track``, shows its parameters. There the yaw rate alone is judged: wheels that turn the body right
differ from the reference of exact wheels.
"""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
import math
from pathlib import Path
import sys

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from t3mpc_ros.control.controller import StepperControllerParameters
from t3mpc_ros.control.velocity_actuation import LimitParameters
from t3mpc_ros.evaluation.baselines.feed_forward import FeedForward
from t3mpc_ros.evaluation.cases import CASES, cases_for
from t3mpc_ros.evaluation.experiment import WorkerPool
from t3mpc_ros.evaluation.loop import MethodSpec, NodeMethod, run
from t3mpc_ros.evaluation.method_table import FEED_FORWARD, feed_forward_parameters
from t3mpc_ros.evaluation.run_record import Numbers, measure
from t3mpc_ros.evaluation.scenario import OwnParts, Scenario
from t3mpc_ros.parameters.table import ParameterError, ParameterSpec, Value

ALLOWED = 1.5  # ratio to the error of feed-forward up to which a point is good
DURATION, SEED = 10.0, 2001
"""Length (s) and seed of every run; the reference has no switch before 12 s."""
LEAST = {'settled': 0.012, 'yaw_rate_settled': 0.0043}
"""Errors (rad/s) below which nothing is worse: means of feed-forward over many seeds. Those of one
seed depend, in so short a run, on where its rotors ring."""
Point = Mapping[str, Value]
LIMITS = tuple(spec.name for spec in LimitParameters.specs())
RAMP = 'jump_transition.acceleration'
SPECS = tuple(spec for spec in StepperControllerParameters.specs() if spec.dynamic)
"""Every dynamic parameter; those of the pose loop act on a path alone."""


@dataclass(frozen=True)
class Judged:
    """What a point does."""

    point: Point
    refused: str = ''
    failed: str = ''
    ratio: float = 0.0  # largest ratio of its errors to those of feed-forward
    stopped: float = 0.0  # time with a reason not to move, s

    @property
    def bad(self) -> bool:
        """Whether it is much worse than feed-forward."""
        return not self.refused and not self.ratio <= ALLOWED

    @property
    def name(self) -> str:
        """Name in errors."""
        return str(dict(self.point))


def values_of(spec: ParameterSpec) -> list[Value]:
    """Return five values from bound to bound, on a logarithmic scale where it spans decades."""
    if spec.kind is bool:
        return [True, False]
    low, high = spec.low or 0.0, spec.high
    assert high is not None
    first = low or 1e-4 * high
    return [low, *np.geomspace(first, high, 5)[1:].tolist()]


def random_point(generator: np.random.Generator, base: Point) -> Point:
    """Return a point in which each parameter differs with a probability of a third."""
    point = dict(base)
    for spec in SPECS:
        chosen, place = generator.random(2).tolist()
        if chosen > 1.0 / 3.0:
            continue
        if spec.kind is bool:
            point[spec.name] = place < 0.5
            continue
        low, high = spec.low or 0.0, spec.high
        assert high is not None
        first = low or 1e-4 * high
        point[spec.name] = float(first * (high / first) ** place)
    return point


def points(base: Point, count: int, seed: int) -> Iterator[Point]:
    """Yield each parameter alone at its values, then random points, ``count`` in all."""
    alone = [{**base, spec.name: value} for spec in SPECS for value in values_of(spec)]
    yield from alone[:count]
    generator = np.random.default_rng(seed)
    for _ in range(count - len(alone)):
        yield random_point(generator, base)


@lru_cache(maxsize=16)
def forward(case: str, limits: LimitParameters, ramp: float) -> Numbers:
    """Return the errors of feed-forward under limits, with a ramp (rad/s²) at switches."""
    parameters = feed_forward_parameters('twin').with_values({RAMP: ramp})
    scenario = Scenario('twin', case, SEED, DURATION, own=OwnParts(limits=limits))
    return measure(run(scenario, MethodSpec(FEED_FORWARD, FeedForward, parameters)))


def judge(point: Point, case: str = 'nominal') -> Judged:
    """Return what a point does."""
    scenario = Scenario('twin', case, SEED, DURATION)
    method = NodeMethod(str(dict(point)), point)
    try:
        parameters = method.parameters_for(scenario)
    except ParameterError as error:
        return Judged(point, refused=str(error))
    try:
        found = measure(run(scenario, method))
    except ValueError as error:  # of the controller, which ends
        return Judged(point, failed=str(error), ratio=math.inf)
    usual = forward(case, parameters.limits, parameters.jump_transition.acceleration)
    judged = ('yaw_rate_settled',) if CASES[case].body else tuple(LEAST)
    ratios = [found[name] / max(usual[name], LEAST[name]) for name in judged]
    ratio = math.inf if any(map(math.isnan, ratios)) else max(ratios)
    return Judged(point, ratio=ratio, stopped=found['stopped'])


def judge_job(job: tuple[Point, Judged], case: str) -> Judged:
    """Return what the point of a job does."""
    return judge(job[0], case)


def reduced(bad: Judged, base: Point, case: str = 'nominal') -> Judged:
    """Return a bad point without the values that it is bad without."""
    for name in list(bad.point):
        if name in base:
            continue
        fewer = judge({key: value for key, value in bad.point.items() if key != name}, case)
        if fewer.bad:
            bad = fewer
    return bad


def main() -> int:
    """Print refusals and bad points; return 1 if there is a bad one."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', maxsplit=1)[0])
    parser.add_argument('--points', type=int, default=2000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--composition', choices=('body', 'paper'), default='body')
    parser.add_argument('--case', choices=cases_for('twin'), default='nominal')
    parser.add_argument('--workers', type=int, default=2)
    chosen = parser.parse_args()
    base = {'composition': chosen.composition}
    jobs = [(point, Judged(point)) for point in points(base, chosen.points, chosen.seed)]
    found = []
    with WorkerPool(chosen.workers) as pool:
        for _, each in pool.map(partial(judge_job, case=chosen.case), jobs):
            found.append(each)
            if each.bad:
                print(text(reduced(each, base, chosen.case), base), flush=True)
    bad = [each for each in found if each.bad]
    refused = sum(bool(each.refused) for each in found)
    worst = max((each.ratio for each in found if not each.bad), default=0.0)
    print(f'{len(found)} points: {refused} refused, {len(bad)} bad, others up to {worst:.2f} x')
    return bool(bad)


def text(judged: Judged, base: Point) -> str:
    """Return a bad point in a line."""
    values = {name: value for name, value in judged.point.items() if name not in base}
    return f'{judged.ratio:10.3g} x, stopped {judged.stopped:.1f} s: {values} {judged.failed}'


if __name__ == '__main__':
    sys.exit(main())
