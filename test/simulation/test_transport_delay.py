# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Transport delay: commands are delayed, reordered or lost, but never changed or duplicated."""

from collections import Counter
import math

import numpy as np
import pytest

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.robot.command_limiter import CommandLimiter, CommandLimiterParameters
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.transport_delay import CAPACITY, TransportDelay

MS = 1_000_000
PERIOD_NS = 10 * MS


def make_transport(seed: int = 1) -> TransportDelay:
    return TransportDelay(np.random.default_rng(seed))


def command(number: int, stamp_ns: int = 0) -> RobotCommand:
    return RobotCommand(WheelSpeeds(0.01 * number, -0.01 * number), stamp_ns)


def arrivals(
    transport: TransportDelay, count: int, delay: float, jitter: float, loss: float
) -> dict[int, int]:
    """Return when (ns) each of ``count`` commands sent at once arrived, by its number."""
    result = {}
    for number in range(count):
        transport.send(command(number, number), 0, delay, jitter, loss)
    while (instant := transport.next_ns) is not None:
        for one in transport.arrived(instant):
            result[one.stamp_ns] = instant
    return result


def test_zero_delay_delivers_immediately_and_unchanged():
    transport = make_transport()
    sent = command(3, 7)
    transport.send(sent, 100, 0.0, 0.0, 0.0)
    assert transport.next_ns == 100
    assert transport.arrived(100) == [sent]
    assert transport.next_ns is None
    assert transport.arrived(100) == []


def test_delay_is_exact_to_the_nanosecond():
    transport = make_transport()
    transport.send(command(1), 5 * MS, 0.08, 0.0, 0.0)
    assert transport.next_ns == 85 * MS
    assert transport.arrived(85 * MS - 1) == []
    assert transport.arrived(85 * MS) == [command(1)]


def test_simultaneous_arrivals_keep_the_order_of_sending():
    transport = make_transport()
    for number in range(50):
        transport.send(command(number), 0, 0.1, 0.0, 0.0)
    assert transport.arrived(NANOSECONDS) == [command(number) for number in range(50)]


def test_every_command_is_delivered_once_lost_or_in_transit():
    """Random operations, often equal commands, and a clock that sometimes jumps back."""
    for seed in range(30):
        generator = np.random.default_rng(seed)
        transport = make_transport(seed)
        now_ns, sent, arrived, last_ns = 0, Counter(), Counter(), -1
        for _ in range(400):
            what = generator.random()
            if what < 0.02:
                now_ns -= int(generator.integers(0, 200 * MS))
            else:
                now_ns += int(generator.integers(0, 20 * MS))
            if what > 0.99:
                transport.clear()
                assert len(transport) == 0
                assert transport.next_ns is None
            elif what > 0.4:
                one = command(int(generator.integers(20)), now_ns - now_ns % (50 * MS))
                delay, jitter = generator.choice([0.0, 0.05, 0.3], 2).tolist()
                transport.send(
                    one, now_ns, delay, jitter, float(generator.choice([0.0, 0.3, 1.0]))
                )
                sent[one] += 1
            else:
                due_ns = transport.next_ns
                now = transport.arrived(now_ns)
                arrived.update(now)
                if now_ns >= last_ns:
                    assert bool(now) == (due_ns is not None and due_ns <= now_ns)
                assert transport.next_ns is None or transport.next_ns > now_ns
            last_ns = now_ns
        assert arrived <= sent  # as multisets: nothing created, changed or duplicated
        counts = transport.counts
        assert counts.sent == sent.total()
        assert counts.arrived == arrived.total() > 20
        assert counts.lost > 20
        assert counts.sent == (
            counts.arrived + counts.lost + counts.dropped + counts.cleared + len(transport)
        )


def test_loss_zero_delivers_all_and_loss_one_delivers_none():
    assert len(arrivals(make_transport(), 500, 0.05, 0.1, 0.0)) == 500
    transport = make_transport()
    assert arrivals(transport, 500, 0.05, 0.1, 1.0) == {}
    assert transport.counts.lost == transport.counts.sent == 500


@pytest.mark.parametrize('loss', [0.01, 0.2, 0.7])
def test_losses_have_the_set_rate_and_are_independent(loss):
    """Within four standard deviations of the binomial; two losses in a row too."""
    transport, count = make_transport(2), 20_000
    lost = []
    for number in range(count):
        before = transport.counts.lost
        transport.send(command(0), number, 0.0, 0.0, loss)
        transport.arrived(number)
        lost.append(transport.counts.lost > before)
    assert abs(sum(lost) - count * loss) < 4.0 * math.sqrt(count * loss * (1.0 - loss))
    twice = sum(one and other for one, other in zip(lost[::2], lost[1::2], strict=True))
    pairs, both = count // 2, loss * loss
    assert abs(twice - pairs * both) < 4.0 * math.sqrt(pairs * both * (1.0 - both))


@pytest.mark.parametrize('loss', [0.0, 0.5])
def test_delays_are_uniform_within_the_jitter(loss):
    """Also with losses: one random number for loss and delay would remove short delays."""
    delays = np.array(list(arrivals(make_transport(3), CAPACITY, 0.04, 0.1, loss).values())) / 1e9
    count = delays.size
    assert count > 0.4 * CAPACITY
    assert delays.min() >= 0.04
    assert delays.max() <= 0.14
    assert delays.mean() == pytest.approx(0.09, abs=4.0 * 0.1 / math.sqrt(12.0 * count))
    tenths, _ = np.histogram(delays, 10, (0.04, 0.14))
    assert np.all(np.abs(tenths - count / 10) < 4.0 * math.sqrt(count * 0.1 * 0.9))


