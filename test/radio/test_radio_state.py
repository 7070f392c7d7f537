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
from support.object_state import differences
from support.other_parameters import with_other_value
from support.properties import PROPERTY
from support.radio_bench import FakeRobot, LinkBench

from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.telemetry import CommandTiming, TelemetryDecoder
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.radio_robot import RadioRobot, RadioRobotParameters

KEY = bytes(range(16))
SEEDS = st.integers(0, 2**32 - 1)
SECOND = 10**9


def telemetry_decoders(source):
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


def _live(source, make):
    """Return a bench after any history that ends with a port and a robot, still to connect."""
    bench = make(source)
    dongle, link = bench.dongle, bench.link
    actions = (
        lambda: bench.drive(source.uniform(-5, 5), source.uniform(-5, 5)),
        lambda: link.latch_estop('because'),
        lambda: link.release_estop(bench.now_ns),
        lambda: bench.robot.boot(bench.now_ns, source.randrange(2**32)),
        lambda: dongle.restart(bench.now_ns),
        bench.unplug,
        bench.plug,
        lambda: setattr(dongle, 'loss', source.choice([0.0, 0.3, 1.0])),
        lambda: setattr(dongle, 'version', source.choice([frames.VERSION, 99])),
        lambda: setattr(dongle, 'drop_replies', source.randrange(30)),
        lambda: setattr(bench, 'problem', ('busy', source.random() < 0.5)),
    )
    for _ in range(source.randrange(1, 7)):
        source.choice(actions)()
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
    '_transactions._decoder._frames', '_transactions._decoder._crc_errors',
    '_transactions._decoder._frame_errors',
)  # fmt: skip
"""What a link keeps over its sessions: emergency stop and command, counters, angles."""


def links(source):
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
    pending = [
        f'_transactions.{name}' for name in ('_dongle', '_pending.frame', '_pending.request')
    ]
    yield used.link, fresh.link, (*LINK_KEPT, *pending), at[used], at[fresh]


@given(seed=SEEDS)
@PROPERTY
def test_telemetry_of_a_restarted_robot_is_as_new(seed):
    for used, fresh, kept in telemetry_decoders(random.Random(seed)):
        assert differences(used, fresh, kept) == {}


@pytest.mark.slow
@given(seed=SEEDS)
@settings(PROPERTY, max_examples=8)
def test_a_link_is_as_new_after_another_port_and_session(seed):
    for used, fresh, kept, *times in links(random.Random(seed)):
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
