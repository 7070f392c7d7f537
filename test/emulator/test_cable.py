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
"""Driving over the USB of the robot board: the session, key, limits and stops of the radio."""

import pytest
from support.emulator_bench import MS, cable_bench

from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import codec, frames
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

KEY = bytes(range(16))


@pytest.fixture(params=[b'', KEY], ids=['open', 'keyed'])
def bench(request):
    made = cable_bench(key=request.param)
    made.connect()
    made.drive(5.0, 4.0)
    made.run(1.0)
    assert made.link.reason(made.now_ns) == ''
    return made


def rests(bench):
    return bench.board.speeds == (0, 0) and max(map(abs, bench.plant.wheels)) < 0.2


def test_a_robot_drives_over_its_cable_as_over_the_radio(bench):
    assert bench.link.over_cable
    assert bench.link.authenticated == bool(bench.link._key)
    assert bench.plant.wheels.right == pytest.approx(5.0, abs=0.3)
    assert bench.plant.wheels.left == pytest.approx(4.0, abs=0.3)
    bench.run(2.0)
    quality = bench.link.quality(bench.now_ns)
    assert (quality.lost, quality.sessions, quality.robot_resets) == (0, 1, 0)
    assert (quality.dongle_resets, quality.collisions, quality.malformed) == (0, 0, 0)
    print(f'round trip {1e3 * quality.round_trip_median:.2f} ms')
    assert quality.round_trip_p99 < 0.01
    bench.run_to_rest()
    assert bench.counted_pulses == bench.plant.pulses
    bench.link.shut_down()
    bench.run(2.0, lambda: bench.link.state is LinkState.DONE)
    assert not bench.board.powered


@pytest.mark.parametrize('how', ['host dies', 'unplugged', 'suspended'])
def test_without_commands_over_the_cable_the_robot_rests_in_time(bench, how):
    last_ns = bench.now_ns
    if how == 'suspended':
        bench.now_ns += 450 * MS
        bench.emulator.run_to(bench.now_ns)
    elif how == 'host dies':
        bench.kill()
    else:
        bench.emulator.unplugged = True
    bench.run(0.45 - (bench.now_ns - last_ns) / 1e9 + 1e-6)
    assert rests(bench)
    bench.kill()
    bench.run(0.5)
    assert rests(bench)


def test_over_the_cable_a_silence_is_that_of_the_board(bench):
    """It was a dongle that did not reply, or a robot out of range on channel 82."""
    received_ns = bench.link._received_ns
    bench.link._received_ns = bench.link._since_ns = bench.now_ns - 10**9
    assert bench.link.reason(bench.now_ns) == reasons.ROBOT_SILENT
    bench.link._received_ns = received_ns
    bench.emulator.unplugged = True
    found = set()
    bench.each = lambda: found.add(bench.link.reason(bench.now_ns))
    bench.run(0.24)
    assert found == {'', reasons.BOARD_TIMEOUT}


def test_the_emergency_stop_works_over_the_cable(bench):
    bench.link.latch_estop('test')
    bench.run(0.4)
    assert rests(bench)
    assert bench.board.status & frames.StatusFlag.ESTOP
    assert bench.link.release_estop(bench.now_ns) == ''
    bench.run(0.6)
    assert bench.plant.wheels.right == pytest.approx(5.0, abs=0.3)
    bench.inject('button', 0.1)
    bench.run(0.4)
    assert rests(bench)
    assert bench.link.reason(bench.now_ns) == reasons.ROBOT_ESTOP


def test_a_robot_with_a_key_follows_signed_commands_only():
    for key, robot_key, reason in (
        (b'', KEY, reasons.HOST_KEY_MISSING),
        (KEY, b'', reasons.ROBOT_KEY_MISSING),
        (KEY, bytes(16)[:15] + b'\1', 'so the keys differ'),
    ):
        made = cable_bench(key=key, robot_key=robot_key)
        made.drive(5.0, 5.0)
        made.run(1.0)
        assert reason in made.link.reason(made.now_ns)
        assert made.board.counters == (0, 0)


