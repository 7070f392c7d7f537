# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The way of a command: late, overtaken or lost, but never changed, doubled or invented."""

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


def channel(seed: int = 1) -> TransportDelay:
    return TransportDelay(np.random.default_rng(seed))


def command(number: int, stamp_ns: int = 0) -> RobotCommand:
    return RobotCommand(WheelSpeeds(0.01 * number, -0.01 * number), stamp_ns)


def arrivals(
    way: TransportDelay, count: int, delay: float, jitter: float, loss: float
) -> dict[int, int]:
    """Return when (ns) each of ``count`` commands sent at once arrived, by its number."""
    result = {}
    for number in range(count):
        way.send(command(number, number), 0, delay, jitter, loss)
    while (instant := way.next_ns) is not None:
        for one in way.arrived(instant):
            result[one.stamp_ns] = instant
    return result


def test_without_delay_a_command_arrives_at_the_instant_it_was_sent_and_unchanged():
    way = channel()
    sent = command(3, 7)
    way.send(sent, 100, 0.0, 0.0, 0.0)
    assert way.next_ns == 100
    assert way.arrived(100) == [sent]
    assert way.next_ns is None
    assert way.arrived(100) == []


def test_a_delay_is_kept_to_the_nanosecond():
    way = channel()
    way.send(command(1), 5 * MS, 0.08, 0.0, 0.0)
    assert way.next_ns == 85 * MS
    assert way.arrived(85 * MS - 1) == []
    assert way.arrived(85 * MS) == [command(1)]


def test_commands_that_arrive_together_come_in_the_order_of_sending():
    way = channel()
    for number in range(50):
        way.send(command(number), 0, 0.1, 0.0, 0.0)
    assert way.arrived(NANOSECONDS) == [command(number) for number in range(50)]


def test_what_was_sent_arrives_once_is_lost_or_is_under_way():
    """Random operations, commands that are often equal, a clock that now and then goes back."""
    for seed in range(30):
        generator = np.random.default_rng(seed)
        way = channel(seed)
        now_ns, sent, arrived, last_ns = 0, Counter(), Counter(), -1
        for _ in range(400):
            what = generator.random()
            if what < 0.02:
                now_ns -= int(generator.integers(0, 200 * MS))
            else:
                now_ns += int(generator.integers(0, 20 * MS))
            if what > 0.99:
                way.clear()
                assert len(way) == 0
                assert way.next_ns is None
            elif what > 0.4:
                one = command(int(generator.integers(20)), now_ns - now_ns % (50 * MS))
                delay, jitter = generator.choice([0.0, 0.05, 0.3], 2).tolist()
                way.send(one, now_ns, delay, jitter, float(generator.choice([0.0, 0.3, 1.0])))
                sent[one] += 1
            else:
                due_ns = way.next_ns
                now = way.arrived(now_ns)
                arrived.update(now)
                if now_ns >= last_ns:
                    assert bool(now) == (due_ns is not None and due_ns <= now_ns)
                assert way.next_ns is None or way.next_ns > now_ns
            last_ns = now_ns
        assert arrived <= sent  # as multisets: nothing invented, changed or doubled
        counts = way.counts
        assert counts.sent == sent.total()
        assert counts.arrived == arrived.total() > 20
        assert counts.lost > 20
        assert counts.sent == (
            counts.arrived + counts.lost + counts.dropped + counts.cleared + len(way)
        )


def test_without_loss_every_command_arrives_and_with_full_loss_none():
    assert len(arrivals(channel(), 500, 0.05, 0.1, 0.0)) == 500
    way = channel()
    assert arrivals(way, 500, 0.05, 0.1, 1.0) == {}
    assert way.counts.lost == way.counts.sent == 500


@pytest.mark.parametrize('loss', [0.01, 0.2, 0.7])
def test_loss_is_as_frequent_as_was_asked_for_and_strikes_independently(loss):
    """Within four standard deviations of the binomial; so are two losses in a row."""
    way, count = channel(2), 20_000
    lost = []
    for number in range(count):
        before = way.counts.lost
        way.send(command(0), number, 0.0, 0.0, loss)
        way.arrived(number)
        lost.append(way.counts.lost > before)
    assert abs(sum(lost) - count * loss) < 4.0 * math.sqrt(count * loss * (1.0 - loss))
    twice = sum(one and other for one, other in zip(lost[::2], lost[1::2], strict=True))
    pairs, both = count // 2, loss * loss
    assert abs(twice - pairs * both) < 4.0 * math.sqrt(pairs * both * (1.0 - both))


@pytest.mark.parametrize('loss', [0.0, 0.5])
def test_delays_fill_the_jitter_evenly_and_never_leave_it(loss):
    """Of those that arrive too: one number for both loss and delay would thin out the early."""
    delays = np.array(list(arrivals(channel(3), CAPACITY, 0.04, 0.1, loss).values())) / 1e9
    count = delays.size
    assert count > 0.4 * CAPACITY
    assert delays.min() >= 0.04
    assert delays.max() <= 0.14
    assert delays.mean() == pytest.approx(0.09, abs=4.0 * 0.1 / math.sqrt(12.0 * count))
    tenths, _ = np.histogram(delays, 10, (0.04, 0.14))
    assert np.all(np.abs(tenths - count / 10) < 4.0 * math.sqrt(count * 0.1 * 0.9))


