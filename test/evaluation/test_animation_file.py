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
"""``bag animate``: frames, range rays and refusals."""

from dataclasses import replace
import math
from pathlib import Path

from matplotlib.colors import to_hex
import numpy as np
from PIL import Image
import pytest
from support.long_tests import few_of

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.bag import main
from t3mpc_ros.evaluation.bag_report import animation_file
from t3mpc_ros.evaluation.bag_report.animation_file import (
    AnimationOptions,
    RangeReadings,
    animate_bag,
)
from t3mpc_ros.evaluation.bag_report.recorded_run import Series, load_run
from t3mpc_ros.evaluation.bag_report.tracking_errors import tracking_error
from t3mpc_ros.evaluation.topic_roles import ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.simulation.world import World

GOLDEN = Path(__file__).parents[1] / 'golden' / 'switches.mcap'


@pytest.mark.slow
def test_an_animation_has_its_frames_rate_and_size(tmp_path, capsys):
    output = tmp_path / 'new' / 'run.gif'
    words = ['--start', '4', '--duration', '2', '--rate', '5', '--speed', '0.5', '--width', '300']
    assert main(['animate', str(GOLDEN), '--output', str(output), *words]) == 0
    assert str(output) in capsys.readouterr().out
    with Image.open(output) as film:
        assert film.n_frames == 21
        assert film.info['duration'] == 200
        assert film.info['loop'] == 0  # for ever
        assert film.size[0] == 300
        first = np.asarray(film.convert('RGB')).astype(int)
        film.seek(20)
        last = np.asarray(film.convert('RGB')).astype(int)
    changed = np.abs(last - first).max(axis=2) > 60
    assert changed[:, :150].any()  # the robot on the floor
    assert changed[:, 170:].any()  # the speeds
    assert changed.mean() < 0.2
    assert tuple(first[0, 0]) == (255, 255, 255)


@pytest.fixture
def figures(monkeypatch):
    """Return the figures that are made for animations, as a list that grows."""
    made = []

    class Kept(animation_file.Figure):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            made.append(self)

    monkeypatch.setattr(animation_file, 'Figure', Kept)
    return made


@pytest.mark.slow
def test_the_panels_show_the_quantities_of_their_titles(figures, tmp_path, monkeypatch):
    with open_bag(GOLDEN) as recording:
        run = load_run(recording)
    motions = {REFERENCE: run.motions[REFERENCE], TRUTH: run.motions[ODOMETRY]}
    run = replace(run, motions=motions, receipts={TRUTH: run.receipts[ODOMETRY]})
    monkeypatch.setattr(animation_file, 'load_run', lambda *_: run)
    options = AnimationOptions(start=4.0, duration=2.0, rate=2.0, width=300)
    animate_bag(GOLDEN, tmp_path / 'x.gif', options)
    floor, *panels = figures[-1].axes
    assert floor.get_legend().get_texts()[0].get_text() == 'robot (ground truth)'
    motion, reference = motions[TRUTH], motions[REFERENCE]
    wrong = tracking_error(run, TRUTH)
    shown = {(axis.get_title(loc='left') or axis.get_title()): axis.lines for axis in panels}
    errors = shown.pop('errors / (rad/s)')
    assert [*shown] == ['right wheel / (rad/s)', 'left wheel / (rad/s)']
    for error, (title, lines) in zip(errors[:2], shown.items(), strict=True):
        wheel = title.split()[0]
        for line, series in zip(lines[:2], (motion, reference), strict=True):
            time, values = line.get_data()
            assert values == pytest.approx(np.interp(time, series.time, series[wheel]))
            assert len(time) > 50
        time, values = error.get_data()
        assert values == pytest.approx(np.interp(time, wrong.time, wrong[wheel]))


