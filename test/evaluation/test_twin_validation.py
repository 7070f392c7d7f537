# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc twin``: courses under slip, parts against their sheets, and the command."""

from dataclasses import replace
import math

import matplotlib.image
import numpy as np
import pytest

from t3mpc_ros.cli import main
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.plotting import WIDTH
from t3mpc_ros.evaluation.twin_validation import component_tests, courses
from t3mpc_ros.evaluation.twin_validation.validation_page import VALIDATION_FIGURES
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.sensors.range_sensor import SimulatedRangeSensorParameters

pytestmark = pytest.mark.slow

SEEDS = (1, 2, 3, 4)
GRIPS = courses.SLIPS[:3]
MIDDLE, STRONG, HELD = courses.SLIPS[1], courses.SLIPS[2], courses.SLIPS[5]
SQUARES = ('square ccw', 'square cw')


@pytest.fixture(scope='module')
def slipped():
    """Every course under lost grip in three strengths, four robots each."""
    return courses.measure_drifts(SEEDS, GRIPS)


def check_a_fifth(members, at_least):
    """Check the root mean square: single runs drift little when spells miss every start and stop.

    ``at_least`` (rad) is what the steps drift by, or there would be nothing to help against.
    """
    steps = rms([item.steps for item in members])
    assert steps > at_least
    assert rms([item.fused for item in members]) <= steps / 5.0


@pytest.mark.long
@pytest.mark.parametrize('slip', GRIPS, ids=lambda slip: slip.name)
def test_gyro_cuts_square_drift_to_a_fifth_at_any_slip(slipped, slip):
    chosen = [item for item in slipped if item.course in SQUARES and item.slip == slip.name]
    assert len(chosen) == 8
    check_a_fifth(chosen, math.radians(10.0))


@pytest.mark.long
@pytest.mark.parametrize('course', SQUARES)
def test_gyro_cuts_square_drift_to_a_fifth_both_ways(slipped, course):
    chosen = [item for item in slipped if item.course == course]
    assert len(chosen) == 12
    check_a_fifth(chosen, math.radians(10.0))
    strong = [item for item in chosen if abs(item.steps) > math.radians(25.0)]
    assert len(strong) >= 3
    assert all(item.holds for item in strong)


@pytest.mark.long
def test_the_gyro_leaves_a_fifth_of_the_drift_of_ten_turns(slipped):
    chosen = [item for item in slipped if item.course == '10 turns']
    check_a_fifth(chosen, math.radians(60.0))
    check_a_fifth(courses.select_drifts(chosen, '10 turns', STRONG.name), math.radians(60.0))
    strong = [item for item in chosen if abs(item.steps) > 5.0 * item.limit]
    assert len(strong) >= 3
    assert all(item.holds for item in strong)


@pytest.mark.long
def test_gyro_drift_stays_within_its_own_error_bound(slipped):
    """Scale and bias bound it, so a fifth is certain once steps drift by five times as much."""
    for item in slipped:
        assert abs(item.fused) <= 1.5 * item.limit, item
    assert courses.holds_from(slipped) < 7.5 * max(item.limit for item in slipped)


def test_a_held_wheel_loses_steps_the_gyro_measures_the_turn():
    (found,) = courses.measure_drifts((1,), (HELD,), courses=('square ccw',))
    assert found.lost > 100
    assert abs(found.steps) > math.radians(30.0)
    assert abs(found.fused) <= abs(found.steps) / 5.0
    assert found.fused_place < 0.2 * found.steps_place


@pytest.mark.parametrize('course', list(courses.COURSES))
def test_without_slip_both_headings_are_good(course):
    (found,) = courses.measure_drifts((1,), (courses.NO_SLIP,), courses=(course,))
    assert abs(found.steps) < math.radians(4.0)
    assert abs(found.fused) <= found.limit
    assert found.lost == 0
    assert found.detected == 0.0


