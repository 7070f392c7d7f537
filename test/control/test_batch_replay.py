# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The compiled batch replay equals single steps to the last bit."""

from collections import deque
import copy
import math
from pathlib import Path

import numpy as np
import pytest

from t3mpc_ros.control.batch_replay import StepResults, replay_batch
from t3mpc_ros.control.controller import SNAPSHOT_PERIOD, Controller, ControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.process_replay import controller_replay
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
from t3mpc_ros.evaluation.process_replay.controller_replay import (
    make_controllers,
    replay_controller,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import BodyTwist, Pose, State, StateArray, WheelSpeeds

GOLDEN = sorted((Path(__file__).parents[1] / 'golden').glob('*.mcap'))
STEP = 10_000_000
LEAD = 40
GEOMETRY = WheelGeometry()


def bits(thing):
    """Return the contents of an object; equal results mean equal bits."""
    if isinstance(thing, np.ndarray):
        if thing.dtype == object:
            return [bits(each) for each in thing.tolist()]
        return [str(thing.dtype), thing.shape, thing.tobytes()]
    if isinstance(thing, float):
        return thing.hex()
    if isinstance(thing, dict):
        return {key: bits(value) for key, value in thing.items()}
    if isinstance(thing, (list, tuple, deque)):
        return [bits(each) for each in thing]
    if isinstance(thing, set):
        return sorted(thing)
    if isinstance(thing, np.random.Generator):
        return thing.bit_generator.state
    if type(thing).__module__.startswith('t3mpc_ros') and hasattr(thing, '__dict__'):
        return {name: bits(value) for name, value in vars(thing).items()}
    return thing


def step_by_step(controller, odometry, references, rows, results):
    """Return 0, after the single steps that ``replay_batch`` must reproduce."""
    for k, (received, begin, end) in enumerate(rows.tolist()):
        for j in range(begin, end):
            controller.add_reference(references[j])
        results.set_row(k, *controller.step(odometry[received]))
    return 0


def same_results(one, other):
    """Whether two results have equal bits, except for columns of the batch replay only."""
    numbers = [np.delete(each.numbers, (22, 23), axis=1).tobytes() for each in (one, other)]
    return numbers[0] == numbers[1] and one.reasons.tolist() == other.reasons.tolist()


def test_a_state_array_holds_the_states_it_was_made_of():
    items = [
        State(5, Pose(1.0, -2.0, 0.5), BodyTwist(0.1, -0.2)),
        State(-7, Pose(math.nan, 0.0, 0.0), BodyTwist(0.0, 0.0)),
        State(2**62, Pose(0.0, 1e308, 1e308), BodyTwist(0.0, 0.0)),
        State(9, Pose(0.0, 0.0, 0.0), BodyTwist(0.0, math.inf)),
    ]
    states = as_state_array(items)
    assert bits(list(states)) == bits(items)
    assert bits([states[k] for k in range(len(states))]) == bits(items)
    assert states.finite.tolist() == [item.is_finite() for item in items]
    with pytest.raises(ValueError, match='poses must be'):
        StateArray(states.stamps_ns[1:], states.poses, states.twists)


# -- recorded runs --------------------------------------------------------------------------------


@pytest.mark.parametrize('path', GOLDEN, ids=lambda path: path.stem)
def test_recorded_runs_are_replayed_to_the_last_bit(path, monkeypatch):
    """Stops, restarts, time-outs, dynamic parameters, jumps and an unresponsive robot."""
    inputs = load_inputs(path)
    batched, stepped = make_controllers(inputs), make_controllers(inputs)
    fast = replay_controller(inputs, controllers=batched)
    monkeypatch.setattr(controller_replay, 'replay_batch', step_by_step)
    slow = replay_controller(inputs, controllers=stepped)
    assert slow.plain == 0
    assert fast.plain > 0.7 * fast.steps
    assert fast.reasons == slow.reasons
    assert bits(fast.fields) == bits(slow.fields)
    for one, other in zip(batched, stepped, strict=True):
        assert bits(one) == bits(other)


# -- synthetic runs ------------------------------------------------------------------------------


class Run:
    """A closed loop with a servo robot, and the messages that its controller received."""

    def __init__(self, seed, count, reference, corrupt=None, **changes):
        generator = np.random.default_rng(seed)
        self.parameters = ControllerParameters.from_dict(changes)
        controller = Controller(self.parameters)
        corrupt = corrupt or (lambda k, odometry, samples: (odometry, samples))
        speeds, delayed = np.zeros(2), BodyTwist(0.0, 0.0)
        odometry, references, rows = [], [], []
        for k in range(count):
            # Odometry with jitter of up to 0.4 ms.
            stamp = k * STEP + int(generator.integers(-400_000, 400_000)) + STEP
            noisy = speeds + 0.1 * generator.standard_normal(2)
            twist = twist_from_wheels(WheelSpeeds(*noisy.tolist()), GEOMETRY)
            ahead = (k + 1 + LEAD) * STEP
            samples = [State(ahead, Pose(0.0, 0.0, 0.0), BodyTwist(*reference(ahead / 1e9)))]
            if generator.uniform() < 0.1:
                samples = []  # the next step then receives two
            elif references and rows and rows[-1][1] == rows[-1][2]:
                before = ahead - STEP
                samples.insert(0, samples[0]._replace(stamp_ns=before))
            message, samples = corrupt(k, State(stamp, Pose(0.0, 0.0, 0.0), twist), samples)
            rows.append((k, len(references), len(references) + len(samples)))
            references += samples
            odometry.append(message)
            for motion in samples:
                controller.add_reference(motion)
            sent, _ = controller.step(message)
            command = np.array(wheels_from_twist(delayed, GEOMETRY))
            speeds = command + math.exp(-0.5) * (speeds - command)
            if self.unresponsive(k):
                speeds = speeds * 0.5
            delayed = sent
        self.odometry, self.references = as_state_array(odometry), as_state_array(references)
        self.rows = np.array(rows, dtype=np.int64)

    def unresponsive(self, k):
        return 700 <= k < 760

    def outcome(self, replay, cuts=(), actions=None):
        """Return the controller, its results, and the number of regular steps."""
        controller = Controller(self.parameters)
        results = StepResults.empty(len(self.rows))
        regular = 0
        edges = [0, *cuts, len(self.rows)]
        for first, until in zip(edges, edges[1:], strict=False):
            if actions and first in actions:
                actions[first](controller)
            part = results.part(first, until)
            messages = self.odometry, self.references, self.rows[first:until], part
            regular += replay(controller, *messages)
        return controller, results, regular

    def check(self, cuts=(), actions=None):
        """Compare batches with single steps; return results and number of regular steps."""
        batched, fast, regular = self.outcome(replay_batch, cuts, actions)
        stepped, slow, _ = self.outcome(step_by_step, cuts, actions)
        assert same_results(fast, slow)
        assert bits(batched) == bits(stepped)
        assert bits(batched.law.get_weights()) == bits(stepped.law.get_weights())
        return fast, regular


def as_state_array(items):
    return StateArray(
        np.array([item.stamp_ns for item in items]),
        np.array([item.pose for item in items]),
        np.array([item.twist for item in items]),
    )


def smooth(time):
    return 0.12 + 0.05 * math.sin(0.9 * time), 1.2 * math.sin(0.7 * time)


def switching(time):
    """Return a reference with jumps every 0.7 s, some 30 ms apart, so that several are known."""
    side = 1.0 if int(time / 0.7) % 2 else -0.6
    also = 0.05 if 0.03 < time % 1.4 < 0.5 else 0.0
    return 0.1 * side + also, 1.5 * side


@pytest.mark.parametrize('seed', [1, 2])
def test_a_run_with_jitter_and_an_unresponsive_robot(seed):
    run = Run(seed, 1200, smooth)
    results, regular = run.check()
    assert regular > 900
    assert Reason.NOT_FOLLOWING in results.reasons.tolist()
    assert results.limited.any()
    # The division into batches does not change the results.
    cuts = sorted(np.random.default_rng(seed).choice(np.arange(1, 1200), 40, replace=False))
    again, _ = run.check(cuts)
    assert same_results(results, again)


def test_references_that_only_the_recorder_received_are_left_out():
    """On a busy machine the queue of the controller overflows, that of the recorder does not.

    The batch once added every recorded reference, so a bag of such a run did not replay exactly.
    """
    run = Run(4, 600, smooth)
    overflown = np.arange(50, 600, 45)[:, None] + np.arange(4)
    run.rows[overflown.ravel(), 1] = run.rows[overflown.ravel(), 2]
    _, regular = run.check()
    assert regular > 400


@pytest.mark.parametrize(
    'changes',
    [
        {},
        {'jump_transition.preview': False},
        {'jump_transition.method': 'predictive'},
        {'predictive.dither': 0.2},
        {'predictive.enabled': False},
        {'speed_filter.enabled': False},
        {'speed_filter.dead_time': 0.025},
        {'use_fuzzy': False, 'predictive.algorithm': 'gradient'},
        {'watchdog.response_bound': 0.0},
        {'wheel.max_acceleration': 3.0},
    ],
    ids=str,
)
def test_jumps_with_other_parameters(changes):
    run = Run(3, 500, switching, **changes)
    results, regular = run.check()
    never = 'predictive.dither' in changes or changes.get('jump_transition.method') == 'predictive'
    assert regular == 0 if never else regular > 250
    assert results.reasons.tolist().count(Reason.TRACKING) > 300


def corrupted(k, odometry, samples):
    """Return messages with faults of every kind."""
    if k == 120:
        return odometry._replace(twist=BodyTwist(math.nan, 0.0)), samples
    if k == 150:
        return odometry._replace(pose=Pose(math.inf, 0.0, 0.0)), samples
    if k == 180:
        return odometry._replace(stamp_ns=k * STEP - 50_000_000), samples  # decreasing
    if k == 220:
        return odometry._replace(twist=BodyTwist(5.0, 0.0)), samples  # diverging
    if 320 <= k < 345:
        return odometry, []  # the reference is stale
    if k >= 400:  # a gap in the odometry
        odometry = odometry._replace(stamp_ns=odometry.stamp_ns + 30 * STEP)
        samples = [each._replace(stamp_ns=each.stamp_ns + 30 * STEP) for each in samples]
    if k in (450, 451):  # a repeated stamp
        odometry = odometry._replace(stamp_ns=452 * STEP + 30 * STEP)
    if k == 500:  # the source restarts, slightly earlier
        samples = [State((k + 60) * STEP, Pose(0.0, 0.0, 0.0), BodyTwist(0.1, 0.0))]
    if k == 550:
        samples = [each._replace(twist=BodyTwist(math.nan, 0.0)) for each in samples]
    if k in (685, 686):  # evidence that a normal response clears
        return odometry._replace(twist=BodyTwist(odometry.twist.linear + 0.2, 0.0)), samples
    if k == 600:
        odometry = odometry._replace(twist=BodyTwist(1e300, 1e300))
    return odometry, samples


@pytest.mark.parametrize('reference', [smooth, switching])
def test_invalid_messages_of_every_kind(reference):
    results, regular = Run(5, 700, reference, corrupted).check()
    assert regular > 300
    assert {
        Reason.NO_REFERENCE,
        Reason.ODOMETRY_BAD,
        Reason.REFERENCE_STALE,
        Reason.DIVERGING,
        Reason.TRACKING,
    } <= set(results.reasons.tolist())


def test_parameter_changes_stops_and_resets_between_batches():
    actions = {
        100: lambda c: c.configure(c.parameters.with_values({'law.gain': 20.0})),
        200: lambda c: c.configure(c.parameters.with_values({'linear.x.max_velocity': 0.1})),
        300: lambda c: c.enable(False),
        320: lambda c: c.enable(True),
        400: lambda c: c.reset(),
        450: lambda c: c.check_odometry(None, 0),
        500: lambda c: c.configure(c.parameters.with_values({'jump_transition.preview': False})),
        510: lambda c: c.actuation.set_command(np.array([1.0, 2.0])),
        560: lambda c: c.configure(c.parameters.with_values({'predictive.dither': 0.1})),
    }
    results, regular = Run(6, 650, switching).check(sorted(actions), actions)
    assert 200 < regular < 550
    assert Reason.DISABLED in results.reasons.tolist()


def test_batches_end_at_the_snapshots_of_the_weights():
    """The oldest snapshot holds the weights for an unresponsive robot."""
    run = Run(7, 400, smooth)
    controller, _, regular = run.outcome(replay_batch)
    assert regular > 350
    ages = []
    for coefficients, _ in controller._snapshots:
        distance = np.abs(controller.law.fuzzy.coefficients - coefficients).max()
        ages.append(distance)
    assert len(ages) == 3
    assert ages[0] > ages[-1] > 0.0
    assert controller._snapshot_steps * 0.01 == pytest.approx(SNAPSHOT_PERIOD)


def test_a_batch_with_a_number_that_is_not_finite_raises():
    run = Run(8, 300, smooth)
    controller, _, _ = run.outcome(replay_batch)
    controller.law.fuzzy.tables[-1][:] = math.nan
    more = Run(8, 400, smooth)
    rows = more.rows[300:]
    slow, fast = copy.deepcopy(controller), controller
    with pytest.raises(ValueError, match='must be finite'):
        step_by_step(slow, more.odometry, more.references, rows, StepResults.empty(100))
    with pytest.raises(ValueError, match='must be finite'):
        replay_batch(fast, more.odometry, more.references, rows, StepResults.empty(100))
