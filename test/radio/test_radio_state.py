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
"""After any history and a change, each object of the radio answers as a newly built one."""

import math
import random

from hypothesis import given, settings
from hypothesis import strategies as st
import pytest
from support.emulator_bench import MS
from support.fresh_state import classes_of
from support.object_state import differences
from support.other_parameters import with_other_value
from support.properties import PROPERTY
from support.radio_bench import FakeDongle, FakeRobot, LinkBench

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.radio.link.handshake import Handshake, Session
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import LinkState
from t3mpc_ros.radio.link.statistics import LinkStatistics
from t3mpc_ros.radio.link.telemetry import CommandTiming, TelemetryDecoder
from t3mpc_ros.radio.link.transaction import TransactionLayer, TransactionResult
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import Signer, session_key
from t3mpc_ros.radio.protocol.clock_sync import ClockModel, CounterUnwrapper
from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame
from t3mpc_ros.radio.radio_robot import RadioRobot, RadioRobotParameters
from t3mpc_ros.robot.interface import RobotCommand

KEY = bytes(range(16))
SEEDS = st.integers(0, 2**32 - 1)
SECOND = 10**9


def a_frame_decoder(source):
    """``reset`` keeps the counters."""
    used = FrameDecoder()
    for _ in range(source.randrange(1, 6)):
        wire = encode_frame(source.randbytes(source.randrange(1, 60)))
        used.feed(source.randbytes(source.randrange(200)) + wire[: source.randrange(len(wire))])
    used.reset()
    yield used, FrameDecoder(), ('_frames', '_crc_errors', '_frame_errors')
    rest = encode_frame(b'next')
    yield used.feed(rest), FrameDecoder().feed(rest), ()


def a_transaction_layer(source):
    """``reset`` keeps the number of the last request and the counters."""
    used, dongle = TransactionLayer(LinkStatistics(0.02, 0.2)), FakeDongle(FakeRobot())
    now_ns = 5 * SECOND
    for _ in range(source.randrange(1, 8)):
        now_ns += source.randrange(1, 200) * MS
        replies = dongle.receive(used.ping(50 * MS, now_ns), now_ns)
        if source.random() < 0.5:
            used.feed(replies[0][1] + source.randbytes(source.randrange(30)), now_ns + 2 * MS)
        else:
            used.expire(now_ns + 60 * MS)
    used.reset()
    fresh = TransactionLayer(LinkStatistics(0.02, 0.2))
    yield used, fresh, ('_id', '_statistics', *(f'_decoder.{name}' for name in COUNTERS))


COUNTERS = '_frames', '_crc_errors', '_frame_errors'


def a_counter(source):
    """``rebase`` keeps the total."""
    used, fresh = CounterUnwrapper(), CounterUnwrapper()
    for _ in range(source.randrange(5)):
        used.add(source.randrange(2**32))
    before = used.total
    used.rebase()
    yield used, fresh, ('total',)
    for _ in range(3):
        value = source.randrange(2**32)
        yield used.add(value) - before, fresh.add(value), ()


def a_clock_model(source):
    """``reset`` keeps nothing."""
    used, fresh = ClockModel(), ClockModel()
    _fill_clock(used, source)
    used.reset()
    yield used, fresh, ()
    seed = source.random()
    for model in (used, fresh):
        _fill_clock(model, random.Random(seed))
    yield used, fresh, ()


def _fill_clock(model, source):
    robot_us, now_ns = source.randrange(10**9), source.randrange(10**12)
    for _ in range(source.randrange(1, 20)):
        robot_us += source.randrange(10_000, 3_000_000)
        now_ns += source.randrange(10, 3000) * MS
        model.add(robot_us, now_ns, now_ns + source.randrange(1, 9) * MS, 600_000)


def a_telemetry_decoder(source):
    """A restart of the robot keeps the angles of the wheels, and what was configured."""
    robot = FakeRobot()
    used, fresh = TelemetryDecoder(), TelemetryDecoder()
    now_ns = 5 * SECOND
    robot.boot(now_ns, source.randrange(2**32), (source.randrange(2**31), source.randrange(2**31)))
    used.start_session(1, robot.boots, now_ns)
    for _ in range(source.randrange(1, 10)):
        now_ns += source.randrange(1, 800) * MS
        robot.speeds, robot.until_ns = (source.uniform(-9, 9), source.uniform(-9, 9)), now_ns
        _decode(used, robot, now_ns, source.random() < 0.8, 1)
    if source.random() < 0.5:
        for each in (used, fresh):
            each.configure(400 * 16, 1000)
    before = used.angles
    now_ns += source.randrange(1, 5) * SECOND
    robot.boot(now_ns, source.randrange(2**32))
    for each in (used, fresh):
        each.start_session(2, robot.boots, now_ns)
    kept = '_base', '_time.total', '_left.total', '_right.total', '_former_boots'
    for _ in range(3):
        now_ns += 20 * MS
        got, expected = (_decode(each, robot, now_ns, True, 2) for each in (used, fresh))
        angles = [a - b for a, b in zip(got.angles, before, strict=True)]
        assert angles == pytest.approx(expected.angles, abs=1e-6)
        yield got, expected._replace(angles=got.angles), ()
        clock = '_clock._origin_us', '_clock._samples'  # by the counter of robot time
        yield used, fresh, (*kept, *clock)


