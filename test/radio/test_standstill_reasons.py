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
"""Reasons for standstill: each cause is provoked, and its text reported.

Errors of the port are in ``test_serial_port.py`` and are reported unchanged.
"""

from itertools import count
import math

import pytest
from support.emulator_bench import RobotBench
from support.radio_bench import FakeRobot, LinkBench

from t3mpc_ros.nodes import robot_messages
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import Command, CommandFlag, Pong, StatusFlag
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.radio.tool import robot_settings
from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON

KEY = bytes(range(16))
ABSENT = 'the robot does not answer: is it on, in range, on channel 82, at address 54334d5043?'
LATCHED = (
    'the emergency stop of the robot is latched: release its button, then call e_stop of '
    'radio_bridge with false'
)
"""A jog or the checklist said only the first words, as remedy."""


def driving(bench):
    bench.connect()
    bench.drive(3.0, 3.0)
    bench.run(0.5)
    assert reported(bench) == ''


def reported(bench):
    """Return the warnings in diagnostics, most important first."""
    state = bench.robot.advance(bench.now_ns)
    well = bench.robot.quality(bench.now_ns)
    return '; '.join([*robot_messages.state_warnings(state), *([well.text] if well.text else [])])


WHILE_DRIVING = {
    'the commander falls silent': (
        'no command for 0.25 s',
        lambda bench: bench.release_controls(),
    ),
    'a command is not finite': (
        'command is not finite',
        lambda bench: bench.drive(math.nan, 1.0),
    ),
    'a service asks for an emergency stop': (
        'emergency stop: asked for',
        lambda bench: bench.robot.latch_estop('asked for by service e_stop', bench.now_ns),
    ),
    'the button is pressed': (LATCHED, lambda bench: bench.inject('button', 0.1)),
    'a stranger stops the robot': (
        LATCHED,
        lambda bench: bench.board.receive(encode(Command(9, 200, CommandFlag.ESTOP, 0, 0, 0, 0))),
    ),
    'the dongle is pulled out': (
        'dongle is not there',
        lambda bench: bench.inject('close_port', 5.0),
    ),
    'the line is dead': (reasons.DONGLE_TIMEOUT, lambda bench: bench.inject('silence')),
    'the air is jammed': (ABSENT, lambda bench: bench.inject('jam')),
    'the bridge ends': ('the link is shut down', lambda bench: bench.robot.shut_down()),
}
"""What happens to a moving robot, and what is reported 0.6 s later."""
FROM_THE_START = {
    'no command': ('no command yet', {}, None),
    'the radio chip is dead': (reasons.NO_CHIP, {}, ('radio_dead',)),
    'the robot is off': (ABSENT, {}, ('robot_reset', math.inf)),
    'the keys differ': ('the keys differ', {'key': KEY, 'robot_key': bytes(16)}, None),
    'the host has no key': (reasons.HOST_KEY_MISSING, {'robot_key': KEY}, None),
    'the robot has no key': (reasons.ROBOT_KEY_MISSING, {'key': KEY, 'robot_key': b''}, None),
}
"""What is reported after a second, and the arguments of the bench and of its fault."""


@pytest.mark.parametrize('reason, provoke', WHILE_DRIVING.values(), ids=WHILE_DRIVING)
def test_what_stops_a_moving_robot_is_reported(reason, provoke):
    bench = RobotBench()
    driving(bench)
    provoke(bench)
    bench.run(0.6)
    assert reason in reported(bench)


@pytest.mark.parametrize('reason, given, fault', FROM_THE_START.values(), ids=FROM_THE_START)
def test_why_a_robot_does_not_start_is_reported(reason, given, fault):
    bench = RobotBench(**given)
    if fault is not None:
        bench.inject(*fault)
    bench.run(1.0)
    assert reason in reported(bench)


CAUSES = {}


def cause(reason, **given):
    """Register a cause: its reported reason, and the arguments of its bench."""

    def note(provoke):
        CAUSES[provoke.__name__] = reason, given, provoke
        return provoke

    return note


@cause('is its button still pressed?')
def the_button_is_held_while_it_is_released(bench):
    driving(bench)
    bench.inject('button')
    bench.run(0.3)
    bench.robot.release_estop(bench.now_ns)
    bench.run(1.5)


@cause('no dongle answers on this port')
def another_device_is_at_the_port(bench):
    bench.inject('silence')
    bench.run(8.0)


@cause('of the cycles are lost on the radio')
def the_air_is_bad(bench):
    driving(bench)
    bench.inject('loss', math.inf, 0.35)
    bench.run(5.0)


@cause('of the cycles are lost on the cable')
def the_cable_is_bad(bench):
    """30 % of the frames were damaged, and the radio was blamed."""
    driving(bench)
    bench.inject('flip_bits', math.inf, 0.005)
    bench.run(8.0)


@cause('of the cycles are lost at the dongle: no reply')
def the_dongle_loses_frames(bench):
    driving(bench)
    for _ in range(20):
        bench.inject('silence', 0.02)
        bench.run(0.3)


@cause('of the cycles are lost at the robot')
def the_robot_is_too_slow_with_its_state(bench):
    driving(bench)
    load, number = bench.board._load, count()
    bench.board._load = lambda payload: next(number) % 3 and load(payload)
    bench.run(2.5)


@cause('the robot has no settings', erased=True)
def the_robot_was_never_set_up(bench):
    bench.drive(3.0, 3.0)
    bench.run(1.0)
    assert bench.board.counters == (0, 0)


