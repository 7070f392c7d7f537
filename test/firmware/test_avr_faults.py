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
"""Each fault on two targets: the Python emulator, and the firmware of both boards in simavr.

The host is the real link, a pure function of time and bytes. The assertions are the same for
both targets. In simavr a second takes a quarter of a minute: most of its tests are long.
"""

from contextlib import ExitStack
import math
import random

import pytest
from support.avr_bench import on_avr
from support.emulator_bench import MS, Bench, check_followed
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.protocol.codec import decode_from_dongle, encode
from t3mpc_ros.radio.protocol.frames import Command, Poll, Refusal, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

STEP = math.tau / 3200
HALF_STEP = 0.035 * math.tau / 400  # m
REST = 0.45  # s after the last executed command
NEEDS_TOOLS = needing(*AVR)
LONG_AVR = pytest.param('avr', marks=[NEEDS_TOOLS, pytest.mark.long])
KEY = bytes(range(16))


def on_both_targets(names, faults, on_boards=0):
    """Parametrize a test: each fault on both targets; some on the boards, the others as long."""
    rows = [pytest.param('emulator', *fault) for fault in faults]
    for number, fault in enumerate(faults):
        marks = [NEEDS_TOOLS] if number < on_boards else [NEEDS_TOOLS, pytest.mark.long]
        rows.append(pytest.param('avr', *fault, marks=marks))
    return pytest.mark.parametrize(f'build, {names}', rows, indirect=['build'])


@pytest.fixture(params=['emulator', LONG_AVR])
def build(request):
    """Return a factory of benches for each target; the boards are checked at the end."""
    with ExitStack() as stack:
        if request.param == 'avr':
            yield lambda **given: stack.enter_context(on_avr(**given))
        else:
            yield Bench


def driving(build, right=4.0, left=4.0, seconds=0.5, **given):
    """Return a bench with a moving robot."""
    bench = build(**given)
    bench.connect()
    bench.drive(right, left)
    bench.run(seconds)
    assert steps_at(bench, right, left)
    return bench


def steps_at(bench, right, left):
    """Return whether the step pulses have these wheel speeds; the rotors oscillate about them."""
    speeds = tuple(speed / 1e6 for speed in bench.board.speeds)
    return speeds == pytest.approx((left, right), abs=0.01)


def stop_time(bench, seconds=0.5):
    """Return the time from the last executed command to standstill, s.

    The rotor of a stepper oscillates about its last step: less than half a full step of that
    motion, 0.5 mm, counts as standstill.
    """
    track = []
    for _ in range(round(seconds / 0.001)):
        bench.run(0.001)
        track.append((bench.now_ns, bench.board.speeds != (0, 0), bench.plant.pose))
    end = track[-1][2]
    moving = (
        now_ns
        for now_ns, stepping, pose in track
        if stepping or math.hypot(pose.x - end.x, pose.y - end.y) > HALF_STEP
    )
    return (max(moving, default=bench.followed[-1][0]) - bench.followed[-1][0]) / 1e9


def time_to_resume(bench, seconds):
    """Return the time until the robot executes commands again, s."""
    count = len(bench.followed)
    return bench.run(seconds, lambda: len(bench.followed) > count)


def check_odometry(bench):
    """Stop, and check that the wheel angles of the host equal the step pulses."""
    bench.drive(0.0, 0.0)
    bench.run(0.4)
    right, left = bench.link.telemetry.angles
    assert (round(left / STEP), round(right / STEP)) == bench.board.counters
    assert bench.plant.wheels == pytest.approx((0.0, 0.0), abs=0.2)


# -- serial line ----------------------------------------------------------------------------------