def _decode(decoder, robot, now_ns, timed, session):
    robot.command_ns = now_ns - 5 * MS
    timing = CommandTiming(now_ns - 6 * MS, MS) if timed else None
    state = robot.state(now_ns)._replace(session=session)
    return decoder.decode(state, now_ns, timing)


def a_handshake(source):
    """Lost and foreign answers keep the text of the reason only."""
    parameters, robot, now_ns = LinkParameters(), FakeRobot(), 5 * SECOND
    session = Session(b'', source.randbytes, 0, now_ns)
    used, fresh = (
        Handshake(session, parameters, 'because', 'absent', 'no reply') for _ in range(2)
    )
    while fresh.state is not LinkState.RUN:
        for _ in range(source.randrange(45)):
            request, _ = used.next_request(now_ns)
            foreign = robot.state(now_ns) if used.state is LinkState.PARAMS else None
            used.handle(_result(request, source.choice([None, foreign])))
        request, _ = used.next_request(now_ns)
        robot.receive(encode(request), now_ns)
        for each in (used, fresh):
            if isinstance(request, frames.ParamGet | frames.ParamSet):
                each.next_request(now_ns)
            each.handle(_result(request, robot.answer))
        yield used, fresh, ('reason', '_session')


def _result(request, uplink):
    return TransactionResult(request, None, uplink, 0, 0, None, False)


def a_session(source):
    """A repeated HELLO keeps number and nonce; commands are signed from the last one on."""
    now_ns = source.randrange(2**40)
    used = Session(KEY, random.Random(1).randbytes, 0, now_ns)
    robot = FakeRobot(KEY)
    for _ in range(source.randrange(1, 6)):
        now_ns += source.randrange(2**40)
        hello = used.hello(now_ns)
    robot.receive(encode(hello), now_ns)
    assert used.accept(robot.answer) == ''
    keys = hello.nonce, robot.answer.nonce
    yield used._signer, Signer(session_key(KEY, *keys), hello.host_us), ()
    for _ in range(4):
        now_ns += source.randrange(2**32) * 1000
        used.echo_us = robot.time_us(now_ns)
        command = used.command(0, 20, 0, 0, now_ns)
        yield robot.verifier.verify(command), frames.RefusalReason.NONE, ()


def a_signer(source):
    """Frames of the past keep the number of wraps."""
    stamps = sorted(source.sample(range(2**32), 4))
    used = Signer(KEY, 0)
    for stamp in stamps:
        used.sign(frames.Command(1, 1, 0, 20, 0, 0, 0, stamp))
    fresh = Signer(KEY, stamps[-1])
    yield used, fresh, ()
    wrapped = frames.Command(1, 1, 0, 20, 0, 0, 0, stamps[-1] - 1)
    yield used.sign(wrapped), fresh.sign(wrapped), ()
    yield used.epoch, 1, ()


def _live(source, make):
    """Return a bench after any history that ends with a port and a robot, still to connect."""
    bench = make(source)
    for _ in range(source.randrange(1, 7)):
        action = source.randrange(11)
        if action == 0:
            bench.drive(source.uniform(-5, 5), source.uniform(-5, 5))
        elif action == 1:
            bench.link.latch_estop('because')
        elif action == 2:
            bench.link.release_estop(bench.now_ns)
        elif action == 3:
            bench.robot.boot(bench.now_ns, source.randrange(2**32))
        elif action == 4:
            bench.dongle.restart(bench.now_ns)
        elif action == 5:
            bench.unplug()
        elif action == 6:
            bench.plug()
        elif action == 7:
            bench.dongle.loss = source.choice([0.0, 0.3, 1.0])
        elif action == 8:
            bench.dongle.version = source.choice([frames.VERSION, 99])
        elif action == 9:
            bench.dongle.drop_replies = source.randrange(30)
        else:
            bench.problem = source.choice([('busy', False), ('dongle is not there', True)])
        bench.run(source.uniform(0.01, 2.5))
    bench.release_controls()
    bench.link.release_estop(bench.now_ns)  # a link that is stopped sends that first of all
    bench.dongle.version, bench.dongle.loss, bench.dongle.drop_replies = frames.VERSION, 0.0, 0
    bench.problem = 'dongle is not there', True
    return bench


