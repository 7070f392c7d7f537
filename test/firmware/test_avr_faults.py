# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Each fault twice, told in the same words: to the Python emulator, and to the real programs.

The host is the real link, a pure function of time and bytes. ``emulator`` is the emulator that
users have, ``avr`` both boards' programs in simavr; what is asserted holds for either.
"""

from contextlib import ExitStack
import math
import random

import pytest
from support.avr_bench import AvrBoard, on_avr
from support.avr_boards import missing_tools
from support.emulator_bench import MS, Bench, check_followed

from t3mpc_ros.radio.protocol.codec import decode_from_dongle, encode
from t3mpc_ros.radio.protocol.frames import Command, Poll, Refusal, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

STEP = math.tau / 3200
HALF_STEP = 0.035 * math.tau / 400
"""m"""
REST = 0.45
"""s after the last command that was followed"""
AVR = pytest.param(
    'avr',
    marks=pytest.mark.skipif(bool(missing_tools()), reason=f'not installed: {missing_tools()}'),
)
KEY = bytes(range(16))


@pytest.fixture(params=['emulator', AVR])
def build(request):
    """Return what makes a bench, on either tier; one that reached its end is checked there."""
    with ExitStack() as stack:
        if request.param == 'avr':
            yield lambda **given: stack.enter_context(on_avr(**given))
        else:
            yield Bench


def driving(build, right=4.0, left=4.0, seconds=0.5, **given):
    """Return a bench whose robot has driven for a while."""
    bench = build(**given)
    bench.connect()
    bench.drive(right, left)
    bench.run(seconds)
    assert steps_at(bench, right, left)
    return bench


def steps_at(bench, right, left):
    """Whether the drivers get pulses for these wheel speeds; a rotor rings about its own."""
    speeds = tuple(speed / 1e6 for speed in bench.board.speeds)
    return speeds == pytest.approx((left, right), abs=0.01)


def rest_of(bench, seconds=0.5):
    """Return how long after the last command that was followed the wheels stood for good, s.

    A stepper's rotor rings about its last step before it is still: less than half a full step of
    that, 0.5 mm, is rest.
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


def resumes(bench, seconds):
    """Return how long it takes until the robot follows commands again."""
    count = len(bench.followed)
    return bench.run(seconds, lambda: len(bench.followed) > count)


def counted(bench):
    """Come to rest; the host's odometry must be the pulses that the drivers have got."""
    bench.drive(0.0, 0.0)
    bench.run(0.4)
    right, left = bench.link.telemetry.angles
    assert (round(left / STEP), round(right / STEP)) == bench.board.counters
    assert bench.plant.wheels == pytest.approx((0.0, 0.0), abs=0.2)


# -- the line -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
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
    counted(bench)


@pytest.mark.parametrize('phase', [0.0, 0.007])
def test_data_released_by_a_stalled_line_do_not_move_the_robot(build, phase):
    bench = driving(build)
    bench.run(phase)
    bench.inject('stall', 1.0)
    assert rest_of(bench) <= REST
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == ''
    assert steps_at(bench, 4.0, 4.0)
    check_followed(bench)


@pytest.mark.parametrize('key', [b'', KEY], ids=['open', 'keyed'])
def test_every_command_of_a_burst_held_for_a_second_is_stale(build, key):
    """Fifteen good commands, in session and in sequence (and signed), all a second late."""
    bench = build(key=key)
    bench.connect()
    bench.run(0.3)
    bench.kill()
    held = hold(bench, 15)
    bench.run(1.0)
    before, taken = bench.board.counters, len(bench.followed)
    assert stale(bench) == 0
    for wire in held:
        bench.emulator.feed(wire, bench.now_ns)
        bench.run(0.008)
    bench.run(0.2)
    assert bench.board.counters == before
    assert len(bench.followed) == taken
    assert stale(bench) == 15


def hold(bench, count):
    """Return the next ``count`` commands of the host as they would go over the line."""
    session, now_ns = bench.link._session, bench.now_ns  # what it would say itself
    held = []
    for index in range(count):
        command = session.command(1, 20, 8000, 8000, now_ns + 20 * MS * index)
        poll = encode(Poll(session.number, command.seq, 0))
        held.append(encode_frame(encode(Transmit(100 + index, 6, encode(command), poll))))
    return held


def stale(bench):
    """Return how many commands the robot has found to be late."""
    board = bench.board
    return board.stale if isinstance(board, AvrBoard) else board.packet_counters['stale']


# -- the boards, the air, the port ----------------------------------------------------------------


