# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The closed loop in the paper's setting: bounded, finite, and better with each of its parts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from t3mpc_ros.chaos.reference import ReferenceSettings
from t3mpc_ros.control.controller import ControllerSettings
from t3mpc_ros.lab.ablation import (
    difference,
    interval,
    law_settings,
    mean,
    paper_setting,
    paper_settings,
    table,
)
from t3mpc_ros.lab.closed_loop import run_torque, run_velocity
from t3mpc_ros.robot.simulated import SimulatedRobotSettings


@pytest.fixture(scope='module')
def results():
    return {result.name: result for result in paper_setting(seeds=5, duration=60.0)}


def test_paper_setting_is_bounded_and_finite_over_five_seeds(results):
    for result in results.values():
        assert result.finite, result.name
        assert len(result.rmse) == 5
        # A switch may jump by the whole range of the reference; nothing may go beyond.
        assert result.largest_error < 20.0, result.name


def test_the_run_has_the_papers_noise_and_four_switches():
    reference, robot = paper_settings(0.04, 1)
    run = run_torque(law_settings(0.04, {}), reference, robot, 60.0)
    assert np.count_nonzero(np.diff(run.modes)) == 4
    noise = run.measured - run.speeds
    assert np.var(noise) == pytest.approx(0.04, rel=0.05)
    assert robot.drive.kind == 'torque'


@pytest.mark.parametrize('part', ['NT3FS', 'compensator', 'MPC'])
def test_leaving_out_a_part_costs_accuracy_on_the_same_seeds(part, results):
    more = difference(results[f'without {part}'], results['full'])
    assert mean(more) - interval(more) > 0.0, f'without {part}: {more}'


def test_the_table_names_every_variant_and_its_numbers(results):
    text = table(list(results.values()))
    for result in results.values():
        assert f'| {result.name} | {mean(result.rmse):.4f} ± {interval(result.rmse):.4f} |' in text


def test_the_same_seed_gives_the_same_run_bit_for_bit():
    reference, robot = paper_settings(0.04, 3)
    first, second = (run_torque(law_settings(0.04, {}), reference, robot, 5.0) for _ in range(2))
    np.testing.assert_array_equal(first.speeds, second.speeds)
    np.testing.assert_array_equal(first.command, second.command)


def test_the_loop_as_the_nodes_close_it_tracks_and_keeps_its_limits():
    settings = ControllerSettings.from_flat({'estimate.noise_variance': 0.0})
    run = run_velocity(settings, ReferenceSettings(), SimulatedRobotSettings(), 40.0)
    assert np.isfinite(run.speeds).all()
    assert run.rmse(cut=1.0) < 0.05
    assert np.abs(run.command).max() <= settings.limits.wheel_acceleration * (1 + 1e-9)


def test_different_rates_are_refused():
    reference, robot = paper_settings(0.0, 1)
    with pytest.raises(ValueError, match='rates'):
        run_torque(replace(law_settings(0.0, {}), rate=50.0), reference, robot, 1.0)


def test_the_confidence_interval_is_students():
    values = np.random.default_rng(1).normal(size=7)
    expected = student.ppf(0.975, 6) * values.std(ddof=1) / np.sqrt(7)
    assert interval(values) == pytest.approx(expected, rel=1e-3)
    assert interval([1.0]) == np.inf
