# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Replay of a run whose recorder has discovered odometry and reference late."""

from pathlib import Path

import numpy as np
import pytest
from support.bag_files import copied_bag

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
from t3mpc_ros.evaluation.process_replay.controller_replay import replay_controller
from t3mpc_ros.evaluation.process_replay.replay_comparison import ELSEWHERE, Tolerances, compare
from t3mpc_ros.evaluation.topic_roles import ReportOptions, choose_topics, find_topics

GOLDEN = Path(__file__).parents[1] / 'golden' / 'switches.mcap'
INPUTS = ('reference', 'odom')
LATE = 1_000_000_000
"""Time of discovery after the first message, ns."""


@pytest.fixture(scope='module')
def complete():
    return load_inputs(GOLDEN)


def record_late(folder, lost, republished):
    """Copy the golden bag as a late recorder writes it.

    Parameters
    ----------
    folder
        Folder of the copy.
    lost
        Number of first messages of each input that the recorder did not receive.
    republished
        Number of first messages of each input that the controller has republished.
    """

    def late(topic, k, received, published):
        is_input = topic.strip('/') in INPUTS
        if is_input and k < republished:
            initial = f'/controller/initial_inputs{topic}'
            yield initial, received + LATE, published + 1000
        if not is_input or k >= lost:
            yield topic, received, published

    return copied_bag(GOLDEN, folder, late)


def same_columns(one, other):
    return np.array_equal(one.stamps_ns, other.stamps_ns) and np.array_equal(
        one.numbers, other.numbers
    )


@pytest.mark.parametrize('lost, republished', [(0, 200), (150, 200), (150, 150)])
@pytest.mark.slow
def test_initial_inputs_complete_a_late_recording(lost, republished, complete, tmp_path):
    inputs = load_inputs(record_late(tmp_path / 'bag', lost, republished))
    assert same_columns(inputs.odometry, complete.odometry)
    assert same_columns(inputs.references, complete.references)
    assert inputs.notes == ()
    assert inputs.exact.all()
    outcome = compare(inputs, replay_controller(inputs), Tolerances(ELSEWHERE, ELSEWHERE))
    assert outcome.same, outcome.table()


def test_without_initial_inputs_a_late_recording_is_not_exact(complete, tmp_path):
    inputs = load_inputs(record_late(tmp_path / 'bag', 150, 0))
    assert not inputs.exact.all()
    assert len(inputs.odometry) == len(complete.odometry) - 150


def test_a_gap_after_the_initial_inputs_is_not_hidden(tmp_path):
    inputs = load_inputs(record_late(tmp_path / 'bag', 150, 100))
    assert not inputs.exact.all()
    assert any('odometry messages' in note for note in inputs.notes)


def test_initial_inputs_are_no_topics_of_a_robot(tmp_path):
    folder = record_late(tmp_path / 'bag', 0, 10)
    with open_bag(folder) as recording:
        assert '/controller/initial_inputs/odom' in recording.topics
        assert find_topics(recording.topics)[1] == ('',)
        choice = choose_topics(recording, ReportOptions())
    assert choice.topics['odom'] == '/odom'
    assert not any('initial_inputs' in note for note in choice.notes)