@pytest.mark.parametrize(
    'name, seconds',
    [
        ('jam', 0.6),
        ('silence', 0.6),
        ('robot_reset', 0.3),
        ('dongle_reset', 0.001),
        ('radio_dead', 0.5),
        ('imu_absent', 0.3),
        ('button', 0.2),
        ('close_port', 0.3),
    ],
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
        assert rest_of(bench) <= REST
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
    took = resumes(bench, 5.0) - 0.05
    print(f'\nfollows commands {took:.2f} s after the port is back, of it boot loader {start} s')
    assert took <= start + 1.0
    check_followed(bench)


@pytest.mark.parametrize('name', ['dongle_reset', 'robot_reset'])
def test_commands_resume_within_1_s_of_a_rebooted_board(build, name):
    bench = driving(build, flat={'dongle_boot_time': 0.3})
    bench.inject(name, 0.2)
    took = resumes(bench, 5.0)
    print(f'\n{name}: follows commands after {took:.2f} s')
    assert took <= 0.3 + 1.0
    bench.run(0.3)
    check_followed(bench)


# -- the host -------------------------------------------------------------------------------------


def test_wheels_stop_in_time_after_a_host_is_killed_at_any_phase(build):
    """From full speed, at phases all over a cycle; default parameters."""
    rests = []
    bench = driving(build, 10.0, 10.0)
    for phase in range(6):
        if phase:
            revive(bench)
            bench.drive(10.0, 10.0)
            bench.run(0.45)
            assert steps_at(bench, 10.0, 10.0)
        bench.run(0.0035 * phase)
        bench.kill()
        rests.append(rest_of(bench))
        assert bench.board.speeds == (0, 0)
    print(f'\nat rest {min(rests):.3f} to {max(rests):.3f} s after the last command')
    assert max(rests) <= REST
    check_followed(bench)


def test_wheels_stop_after_a_host_is_killed_within_a_frame(build):
    """Half a command is none; the next host's first frame ends it and is not lost."""
    bench = driving(build, 10.0, 10.0)
    for size in (1, 13, 25):
        bench.kill()
        bench.emulator.feed(hold(bench, 1)[0][:size], bench.now_ns)
        assert rest_of(bench) <= REST
        revive(bench)
        assert bench.connect() < 0.5
        bench.drive(10.0, 10.0)
        bench.run(0.5)
    check_followed(bench)


def revive(bench):
    """Start the host anew: another link at the same port."""
    fresh = Bench(emulator=bench.emulator, seed=len(bench.written))
    bench.link = fresh.link
    bench.emulator.board.on_command = bench._note
    bench.killed = bench.is_open = False
    bench.wake_ns = bench.now_ns


# -- a second opener ------------------------------------------------------------------------------


def test_a_second_host_on_the_line_causes_no_wrong_command(build):
    """An opener that ignores the lock: both write, and each byte goes to who reads first."""
    bench = driving(build)
    other = Bench(emulator=bench.emulator, seed=77)
    bench.emulator.board.on_command = bench._note
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
    assert rest_of(bench) <= REST


def test_noise_and_foreign_frames_on_the_line_have_no_effect(build):
    """A second opener that only writes: noise, frames of a session nobody is in, cut frames."""
    bench = driving(build)
    rng = random.Random(6)
    for _ in range(40):
        bench.run(0.02 + rng.uniform(0.0, 0.02))
        foreign = Command(9 + rng.randrange(200), rng.randrange(256), 1, 20, -9000, 9000, 0)
        poll = encode(Poll(9, 0, 0))
        frame = encode_frame(encode(Transmit(rng.randrange(256), 6, encode(foreign), poll)))
        cut = frame[: rng.randrange(1, len(frame))]
        rubbish = rng.choice((frame, cut, rng.randbytes(rng.randrange(1, 40))))
        bench.emulator.feed(rubbish, bench.now_ns)
    values = {(command.left, command.right) for _, command in bench.followed}
    assert values <= {(0, 0), (4000, 4000)}
    check_followed(bench)
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == ''
    counted(bench)


def test_a_refusal_does_not_disturb_the_transaction_in_progress(build):
    """Two transactions at once: the second is refused, the first is not disturbed."""
    bench = driving(build)
    bench.kill()
    bench.run(0.1)
    wire, heard = hold(bench, 2), []
    bench.emulator.feed(wire[0] + wire[1], bench.now_ns)
    for _ in range(20):
        bench.now_ns += 1 * MS
        heard += [data for _, data in bench.emulator.run_to(bench.now_ns)]
    answers = [decode_from_dongle(frame) for frame in FrameDecoder().feed(b''.join(heard))]
    assert answers == [Refusal(3, 101), answers[1]]
    assert answers[1].id == 100
    assert answers[1].first & answers[1].second & 1