@pytest.mark.slow
@pytest.mark.parametrize('follows', few_of([True, False]))
def test_the_floor_shows_the_robot_its_way_and_what_it_sees(
    follows, figures, tmp_path, monkeypatch
):
    """Where it is at the last frame, with the path to follow up to then, or that ahead of it."""
    time = np.arange(0.0, 6.0, 0.05)
    pose = {'x': 0.2 * time - 0.5, 'y': 0.1 * time**1.5, 'yaw': 0.3 * time - 1.0}
    speeds = dict.fromkeys(('linear', 'angular', 'right', 'left'), np.full(time.size, 0.2))
    wanted = {**speeds, 'x': pose['x'] + 0.3, 'y': pose['y'] - 0.4}
    wanted['angular'] = -0.5 - 0.1 * time
    with open_bag(GOLDEN) as recording:
        run = load_run(recording)
    run = replace(
        run,
        motions={ODOMETRY: Series(time, {**pose, **speeds}), REFERENCE: Series(time, wanted)},
        receipts={ODOMETRY: time, REFERENCE: time},
        follows_path=follows,
    )
    mounts = np.array([[0.1, 0.05, 0.0], [0.0, -0.1, -math.pi / 2]])
    ranges = RangeReadings((time, time), (1.0 + 0.1 * time, 0.5 + 0.05 * time), mounts)
    world = World(
        'odd', np.array([[-1.0, -0.5, 2.0, -0.6]]), np.array([[1.5, 1.5, 0.2]]), np.empty((0, 4)),
        np.empty((0, 5)),
    )  # fmt: skip
    monkeypatch.setattr(animation_file, 'load_run', lambda *_: run)
    monkeypatch.setattr(animation_file, 'read_ranges', lambda *_: ranges)
    monkeypatch.setattr(animation_file, 'recorded_world', lambda *_: world)
    chosen = AnimationOptions(start=1.0, duration=2.0, rate=1.0, width=200)
    animate_bag(GOLDEN, tmp_path / 'x.gif', chosen)
    floor = figures[-1].axes[0]
    line, trail, hits, nose = (each.get_xydata() for each in floor.lines)
    at = np.array([np.interp(3.0, time, pose[each]) for each in ('x', 'y', 'yaw')])
    driven = (time > 1.0 - 1e-9) & (time < 3.0 - 1e-9)
    way = np.column_stack([pose['x'], pose['y']])[driven]
    assert trail == pytest.approx(np.vstack([way, at[:2]]))
    walls, rays = floor.collections
    pillar, body = floor.patches
    assert body.center == pytest.approx(at[:2])
    assert nose == pytest.approx(
        np.array([at[:2], at[:2] + 0.1 * np.array((math.cos(at[2]), math.sin(at[2])))])
    )
    assert np.array(rays.get_segments()) == pytest.approx(ranges.rays(3.0, (*at,)))
    seen = [
        ranges.rays(now, tuple(np.interp(now, time, pose[each]) for each in ('x', 'y', 'yaw')))
        for now in (1.0, 2.0, 3.0)
    ]
    assert hits == pytest.approx(np.vstack(seen)[:, 1])
    if follows:
        assert line == pytest.approx(np.column_stack([wanted['x'], wanted['y']])[driven])
    else:
        # From the robot, as far as the wanted speeds lead, turning right.
        assert len(line) == pytest.approx(animation_file.AHEAD / 0.05, abs=1)
        assert line[0] == pytest.approx(at[:2])
        steps = np.diff(line, axis=0)
        turns = -0.05 * (0.8 + 0.1 * 0.05 * np.arange(len(steps)))
        assert np.hypot(*steps.T) == pytest.approx(0.01 * np.sinc(turns / math.tau))  # of arcs
        courses = np.arctan2(steps[:, 1], steps[:, 0])
        assert np.diff(courses) == pytest.approx(turns[:-1], abs=0.001)
        assert courses[0] == pytest.approx(at[2], abs=0.1)
    assert walls.get_segments()[0] == pytest.approx(world.segments.reshape(2, 2))
    assert (*pillar.center, pillar.radius) == (1.5, 1.5, 0.2)
    assert (floor.get_xlim(), floor.get_ylim()) == (
        pytest.approx((-1.2, 2.2)),
        pytest.approx((-0.8, way[:, 1].max() + 0.2), abs=0.02),
    )
    shown = [
        (text.get_text(), each.get_color())
        for text, each in zip(
            floor.get_legend().get_texts(), floor.get_legend().get_lines(), strict=True
        )
    ]
    ahead = 'reference' if follows else 'reference, next 1.5 s'
    assert [text for text, _ in shown] == ['robot (odometry)', ahead, 'range sensors']
    drawn = [floor.lines[1].get_color(), floor.lines[0].get_color()]
    assert [colour for _, colour in shown[:2]] == drawn
    assert to_hex(rays.get_color()[0]) == shown[2][1]


def test_rays_start_at_the_sensors_and_end_at_the_readings():
    """A sensor without a reading, with nothing in range, or with an old reading has no ray."""
    mounts = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, math.pi / 2], [-0.1, 0.0, math.pi]])
    times = tuple(np.array(each) for each in ([1.0, 2.0], [2.0], [1.0]))
    distances = tuple(np.array(each) for each in ([9.0, 0.5], [math.inf], [0.3]))
    readings = RangeReadings(times, distances, mounts)
    rays = readings.rays(2.05, (1.0, 2.0, math.pi / 2))
    assert rays == pytest.approx(np.array([[[1.0, 2.1], [1.0, 2.6]]]))
    assert readings.rays(0.5, (0.0, 0.0, 0.0)).shape == (0, 2, 2)


@pytest.mark.parametrize(
    'words, message',
    [
        (['--output', 'run.mp4'], 'output must end in .gif: got run.mp4'),
        (['--output', 'run.gif', '--start', '1e4'], 'start must be before the last pose'),
    ],
)
def test_what_cannot_be_animated_is_refused(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['animate', str(GOLDEN), *words]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_size_out_of_bounds_is_a_wrong_command_line(capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['animate', str(GOLDEN), '--output', 'run.gif', '--width', '50'])
    assert '--width: must be from 200 to 4000: got 50' in capsys.readouterr().err