LINK_KEPT = (
    '_arbiter', '_statistics', '_decoder', 'telemetry', '_received_ns', 'info',
    '_board_parameters', '_transactions._id', '_transactions._statistics', '_session.number',
    '_session._nonce', '_session._last_us', '_session._hello_us', '_session._signer', '_estop_ns',
    '_active._arbiter', '_active._statistics', '_active._session',
    *(f'_transactions._decoder.{name}' for name in COUNTERS),
)  # fmt: skip
"""What a link keeps over its sessions: emergency stop and command, counters, angles."""


def a_link(source):
    """A new port and a new session keep :data:`LINK_KEPT` only."""
    key = source.choice([b'', KEY])
    make = lambda source: LinkBench(key=key, seed=source.randrange(2**16))  # noqa: E731
    used, fresh = _live(source, make), make(source)
    used.unplug()
    used.run(0.5)
    used.plug()
    at = {}
    for bench in (used, fresh):
        bench.run(60.0, lambda bench=bench: bench.link.state is LinkState.PING)
        at[bench] = bench.now_ns
    kept = (*LINK_KEPT, '_session', '_reopen_ns', '_transactions._pending')
    yield used.link, fresh.link, kept, at[used], at[fresh]
    for bench in (used, fresh):
        bench.run(60.0, lambda bench=bench: bench.link.state is LinkState.RUN)
        at[bench] = bench.now_ns
    numbers = (
        '_transactions._dongle',
        '_transactions._pending.frame',
        '_transactions._pending.request',
    )
    yield used.link, fresh.link, (*LINK_KEPT, *numbers), at[used], at[fresh]


def a_radio_robot(source):
    """``reset_odometry`` keeps all but the pose; ``configure`` keeps all but the parameters."""
    robot = RadioRobot(RadioRobotParameters(), entropy=random.Random(1).randbytes)
    robot._odometry.update(1.0, 1.2, 0.1, 0.02)
    robot._state = robot._state._replace(
        odometry=robot._state.odometry._replace(pose=robot._odometry.pose)
    )
    assert robot.reset_odometry(0) == ''
    fresh = RadioRobot(RadioRobotParameters(), entropy=random.Random(1).randbytes)
    yield robot.advance(0).odometry, fresh.advance(0).odometry, ()
    yield robot._odometry.pose, fresh._odometry.pose, ()
    robot.apply(RobotCommand(WheelSpeeds(1.0, 1.0), 0), 0)


TABLE = {
    'FrameDecoder': a_frame_decoder,
    'TransactionLayer': a_transaction_layer,
    'CounterUnwrapper': a_counter,
    'ClockModel': a_clock_model,
    'TelemetryDecoder': a_telemetry_decoder,
    'Handshake': a_handshake,
    'Session': a_session,
    'Signer': a_signer,
    'Link': a_link,
    'RadioRobot': a_radio_robot,
}
"""Each yields pairs that must be equal, but for what its docstring says is kept."""
EXCEPTIONS = {
    'SetpointArbiter': 'compared with a model in test_link_histories.py',
    'LinkStatistics': 'counts since the port was first opened',
    'ActiveSession': 'one session; part of Link',
    'SerialPort': 'one connection; see test_open_files.py',
    '_Form': 'a table of constants',
    **dict.fromkeys(
        ('CalibrationRobot', 'CalibrationWizard', 'Jog', 'Manoeuvre', 'Rest', 'HandTurn',
         'Procedure', '_PortRunner'),
        'one run of a bench command',
    ),
}  # fmt: skip
"""Classes without a change after which they are as new."""


def test_every_stateful_class_is_in_the_table():
    assert classes_of(('radio',)).keys() == TABLE.keys() | EXCEPTIONS.keys()
    assert not TABLE.keys() & EXCEPTIONS.keys()


@pytest.mark.parametrize('name', [name for name in TABLE if name != 'Link'])
@given(seed=SEEDS)
@PROPERTY
def test_after_a_change_an_object_is_as_new(name, seed):
    for used, fresh, kept in TABLE[name](random.Random(seed)):
        assert differences(used, fresh, kept) == {}


@pytest.mark.slow
@given(seed=SEEDS)
@settings(PROPERTY, max_examples=12)
def test_a_link_is_as_new_after_another_port_and_session(seed):
    for used, fresh, kept, *times in a_link(random.Random(seed)):
        assert differences(used, fresh, kept, *times) == {}


DYNAMIC = [spec for spec in RadioRobotParameters.specs() if spec.dynamic]


@pytest.mark.parametrize('spec', DYNAMIC, ids=lambda spec: spec.name)
def test_a_robot_configured_anew_is_as_one_built_so(spec):
    before = RadioRobotParameters()
    after = with_other_value(before, spec)
    made, built = (RadioRobot(each, entropy=bytes) for each in (before, after))
    made.configure(after)
    assert differences(made, built) == {}
    assert math.isnan(made.advance(0).wheels.right)