@cause('below its cut-off', flat={'twin.faults.supply_sag': 3.8})
def the_battery_is_empty(bench):
    bench.connect()
    bench.drive(3.0, 3.0)
    bench.run(3.0)
    assert not bench.board.powered


@cause('the inertial sensor does not answer', flat={'twin.faults.gyro_dead': True})
def the_inertial_sensor_is_dead(bench):
    driving_with_complaints(bench)


@cause('the battery is low: 10.0 V', flat={'twin.faults.supply_sag': 2.5})
def the_battery_is_low(bench):
    driving_with_complaints(bench)


@cause(SLIP_STOP_REASON, flat={'twin.faults.wheel_blocked': 'left'})
def a_wheel_is_blocked(bench):
    bench.connect()
    bench.run(2.5)  # calibration of the gyro bias: the drives shake the robot when they hold it
    bench.drive(4.0, 4.0)
    bench.run(2.0)


@cause('the robot has lost its session')
def the_robot_has_forgotten_the_session(bench):
    """Reported during the new handshake, until the robot answers."""
    driving(bench)
    bench.inject('robot_reset', 0.01)
    bench.run(1.0, lambda: bench.link.state is LinkState.HELLO)


@cause('measures no battery voltage, but its settings say that the battery is wired')
def the_wire_of_the_battery_breaks(bench):
    settings = robot_settings.encode_settings(robot_settings.RobotSettings(battery_wired=True))
    body = settings + crc16(settings).to_bytes(2, 'little')
    for copy in (40, 72):
        bench.board.write_eeprom(copy, body)
    bench.inject('robot_reset', 0.1)
    bench.run(1.0)
    driving(bench)
    bench.inject('battery_wire')
    bench.run(6.0)
    assert bench.board.speeds == (0, 0)


@cause('')
def an_unwired_battery_is_not_missed(bench):
    bench.inject('battery_wire')
    driving(bench)
    bench.run(6.0)
    assert bench.followed[-1][1].left == 3000


def driving_with_complaints(bench):
    bench.connect()
    bench.drive(2.0, 2.0)
    bench.run(5.0)  # the battery measurement is filtered
    assert bench.followed[-1][1].left == 2000  # a warning, no reason to stand


@pytest.mark.parametrize('name', CAUSES)
@pytest.mark.slow
def test_each_cause_is_reported_with_its_reason(name):
    reason, given, provoke = CAUSES[name]
    bench = RobotBench(**given)
    provoke(bench)
    print(f'\n{name}: {reported(bench)}')
    assert reason in reported(bench)


# -- robots and dongles with unusual behaviour ----------------------------------------------------


class UnusualRobot(FakeRobot):
    """Reports configurable status bits and information."""

    add, drop, protocol, accepts = StatusFlag(0), StatusFlag(0), frames.VERSION, True

    def status(self):
        return (super().status() | self.add) & ~self.drop

    def info(self, seq, now_ns):
        info = super().info(seq, now_ns)._replace(protocol=self.protocol)
        return info if self.accepts else info._replace(session=0)


@pytest.mark.parametrize(
    'odd, reason',
    [
        ({'add': StatusFlag.TTL_EXPIRED}, reasons.TTL_EXPIRED),
        ({'drop': StatusFlag.ENABLED}, reasons.DRIVES_DISABLED),
        ({'protocol': 3}, reasons.robot_version(3)),
        ({'accepts': False}, reasons.refused('HELLO', 0)),
        (
            {'settings': frames.SETTINGS_DAMAGED, 'accepts': False},
            reasons.SETTINGS[frames.SETTINGS_DAMAGED],
        ),
    ],
)
def test_an_unusual_robot_is_reported(odd, reason):
    robot = UnusualRobot()
    for name, value in odd.items():
        setattr(robot, name, value)
    bench = LinkBench(robot=robot)
    bench.drive(3.0, 3.0)
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == reason


def test_a_robot_of_version_1_is_reported():
    """It answers everything of another version with its STATE."""
    bench, older = LinkBench(), b'\x11' + bytes(31)
    bench.dongle.change = lambda reply: (
        reply._replace(payload=older) if getattr(reply, 'payload', b'') else reply
    )
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == reasons.robot_version(1)


def test_a_dongle_with_another_protocol_is_reported():
    bench = LinkBench()
    bench.dongle.change = lambda reply: (
        reply._replace(protocol=3) if isinstance(reply, Pong) else reply
    )
    bench.run(1.0)
    assert bench.link.reason(bench.now_ns) == 'the dongle must speak protocol 2: it speaks 3'


@pytest.mark.parametrize(
    'silent, why',
    [
        (('silence', 1.0), reasons.DONGLE_TIMEOUT),
        (('close_port', 1.0), 'dongle is not there'),
        (('jam', 1.0), 'the robot does not answer'),
    ],
)
def test_a_stop_that_does_not_reach_the_robot_is_said(silent, why):
    """The answer was that the stop is latched, while the dongle was silent."""
    bench = RobotBench()
    driving(bench)
    bench.inject(*silent)
    bench.run(0.6)
    for _ in range(2):
        assert why in bench.robot.latch_estop('asked for', bench.now_ns)
    assert why in bench.robot.reason(bench.now_ns), 'no word that it has stopped'
    assert not bench.link.telemetry.status.estop
    bench.run(4.0)
    assert bench.link.telemetry.status.estop, 'it is sent as soon as the robot answers'
    assert bench.robot.latch_estop('asked for', bench.now_ns) == ''
