# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag animate``: frames, range rays and refusals."""

from dataclasses import replace
import math
from pathlib import Path

import numpy as np
from PIL import Image
import pytest

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.bag import main
from t3mpc_ros.evaluation.bag_report import animation
from t3mpc_ros.evaluation.bag_report.animation import (
    AnimationOptions,
    RangeReadings,
    animate_bag,
)
from t3mpc_ros.evaluation.bag_report.run_data import load_run

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


@pytest.mark.slow
@pytest.mark.parametrize('measured', ['odom', 'ground_truth/odom'])
def test_the_panels_show_the_quantities_of_their_titles(measured, tmp_path, monkeypatch):
    with open_bag(GOLDEN) as recording:
        run = load_run(recording)
    motions = {**run.motions, measured: run.motions['odom']}
    if measured != 'odom':
        del motions['odom']
    receipts = {**run.receipts, measured: run.receipts['odom']}
    run = replace(run, motions=motions, receipts=receipts)
    monkeypatch.setattr(animation, 'load_run', lambda *_: run)
    figures = []

    class Kept(animation.Figure):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            figures.append(self)

    monkeypatch.setattr(animation, 'Figure', Kept)
    options = AnimationOptions(start=4.0, duration=2.0, rate=2.0, width=300)
    animate_bag(GOLDEN, tmp_path / 'x.gif', options)
    floor, *panels = figures[-1].axes
    source = 'ground truth' if 'truth' in measured else 'odometry'
    assert floor.get_legend().get_texts()[0].get_text() == f'robot ({source})'
    motion, reference = motions[measured], motions['reference']
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
        wanted = np.interp(time, reference.time, reference[wheel])
        assert values == pytest.approx(np.interp(time, motion.time, motion[wheel]) - wanted)


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
        (['--output', 'run.gif', '--rate', '0'], 'rate must be above 0'),
    ],
)
def test_what_cannot_be_animated_is_refused(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['animate', str(GOLDEN), *words]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_options_name_what_is_out_of_bounds():
    with pytest.raises(ValueError, match='width must be from 200 to 4000 pixels: got 50'):
        AnimationOptions(width=50)