@on_both_targets(
    'name, share',
    [
        ('drop_bytes', 0.01),
        ('flip_bits', 0.01),
        ('duplicate_bytes', 0.01),
        ('insert_bytes', 0.01),
        ('split', 0.5),
        ('reorder', 0.2),
        ('delay', 0.015),
    ],
)
def test_line_faults_cause_no_wrong_motion_and_the_link_recovers(build, name, share):
    bench = driving(build)
    rng = random.Random(2)
    bench.inject(name, 1.0, share)
    for _ in range(10):
        bench.drive(rng.uniform(-6.0, 6.0), rng.uniform(-6.0, 6.0))
        bench.run(0.1)
    bench.drive(3.0, 3.0)
    bench.run(0.5)
    assert bench.link.reason(bench.now_ns) == ''
    assert bench.now_ns - bench.followed[-1][0] < 30 * MS
    assert steps_at(bench, 3.0, 3.0)
    check_followed(bench)
    check_odometry(bench)


@pytest.mark.parametrize('phase', [0.0, 0.007])
def test_data_released_by_a_stalled_line_do_not_move_the_robot(build, phase):
    bench = driving(build)
    bench.run(phase)
    bench.inject('stall', 1.0)
    assert stop_time(bench) <= REST
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == ''
    assert steps_at(bench, 4.0, 4.0)
    check_followed(bench)


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
def test_every_command_of_a_burst_held_for_a_second_is_stale(build, key):
    """Fifteen valid commands, in session and sequence (and signed), delayed by a second."""
    bench = build(key=key)
    bench.connect()
    bench.run(0.3)
    bench.kill()
    delayed = next_commands(bench, 15)
    bench.run(1.0)
    before, executed = bench.board.counters, len(bench.followed)
    assert bench.board.stale == 0
    for wire in delayed:
        bench.emulator.feed(wire, bench.now_ns)
        bench.run(0.008)
    bench.run(0.2)
    assert bench.board.counters == before
    assert len(bench.followed) == executed
    assert bench.board.stale == 15


def next_commands(bench, count):
    """Return the next ``count`` commands of the host, as bytes on the line."""
    session, now_ns = bench.link._session, bench.now_ns
    frames = []
    for index in range(count):
        command = session.command(1, 20, 8000, 8000, now_ns + 20 * MS * index)
        poll = encode(Poll(session.number, command.seq, 0))
        frames.append(encode_frame(encode(Transmit(100 + index, 6, encode(command), poll))))
    return frames


# -- boards, radio, port --------------------------------------------------------------------------


@on_both_targets(
    'name, seconds',
    [
        ('silence', 0.6),
        ('jam', 0.6),
        ('robot_reset', 0.3),
        ('dongle_reset', 0.001),
        ('radio_dead', 0.5),
        ('imu_absent', 0.3),
        ('button', 0.2),
        ('close_port', 0.3),
    ],
    on_boards=1,
)
def test_a_fault_at_full_speed_stops_the_robot_and_it_recovers(build, name, seconds):
    bench = driving(build, 10.0, 10.0, flat={'dongle_boot_time': 0.3})
    bench.inject(name, seconds)
    if name == 'imu_absent':
        bench.run(0.2)
        assert bench.link.telemetry.imu is None
        assert bench.link.telemetry.status.imu_fault
        assert bench.link.reason(bench.now_ns) == ''
    elif name in ('jam', 'silence', 'button'):
        assert stop_time(bench) <= REST
    bench.run(0.7)
    if bench.link.telemetry.status.estop:
        bench.link.release_estop(bench.now_ns)
    bench.run(0.6)
    assert bench.link.reason(bench.now_ns) == ''
    assert steps_at(bench, 10.0, 10.0)
    assert bench.link.telemetry.imu is not None
    check_followed(bench)


@pytest.mark.parametrize('start', [0.0, 1.5])
def test_commands_resume_within_1_s_of_a_replugged_dongle(build, start):
    bench = driving(build, flat={'dongle_boot_time': start})
    bench.inject('close_port', 0.5)
    bench.run(0.45)
    assert 'dongle' in bench.link.reason(bench.now_ns)
    took = time_to_resume(bench, 5.0) - 0.05
    print(f'\ncommands resume after {took:.2f} s, boot loader {start} s')
    assert took <= start + 1.0
    check_followed(bench)


# -- host -----------------------------------------------------------------------------------------