def test_limits_of_the_board_hold_over_the_cable():
    made = cable_bench(link=LinkParameters.from_dict({'robot.max_speed': 3.0}))
    made.connect()
    made.drive(9.0, 9.0)
    made.run(1.0)
    assert max(made.board.speeds) == pytest.approx(3_000_000, abs=2000)


def test_radio_and_cable_take_the_robot_from_each_other():
    """There is one session: the robot follows one of them, never both."""
    made = cable_bench()
    made.connect()
    made.drive(5.0, 5.0)
    made.run(0.5)
    ours = made.board.session
    made.board.receive(bytes([0x24, ours % 255 + 1, 0, 0]))  # HELLO over the radio
    assert made.board.session == ours % 255 + 1
    made.run(0.05, lambda: made.link.state is not LinkState.RUN)
    made.run(1.0, lambda: made.link.reason(made.now_ns) == '')
    assert made.link.quality(made.now_ns).collisions == 0


def exchange(emulator, payload, second=b''):
    """Return the payload of the RESULT of a TX over the cable, and its statuses."""
    frame = encode_frame(codec.encode(frames.Transmit(7, 0, payload, second)))
    emulator.feed(frame, emulator.now_ns)
    (reply,) = map(codec.decode_from_dongle, replies_of(emulator))
    return reply


def replies_of(emulator):
    blocks = emulator.run_to(emulator.now_ns + 20 * MS)
    return FrameDecoder().feed(b''.join(data for _, data in blocks))


def test_the_second_payload_fetches_the_answer_to_the_first():
    emulator = cable_bench().emulator
    poll = codec.encode(frames.Poll(0, 1, frames.STATE))
    kinds = {frames.STATE: frames.State, frames.AUX: frames.Aux, frames.INFO: frames.Info}
    for what, kind in kinds.items():
        reply = exchange(emulator, codec.encode(frames.Poll(0, 1, what)), poll)
        assert isinstance(codec.decode_uplink(reply.payload), kind)
        assert (reply.first, reply.second) == (3, 3)
    alone = exchange(emulator, poll)
    assert (alone.first, alone.second) == (3, 8)
    assert isinstance(codec.decode_uplink(alone.payload), frames.State)


@pytest.mark.parametrize(
    'frame',
    [b'\x01', b'\x01\x07\0', b'\x01\x07\0\0', b'\x01\x07\0\x05abc', b'\x01\x07\0\x21' + bytes(33)],
)
def test_a_malformed_transaction_is_refused_and_changes_nothing(frame):
    emulator = cable_bench().emulator
    emulator.feed(encode_frame(frame), emulator.now_ns)
    assert replies_of(emulator) == [b'\x8f\x02\x01']
    assert emulator.board.session == 0


def test_the_cable_leaves_the_answer_of_the_radio(bench):
    """A dongle that polls meanwhile gets STATE, not what the cable asked for."""
    emulator = bench.emulator
    emulator.board.receive(codec.encode(frames.Poll(0, 1, frames.INFO)))
    exchange(emulator, codec.encode(frames.Poll(0, 1, frames.AUX)))
    payload = emulator._channel._ack_payload
    assert isinstance(codec.decode_uplink(payload), frames.Info)


def test_of_several_ports_the_dongle_is_meant():
    made = cable_bench()
    made.link.port_opened = lambda now_ns, opened=made.link.port_opened: opened(
        now_ns, cable=False
    )
    made.run(1.0)
    assert made.link.reason(made.now_ns) == reasons.ROBOT_USB
    assert not made.link.over_cable
    assert made.board.session == 0


def test_a_restart_over_the_cable_is_one_of_the_robot(bench):
    bench.inject('robot_reset', 0.3)
    bench.run(3.0, lambda: bench.link.robot_resets == 1)
    quality = bench.link.quality(bench.now_ns)
    assert (quality.robot_resets, quality.dongle_resets) == (1, 0)
