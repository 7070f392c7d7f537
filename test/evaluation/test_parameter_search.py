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
"""No permitted value of a dynamic parameter makes the controller much worse than feed-forward.

``bench/parameter_search.py`` looks at thousands of points; here are a few of them.
"""

import numpy as np
import pytest

from bench import parameter_search
from bench.parameter_search import SPECS, judge, points, random_point, reduced, values_of
from t3mpc_ros.control.controller import StepperControllerParameters

pytestmark = pytest.mark.compiled
BODY = {'composition': 'body'}


def test_values_that_destabilised_are_refused_or_harmless(monkeypatch):
    """Gains below the one that fits had 16 times the error, and a yaw gain of 20 had 100 times."""
    monkeypatch.setattr(parameter_search, 'DURATION', 8.0)
    assert 'law.gain must be from 77.2 to 115' in judge({**BODY, 'law.gain': 10.0}).refused
    slow = judge({'jump_transition.acceleration': 0.1})  # never arrived at the reference
    assert 'jump_transition.acceleration must be from 1 to 10000 rad/s²' in slow.refused
    assert 'body.yaw_gain must be from 0 to 1' in judge({'body.yaw_gain': 20.0}).refused
    allowed = {**BODY, 'law.gain': 78.0, 'body.yaw_gain': 1.0, 'body.max_yaw_correction': 10.0}
    worst = judge(allowed)
    assert not worst.bad
    assert worst.ratio > 0.1
    # The exact robot needs no correction of the body; with wrong radii and track these values act.
    wrong_body = judge(allowed, 'radii and track')
    assert 0.1 < wrong_body.ratio < 0.9


@pytest.mark.long
def test_a_point_that_is_bad_is_found_and_reduced(monkeypatch):
    monkeypatch.setattr(parameter_search, 'DURATION', 8.0)
    point = {'composition': 'paper', 'law.gain': 1.0, 'body.yaw_gain': 0.5, 'use_fuzzy': True}
    bad = judge(point)
    assert bad.bad
    assert reduced(bad, {'composition': 'paper'}).point == {
        'composition': 'paper',
        'law.gain': 1.0,
    }


def test_the_search_covers_all_dynamic_values_up_to_the_bounds():
    dynamic = {spec.name for spec in StepperControllerParameters.specs() if spec.dynamic}
    alone = list(points(BODY, 1000, 1))[: sum(len(values_of(spec)) for spec in SPECS)]
    assert {name for point in alone for name in point} - {*BODY} == dynamic
    for spec in SPECS:
        if spec.kind is not bool:
            values = values_of(spec)
            assert (values[0], values[-1]) == pytest.approx((spec.low, spec.high))
    drawn = [random_point(np.random.default_rng(k), BODY) for k in range(200)]
    assert {name for point in drawn for name in point} - {*BODY} == dynamic
    for point in drawn:
        for spec in SPECS:
            spec.check(point.get(spec.name, spec.default))