def test_odometry_without_gyro_equals_the_step_odometry():
    parameters = courses.robot(1)
    blind = parameters.with_values({'odometry.use_gyro': False})
    slip_events = courses.slip_events('10 turns', STRONG, 1)
    with_gyro, without = (courses.spin(table, 2, slip_events) for table in (parameters, blind))
    np.testing.assert_array_equal(with_gyro.truth, without.truth)
    np.testing.assert_allclose(without.odometry, without.steps, atol=1e-9)
    np.testing.assert_allclose(without.steps, with_gyro.steps, atol=1e-12)
    assert courses.yaw_drift(without) == pytest.approx(courses.yaw_drift(with_gyro, by_steps=True))


@pytest.mark.parametrize('clockwise', [False, True])
def test_a_square_is_one_to_the_steps_even_while_wheels_slip(clockwise):
    """It is driven by counting: what the floor makes of it does not show in the counters."""
    slip_events = courses.slip_events('square cw', STRONG, 2)
    course = courses.umbmark(courses.robot(2), clockwise, slip_events, side=0.5)
    sign = -1.0 if clockwise else 1.0
    assert course.steps[-1, :2] == pytest.approx([0.0, 0.0], abs=5e-3)
    assert course.steps[-1, 2] == pytest.approx(sign * math.tau, abs=1e-3)
    corners = [(0.5, 0.0), (0.5, sign * 0.5), (0.0, sign * 0.5)]
    for corner in corners:
        assert np.min(np.hypot(*(course.steps[:, :2] - corner).T)) < 5e-3
    assert np.all(course.time[1:] > course.time[:-1])


def test_an_impossible_course_is_rejected():
    stuck = courses.robot(1).with_values({'wheel.max_velocity': 0.0})
    with pytest.raises(RuntimeError, match=r'leg 1 did not end within .* rad to go'):
        courses.spin(stuck, 1)


def test_slip_events_depend_on_their_seed_without_overlap():
    shown = courses.slip_events('10 turns', MIDDLE, 1)
    assert shown == courses.slip_events('10 turns', MIDDLE, 1)
    assert shown != courses.slip_events('10 turns', MIDDLE, 2)
    assert shown != courses.slip_events('square cw', MIDDLE, 1)
    assert {event.value for event in shown} == {0.1}
    assert shown[0].at > courses.STANDING
    for event, following in zip(shown, shown[1:], strict=False):
        assert event.until < following.at
    assert {event.value for event in courses.slip_events('10 turns', HELD, 1)} == {
        'right',
        'left',
    }


def test_same_seed_same_table():
    first, again, other = (
        courses.drift_table(courses.measure_drifts((seed,), (MIDDLE,), courses=('10 turns',)))
        for seed in (4, 4, 5)
    )
    assert first == again
    assert first != other


def test_the_ceiling_is_v_over_2_l_i_steps_a_second():
    """12 V, 2.8 mH, 1.7 A: 6.3 turns a second."""
    parameters = DigitalTwinParameters()
    curve = component_tests.torque_curve(parameters.motor, 12.0, 1.7, 140.0)
    assert curve.ceiling / math.tau == pytest.approx(6.30, abs=0.01)
    at_work = np.interp(parameters.limiter.wheel_speed, curve.speed, curve.torque)
    assert at_work > component_tests.needed_torque(parameters)


def test_a_ramp_beyond_the_torque_loses_pitches_unnoticed():
    parameters = DigitalTwinParameters()
    limit = component_tests.breaking_acceleration(parameters)
    within, beyond = (component_tests.ramp(parameters, part * limit, 10.0) for part in (0.5, 1.5))
    assert within.lost_steps == (0, 0)
    assert within.counted_distance[-1] == pytest.approx(within.driven[-1], abs=1e-3)
    assert np.abs(within.behind).max() < 1.0
    assert beyond.lost_steps[0] >= 4
    assert beyond.lost_steps[0] % 4 == 0
    way = 0.035 * math.tau * beyond.lost_steps[0] / 200.0
    assert beyond.counted_distance[-1] - beyond.driven[-1] == pytest.approx(way, abs=1e-3)


def test_distance_sensor_matches_its_sheet_wrong_if_too_near():
    assert component_tests.sharp_deviation() < 0.025
    readings = component_tests.sharp_readings(
        SimulatedRangeSensorParameters(), np.array([0.0, 0.03, 0.06, 0.4]), seed=1
    )
    assert np.isposinf(readings[0]).all()
    np.testing.assert_allclose(readings[1], 0.13, atol=0.02)
    assert np.isneginf(readings[2]).all()
    np.testing.assert_allclose(readings[3], 0.4, atol=0.03)