def test_wheels_stop_in_time_after_a_host_is_killed_at_any_phase(build):
    """From full speed, at several phases of a cycle, with default parameters."""
    times = []
    bench = driving(build, 10.0, 10.0)
    for phase in range(6):
        if phase:
            restart_host(bench)
            bench.drive(10.0, 10.0)
            bench.run(0.6)  # the session begins, and the ramp takes a third of a second
            assert steps_at(bench, 10.0, 10.0)
        bench.run(0.0035 * phase)
        bench.kill()
        times.append(stop_time(bench))
        assert bench.board.speeds == (0, 0)
    print(f'\nat rest {min(times):.3f} to {max(times):.3f} s after the last command')
    assert max(times) <= REST
    check_followed(bench)


def test_wheels_stop_after_a_host_is_killed_within_a_frame(build):
    """A partial command is dropped; the first frame of the next host is not lost."""
    bench = driving(build, 10.0, 10.0)
    for size in (1, 13, 25):
        bench.kill()
        bench.emulator.feed(next_commands(bench, 1)[0][:size], bench.now_ns)
        assert stop_time(bench) <= REST
        restart_host(bench)
        assert bench.connect() < 0.5
        bench.drive(10.0, 10.0)
        bench.run(0.5)
    check_followed(bench)


def restart_host(bench):
    """Replace the link by a new one at the same port."""
    fresh = Bench(emulator=bench.emulator, seed=len(bench.written))
    bench.link = fresh.link
    bench.emulator.board.on_command = bench._record_command
    bench.killed = bench.is_open = False
    bench.wake_ns = bench.now_ns


# -- second client --------------------------------------------------------------------------------


def test_a_second_host_on_the_line_causes_no_wrong_command(build):
    """Two clients without locking: both write, and each byte is read by one of them."""
    bench = driving(build)
    other = Bench(emulator=bench.emulator, seed=77)
    bench.emulator.board.on_command = bench._record_command
    other.drive(-3.0, 5.0)
    rng = random.Random(5)
    for _ in range(500):
        bench.run(rng.uniform(0.0005, 0.002))
        other.now_ns = bench.now_ns
        other.run(rng.uniform(0.0005, 0.002))
        bench.now_ns = other.now_ns
    check_followed(bench, other)
    values = {(command.left, command.right) for _, command in bench.followed}
    assert values <= {(0, 0), (4000, 4000), (5000, -3000)}
    other.kill()
    bench.run(1.2)
    assert bench.link.reason(bench.now_ns) == ''
    assert steps_at(bench, 4.0, 4.0)
    bench.kill()
    assert stop_time(bench) <= REST


def test_noise_and_foreign_frames_on_the_line_have_no_effect(build):
    """A second client that only writes: noise, frames of an unknown session, partial frames."""
    bench = driving(build)
    rng = random.Random(6)
    for _ in range(40):
        bench.run(0.02 + rng.uniform(0.0, 0.02))
        foreign = Command(9 + rng.randrange(200), rng.randrange(256), 1, 20, -9000, 9000, 0)
        poll = encode(Poll(9, 0, 0))
        frame = encode_frame(encode(Transmit(rng.randrange(256), 6, encode(foreign), poll)))
        cut = frame[: rng.randrange(1, len(frame))]
        noise = rng.choice((frame, cut, rng.randbytes(rng.randrange(1, 40))))
        bench.emulator.feed(noise, bench.now_ns)
    values = {(command.left, command.right) for _, command in bench.followed}
    assert values <= {(0, 0), (4000, 4000)}
    check_followed(bench)
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == ''
    check_odometry(bench)


def test_a_refusal_does_not_disturb_the_transaction_in_progress(build):
    """Two transactions at once: the second is refused, the first is completed."""
    bench = driving(build)
    bench.kill()
    bench.run(0.1)
    wire, received = next_commands(bench, 2), []
    bench.emulator.feed(wire[0] + wire[1], bench.now_ns)
    for _ in range(20):
        bench.now_ns += 1 * MS
        received += [data for _, data in bench.emulator.run_to(bench.now_ns)]
    replies = [decode_from_dongle(frame) for frame in FrameDecoder().feed(b''.join(received))]
    assert replies == [Refusal(3, 101), replies[1]]
    assert replies[1].id == 100
    assert replies[1].first & replies[1].second & 1