def test_a_change_of_loss_does_not_shift_the_delays_and_jitter_does_not_shift_the_losses():
    everything = arrivals(channel(4), 300, 0.05, 0.1, 0.0)
    some = arrivals(channel(4), 300, 0.05, 0.1, 0.4)
    assert 100 < len(some) < 250
    assert some == {number: everything[number] for number in some}
    assert arrivals(channel(4), 300, 0.0, 0.0, 0.4).keys() == some.keys()


def test_two_numbers_are_drawn_for_each_command_whatever_the_settings():
    generators = [np.random.default_rng(5) for _ in range(4)]
    parameters = [(0.0, 0.0, 0.0), (0.1, 0.2, 0.3), (0.0, 0.0, 1.0)]
    for generator, values in zip(generators, parameters, strict=False):
        way = TransportDelay(generator)
        for number in range(100):
            way.send(command(number), 0, *values)
    generators[3].random(200)
    assert len({generator.random() for generator in generators}) == 1


def test_a_clock_that_goes_back_empties_the_way():
    for ask in (lambda way: way.arrived(50), lambda way: way.send(command(2), 50, 0.0, 0.0, 1.0)):
        way = channel()
        way.send(command(1), 100, 1.0, 0.0, 0.0)
        ask(way)
        assert way.next_ns is None
        assert way.counts.cleared == 1
        way.send(command(3), 60, 0.0, 0.0, 0.0)  # and it goes on from there
        assert way.arrived(60) == [command(3)]


def test_clearing_forgets_what_is_under_way_and_counts_it():
    way = channel()
    for number in range(5):
        way.send(command(number), 0, 0.1, 0.0, 0.0)
    way.clear()
    assert way.arrived(NANOSECONDS) == []
    assert way.counts == (5, 0, 0, 0, 5)


def test_a_full_way_drops_the_oldest_and_counts_it():
    way = channel(6)
    for number in range(3 * CAPACITY):
        way.send(command(number, number), 0, 0.5, 0.5, 0.0)
        assert len(way) <= CAPACITY
    came = []
    while (instant := way.next_ns) is not None:
        (one,) = way.arrived(instant)  # each at its own instant: none was passed over
        came.append(one)
    assert sorted(one.stamp_ns for one in came) == list(range(2 * CAPACITY, 3 * CAPACITY))
    assert way.counts == (3 * CAPACITY, CAPACITY, 0, 2 * CAPACITY, 0)


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
def test_delays_and_losses_that_are_none_are_refused(delay, jitter, loss):
    way = channel()
    with pytest.raises(ValueError, match='must be'):
        way.send(command(1), 0, delay, jitter, loss)
    assert way.counts.sent == 0


# --- with the guard behind it -------------------------------------------------------------------


def drive(
    delay: float, jitter: float, loss: float = 0.0, seed: int = 7
) -> tuple[list[RobotCommand], list[tuple[float, str]], list[str]]:
    """Send a faster command every 10 ms for 4 s; return what arrived, what held and refusals.

    What held is the guard's target of the right wheel and its reason, once per period.
    """
    way = channel(seed)
    guard = CommandLimiter(CommandLimiterParameters(), WheelGeometry())
    came, held, refused = [], [], []
    for tick in range(400):
        now_ns = tick * PERIOD_NS
        way.send(RobotCommand(WheelSpeeds(0.02 * tick, 0.02 * tick), now_ns), now_ns,
                 delay, jitter, loss)  # fmt: skip
        for one in way.arrived(now_ns):
            came.append(one)
            refused.append(guard.accept(one, now_ns))
        limited_command = guard.advance(now_ns, 0.01)
        held.append((limited_command.target.right, limited_command.reason))
    return came, held, refused


def test_a_delay_beyond_the_timeout_lets_no_command_through_and_the_guard_says_why():
    assert CommandLimiterParameters().command_timeout == 0.25
    came, held, refused = drive(0.3, 0.0)
    assert len(came) == 370
    assert set(refused) == {'command is too old: 0.300 s'}
    assert set(held) == {(0.0, 'no command yet')}


def test_a_delay_within_the_timeout_lets_every_command_through_that_much_later():
    _, held, refused = drive(0.2, 0.0)
    assert set(refused) == {''}
    assert [target for target, _ in held[20:]] == pytest.approx(
        [0.02 * tick for tick in range(380)]
    )


def test_commands_that_were_overtaken_never_take_the_wheels_back():
    came, held, refused = drive(0.02, 0.12)
    stamps = [one.stamp_ns for one in came]
    assert stamps != sorted(stamps)  # they do overtake each other
    overtaken = [one < max(stamps[: index + 1]) for index, one in enumerate(stamps)]
    assert 50 < sum(overtaken) < len(came)
    assert [reason == 'command is older than the one before it' for reason in refused] == overtaken
    targets = [target for target, _ in held]
    assert targets == sorted(targets)
    assert targets[-1] > 7.0


def test_a_lossy_way_stops_the_wheels_only_when_silence_outlasts_the_timeout():
    """At a loss of 0.9 gaps of 25 periods and more happen; the next command ends each."""
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