@pytest.mark.parametrize('setting', range(7))
def test_low_pass_cutoff_matches_the_data_sheet(setting):
    response = component_tests.low_pass_response(setting)
    assert response.cutoff == pytest.approx(component_tests.GYRO_SHEET[setting][0], rel=0.01)
    if setting == 3:
        assert response.delay == pytest.approx(4.8, rel=0.03)


def test_allan_deviation_finds_the_two_noises_of_a_made_up_gyro():
    generator = np.random.default_rng(1)
    white = 0.01 * math.sqrt(50.0) * generator.standard_normal(50_000)
    found = component_tests.allan_deviation(white, 100.0)
    at = np.searchsorted(found.span, 0.5)
    assert found.deviation[at] == pytest.approx(0.01 / math.sqrt(2.0 * found.span[at]), rel=0.05)
    walk = np.cumsum(0.02 * 0.1 * generator.standard_normal(50_000))
    found = component_tests.allan_deviation(walk, 100.0)
    expected = 0.02 * math.sqrt(found.span[at] / 3.0)
    assert found.deviation[at] == pytest.approx(expected, rel=0.1)


def test_the_standing_gyro_has_the_noise_of_the_data_sheet():
    """Noise above 50 Hz folds in at 100 samples a second: a tenth more than the sheet's."""
    parameters = DigitalTwinParameters().imu
    found = component_tests.allan_deviation(
        component_tests.stationary_gyro(parameters, 100.0, 100.0, 1), 100.0
    )
    at = np.searchsorted(found.span, 0.1)
    density = found.deviation[at] * math.sqrt(2.0 * found.span[at])
    assert density == pytest.approx(parameters.gyro_noise, rel=0.2)


def test_a_blind_robot_hits_the_wall_its_odometry_passes_it():
    parameters = DigitalTwinParameters.from_dict({'seed': 1, 'world': 'room'})
    patrol = courses.patrol(parameters, 7.5, 30.0)
    blind = patrol.course.time > 7.5
    assert not patrol.touched_before
    assert np.isnan(patrol.ranges[blind]).all()
    assert np.isfinite(patrol.ranges[~blind]).any()
    assert patrol.hit_at > 7.5
    assert patrol.max_contact_force > 5.0
    assert np.abs(patrol.course.truth[:, 0]).max() < 2.0 - 0.1
    assert patrol.course.odometry[-1, 0] > patrol.course.truth[-1, 0] + 0.1


def test_the_command_draws_every_picture_and_prints_the_table(tmp_path, capsys, monkeypatch):
    short = {
        'square ccw': lambda parameters, events: courses.umbmark(parameters, False, events, 0.5),
        'square cw': lambda parameters, events: courses.umbmark(parameters, True, events, 0.5),
        '10 turns': lambda parameters, events: courses.spin(parameters, 2, events),
    }
    for name, drive in short.items():
        monkeypatch.setitem(
            courses.COURSES,
            name,
            lambda parameters, events, drive=drive, name=name: replace(
                drive(parameters, events), name=name
            ),
        )
    assert main.main(['twin', '--quick', '--seed', '7', '--output', str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert '| 10 turns | wheel held every 7.5 s |' in said.out
    assert str(tmp_path / 'twin.html') in said.out
    assert '9/9 [' in said.err
    for drawing in VALIDATION_FIGURES:
        picture = matplotlib.image.imread(tmp_path / f'{drawing.stem}.png')
        height, width = picture.shape[:2]
        assert width == round(150 * WIDTH)
        assert 400 < height < 1100
        grey = picture[..., :3].mean(axis=2)
        assert 0.01 < float((grey < 0.9).mean()) < 0.6, drawing.stem
    page = (tmp_path / 'twin.html').read_text()
    assert page.count('data:image/png;base64,') == len(VALIDATION_FIGURES)
    assert page.index('<img') < page.index('<nav') < page.index('<table>')


def test_a_seed_that_is_none_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(['twin', '--seed', '-1'])
    assert ended.value.code == 2
    assert 'must be from 0' in capsys.readouterr().err