def test_loss_and_jitter_use_independent_random_numbers():
    everything = arrivals(make_transport(4), 300, 0.05, 0.1, 0.0)
    some = arrivals(make_transport(4), 300, 0.05, 0.1, 0.4)
    assert 100 < len(some) < 250
    assert some == {number: everything[number] for number in some}
    assert arrivals(make_transport(4), 300, 0.0, 0.0, 0.4).keys() == some.keys()


def test_every_command_draws_two_random_numbers():
    generators = [np.random.default_rng(5) for _ in range(4)]
    parameters = [(0.0, 0.0, 0.0), (0.1, 0.2, 0.3), (0.0, 0.0, 1.0)]
    for generator, values in zip(generators, parameters, strict=False):
        transport = TransportDelay(generator)
        for number in range(100):
            transport.send(command(number), 0, *values)
    generators[3].random(200)
    assert len({generator.random() for generator in generators}) == 1


def test_backward_time_jump_clears_the_queue():
    for ask in (
        lambda transport: transport.arrived(50),
        lambda transport: transport.send(command(2), 50, 0.0, 0.0, 1.0),
    ):
        transport = make_transport()
        transport.send(command(1), 100, 1.0, 0.0, 0.0)
        ask(transport)
        assert transport.next_ns is None
        assert transport.counts.cleared == 1
        transport.send(command(3), 60, 0.0, 0.0, 0.0)  # and it continues from there
        assert transport.arrived(60) == [command(3)]


def test_clear_drops_and_counts_commands_in_transit():
    transport = make_transport()
    for number in range(5):
        transport.send(command(number), 0, 0.1, 0.0, 0.0)
    transport.clear()
    assert transport.arrived(NANOSECONDS) == []
    assert transport.counts == (5, 0, 0, 0, 5)


def test_full_queue_drops_and_counts_the_oldest():
    transport = make_transport(6)
    for number in range(3 * CAPACITY):
        transport.send(command(number, number), 0, 0.5, 0.5, 0.0)
        assert len(transport) <= CAPACITY
    came = []
    while (instant := transport.next_ns) is not None:
        (one,) = transport.arrived(instant)  # each at its own instant
        came.append(one)
    assert sorted(one.stamp_ns for one in came) == list(range(2 * CAPACITY, 3 * CAPACITY))
    assert transport.counts == (3 * CAPACITY, CAPACITY, 0, 2 * CAPACITY, 0)


@pytest.mark.parametrize(
    'delay, jitter, loss',
    [
        (-0.1, 0, 0),
        (math.nan, 0, 0),
        (0, math.inf, 0),
        (0, -1.0, 0),
        (0, 0, 1.1),
        (0, 0, math.nan),
    ],
)
def test_invalid_delay_or_loss_is_rejected(delay, jitter, loss):
    transport = make_transport()
    with pytest.raises(ValueError, match='must be'):
        transport.send(command(1), 0, delay, jitter, loss)
    assert transport.counts.sent == 0


# --- with a command limiter at the receiver -----------------------------------------------------


def drive(
    delay: float, jitter: float, loss: float = 0.0, seed: int = 7
) -> tuple[list[RobotCommand], list[tuple[float, str]], list[str]]:
    """Send a faster command every 10 ms for 4 s; return arrivals, targets and rejections.

    The targets are those of the right wheel, with the reason of the limiter, once per period.
    """
    transport = make_transport(seed)
    limiter = CommandLimiter(CommandLimiterParameters(), WheelGeometry())
    came, held, refused = [], [], []
    for tick in range(400):
        now_ns = tick * PERIOD_NS
        transport.send(RobotCommand(WheelSpeeds(0.02 * tick, 0.02 * tick), now_ns), now_ns,
                 delay, jitter, loss)  # fmt: skip
        for one in transport.arrived(now_ns):
            came.append(one)
            refused.append(limiter.accept(one, now_ns))
        limited_command = limiter.advance(now_ns, 0.01)
        held.append((limited_command.target.right, limited_command.reason))
    return came, held, refused


def test_delay_beyond_the_timeout_rejects_every_command():
    assert CommandLimiterParameters().command_timeout == 0.25
    came, held, refused = drive(0.3, 0.0)
    assert len(came) == 370
    assert set(refused) == {'command is too old: 0.300 s'}
    assert set(held) == {(0.0, 'no command yet')}


def test_delay_within_the_timeout_accepts_every_command():
    _, held, refused = drive(0.2, 0.0)
    assert set(refused) == {''}
    assert [target for target, _ in held[20:]] == pytest.approx(
        [0.02 * tick for tick in range(380)]
    )


def test_out_of_order_commands_never_reverse_the_wheels():
    came, held, refused = drive(0.02, 0.12)
    stamps = [one.stamp_ns for one in came]
    assert stamps != sorted(stamps)  # some overtake others
    overtaken = [one < max(stamps[: index + 1]) for index, one in enumerate(stamps)]
    assert 50 < sum(overtaken) < len(came)
    assert [reason == 'command is older than the one before it' for reason in refused] == overtaken
    targets = [target for target, _ in held]
    assert targets == sorted(targets)
    assert targets[-1] > 7.0


def test_losses_stop_the_wheels_only_after_the_timeout():
    """A loss of 0.9 causes gaps of 25 periods and more; the next command ends each."""
    came, held, _ = drive(0.0, 0.0, 0.9)
    at = [one.stamp_ns // PERIOD_NS for one in came]
    for tick, (target, reason) in enumerate(held):
        before = [one for one in at if one <= tick]
        if not before:
            assert (target, reason) == (0.0, 'no command yet')
        elif tick - before[-1] < 25:
            assert target == pytest.approx(0.02 * before[-1])
        else:
            assert (target, reason) == (0.0, 'no command for 0.25 s')
    assert any(reason == 'no command for 0.25 s' for _, reason in held)
