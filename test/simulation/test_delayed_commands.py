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
"""Commands that are delayed, reordered or lost, but never changed or duplicated."""

from collections import Counter
import math

import numpy as np
import pytest

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation import digital_twin
from t3mpc_ros.simulation.digital_twin import CAPACITY, TransportDelay
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters
from t3mpc_ros.simulation.plant_adapter import LinkDelay, PlantRobot

MS = 1_000_000


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


def test_simultaneous_arrivals_keep_the_order_of_sending():
    transport = make_transport()
    for delay, arrival in ((0.0, 7), (0.1, 7 + 100 * MS)):
        sent = [command(number, 3) for number in range(50)]
        for one in sent:
            transport.send(one, 7, delay, 0.0, 0.0)
        assert transport.next_ns == arrival
        assert transport.arrived(arrival) == sent
        assert transport.next_ns is None
        assert transport.arrived(arrival) == []


def test_every_command_is_delivered_once_lost_or_in_transit():
    """Random operations, often equal commands, and a clock that sometimes jumps back."""
    for seed in range(6):
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
        assert arrived.total() > 20


@pytest.mark.parametrize('loss', [0.01, 0.7])
def test_losses_have_the_set_rate_and_are_independent(loss):
    """Within four standard deviations of the binomial; two losses in a row too."""
    transport, count = make_transport(2), 5000
    lost = []
    for number in range(count):
        transport.send(command(0), number, 0.0, 0.0, loss)
        lost.append(not transport.arrived(number))
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


def test_backward_time_jump_clears_the_queue():
    for ask in (
        lambda transport: transport.arrived(50),
        lambda transport: transport.send(command(2), 50, 0.0, 0.0, 1.0),
    ):
        transport = make_transport()
        transport.send(command(1), 100, 1.0, 0.0, 0.0)
        ask(transport)
        assert transport.next_ns is None
        assert len(transport) == 0
        transport.send(command(3), 60, 0.0, 0.0, 0.0)  # and it continues from there
        assert transport.arrived(60) == [command(3)]


def test_full_queue_drops_the_oldest(monkeypatch):
    monkeypatch.setattr(digital_twin, 'CAPACITY', 50)
    transport = make_transport(6)
    for number in range(150):
        transport.send(command(number, number), 0, 0.5, 0.5, 0.0)
        assert len(transport) <= 50
    came = []
    while (instant := transport.next_ns) is not None:
        (one,) = transport.arrived(instant)  # each at its own instant
        came.append(one)
    assert sorted(one.stamp_ns for one in came) == list(range(100, 150))


PERIOD = 10 * MS


class NotingPlant:
    """Notes the command of each step, and the configurations."""

    wheels = (0.0, 0.0)

    def __init__(self):
        self.commands, self.configured = [], []

    def configure(self, parameters):
        self.configured.append((len(self.commands), parameters))

    def run(self, command, count):
        self.commands += [command[0]] * count

    def measure(self, dt):
        return 0.0, 0.0


@pytest.mark.parametrize(
    'link, latency',
    [
        (LinkDelay(), 0),
        (LinkDelay(), 3 * MS),
        (LinkDelay(0.0, 0.02), 4 * MS),
        (LinkDelay(0.02, 0.1, 0.2, 0.3, 0.9), 9 * MS),
    ],
)
def test_each_step_obeys_the_newest_command_that_has_arrived(link, latency):
    """A clock that was thought to jump back once dropped all commands under way."""
    periods, plant = 120, NotingPlant()
    robot = PlantRobot(plant, PaperRobotParameters(), link=link, seed=3)
    generator, sent = np.random.default_rng((3, 4)), []
    for k in range(periods):
        state = robot.advance(k * PERIOD)
        now_ns = state.stamp_ns + latency
        robot.apply(RobotCommand(WheelSpeeds(k + 1.0, 0.0), state.stamp_ns), now_ns)
        lost, late = generator.random(2)
        faulty = link.begin * 1e9 <= now_ns < link.end * 1e9
        if not (faulty and lost < link.loss):
            sent.append((now_ns + faulty * 1e9 * (link.delay + late * link.jitter), k + 1.0))
    robot.advance(periods * PERIOD)
    expected = [
        max((command for arrival, command in sent if arrival <= step * MS + 1), default=0.0)
        for step in range(10 * periods)
    ]
    assert plant.commands == expected


def test_the_robot_changes_at_its_instant():
    plant, changed = NotingPlant(), PaperRobotParameters.from_dict({'mass_factor': 1.3})
    robot = PlantRobot(plant, PaperRobotParameters(), changed, 5 * PERIOD)
    for k in range(9):
        robot.advance(k * PERIOD)
    assert plant.configured == [(50, changed)]
