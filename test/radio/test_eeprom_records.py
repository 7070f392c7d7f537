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
"""Settings and calibration of the robot over its USB, against the console of the firmware core."""

import ctypes
from dataclasses import dataclass, field
import json
from pathlib import Path
import random

import pytest
from support.firmware_core import Robot, load_core

from t3mpc_ros.radio.link.actions_and_states import Write
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_from_board, encode
from t3mpc_ros.radio.protocol.frames import Configured, Pong, Refusal
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame
from t3mpc_ros.radio.tool import eeprom_records, robot_settings
from t3mpc_ros.radio.tool.procedure import Procedure
from t3mpc_ros.robot.calibration import Calibration, DividerCorrection, Estimate, SharpCurve

VECTORS = json.loads((Path(__file__).parents[1] / 'golden' / 'radio_vectors.json').read_text())
CURVES = (SharpCurve(0.28, 0.02, 0.05, 0.003), *7 * (None,))
CALIBRATION = Calibration(
    Estimate(0.03512, 2e-5),
    Estimate(0.2012, 1.3e-4),
    Estimate(1.0123, 2e-4),
    Estimate(-0.01, 1e-4),
    DividerCorrection(-0.013, 0.02, 0.01),
    CURVES,
)


@pytest.fixture(scope='module')
def library():
    return load_core()


@dataclass
class Cable:
    """Runs scripts at the console of a robot; each frame is lost with some probability."""

    robot: Robot
    loss: float = 0.0
    source: random.Random = field(default_factory=lambda: random.Random(2))

    def run(self, script):
        """Return the result of a script, or its error text."""
        task = Procedure(script, decode_from_board)
        now_ns, received = 0, b''
        task.port_opened(0)
        while not task.done:
            *actions, wait = task.step(now_ns, received)
            received = b''
            for action in actions:
                if isinstance(action, Write) and self.source.random() >= self.loss:
                    self.robot.call('usb', action.data, len(action.data))
            while now_ns < wait.until_ns and not received:
                self.robot.run(1000)
                now_ns += 1_000_000
                room = ctypes.create_string_buffer(4096)
                size = self.robot.call('usb_take', room, 4096)
                received = room.raw[:size] if self.source.random() >= self.loss else b''
        return task.error or task.result


def test_records_of_the_specification_byte_for_byte():
    golden = dict(VECTORS['records']['settings'])
    body = bytes.fromhex(golden.pop('bytes'))
    golden |= {'address': bytes.fromhex(golden['address']), 'sensors': tuple(golden['sensors'])}
    settings = robot_settings.RobotSettings(**golden)
    assert robot_settings.encode_settings(settings) == body
    assert robot_settings.decode_settings(body) == settings
    wired = settings._replace(battery_wired=True)  # from firmware 2.1
    body = body[:13] + bytes([body[13] | 4]) + body[14:]
    assert robot_settings.encode_settings(wired) == body
    assert robot_settings.decode_settings(body) == wired
    golden = VECTORS['records']['calibration']
    body = bytes.fromhex(golden['bytes'])
    names = 'wheel_radius', 'track', 'gyro_scale', 'gyro_bias'
    calibration = Calibration(
        *(Estimate(*golden[name]) for name in names),
        DividerCorrection(*golden['divider']),
        tuple(curve and SharpCurve(*curve) for curve in golden['curves']),
    )
    assert calibration == CALIBRATION
    assert eeprom_records.encode_calibration(calibration) == body
    # What is read and written again does not drift, and no uncertainty shrinks.
    again = eeprom_records.decode_calibration(body)
    assert eeprom_records.encode_calibration(again) == body
    assert again.gyro_bias.uncertainty >= CALIBRATION.gyro_bias.uncertainty


def test_uncertainties_are_never_stored_as_smaller_or_as_none():
    source = random.Random(3)
    for _ in range(500):
        uncertainty = 10 ** source.uniform(-12, -3)
        estimate = Estimate(source.uniform(0.02, 0.05), uncertainty)
        stored = eeprom_records.decode_calibration(
            eeprom_records.encode_calibration(Calibration(wheel_radius=estimate))
        )
        assert stored.wheel_radius.value == pytest.approx(estimate.value, abs=5.1e-8)
        assert uncertainty * (1 - 1e-6) <= stored.wheel_radius.uncertainty <= uncertainty + 1e-7


@pytest.mark.parametrize(
    'change, words',
    [
        (
            {'wheel_radius': Estimate(0.0, 1e-5)},
            r'wheel_radius must be from 0\.001 to 10',
        ),
        ({'wheel_radius': Estimate(float('nan'), 1e-5)}, 'wheel_radius must be'),
        ({'track': Estimate(0.2, 0.0)}, r'track\.uncertainty must be above 0'),
        ({'track': Estimate(0.2, 0.1)}, r'track\.uncertainty must be above 0'),
        ({'gyro_scale': Estimate(1.3, 1e-3)}, 'gyro_scale must be from 0.8 to 1.2'),
        ({'gyro_bias': Estimate(1.0, 1e-3)}, 'gyro_bias must be'),
        (
            {'divider': DividerCorrection(0.0, 40.0, 0.1)},
            r'divider\.offset must be',
        ),
        ({'curves': ()}, 'curves must be 8'),
        (
            {'curves': (*CURVES[:7], SharpCurve(2.0, 0.0, 0.0, 0.01))},
            r'curves\[7\]\.scale',
        ),
    ],
)
def test_values_that_do_not_fit_are_rejected_before_sending(change, words):
    with pytest.raises(ValueError, match=words):
        next(eeprom_records.write_calibration(CALIBRATION._replace(**change)))


@pytest.mark.parametrize('loss', [0.0, 0.1])
def test_calibration_survives_reset_and_lost_frames(library, loss):
    robot = Robot(library)
    robot.call('set_cell_us', 3400)
    cable = Cable(robot, loss)
    assert cable.run(eeprom_records.read_calibration()) == Calibration()
    stored = cable.run(eeprom_records.write_calibration(CALIBRATION))
    assert eeprom_records.encode_calibration(stored) == eeprom_records.encode_calibration(
        CALIBRATION
    )
    robot.call('boot', 4, 0)
    assert cable.run(eeprom_records.read_calibration()) == stored
    # A value is changed with the others kept.
    changed = stored._replace(gyro_bias=None)
    assert cable.run(eeprom_records.write_calibration(changed)) == changed
    settings = robot_settings.RobotSettings(channel=100, sensors=8 * ('none',))
    body = robot_settings.encode_settings(settings)
    assert cable.run(eeprom_records.write_record(frames.SETTINGS_RECORD, body)) == body
    record = cable.run(eeprom_records.read_record(frames.SETTINGS_RECORD))
    assert (record.valid, robot_settings.decode_settings(record.content)) == (True, settings)


def test_damage_and_bad_timing_have_a_remedy(library):
    robot = Robot(library)
    cable = Cable(robot)
    robot.hello()
    robot.drive(1000, 1000, 40_000)
    assert 'stop the bridge' in cable.run(eeprom_records.write_calibration(CALIBRATION))
    robot.run(1_000_000)
    for copy in (104, 192):
        robot.call('poke_eeprom', copy + 3, 0)
    robot.call('boot', 4, 0)
    assert 'damaged' in cable.run(eeprom_records.read_calibration())
    robot.call('wear', 110, True)
    assert 'worn out' in cable.run(eeprom_records.write_calibration(CALIBRATION))


def test_raw_samples(library):
    robot = Robot(library)
    for channel in range(9):
        robot.call('set_adc', channel, 100 * channel)
    registers = (ctypes.c_int16 * 7)(1, -2, 16384, 0, 4, 5, -6)
    robot.call('set_imu', True, registers)
    cable = Cable(robot)
    samples = cable.run(eeprom_records.read_samples())
    assert eeprom_records.range_counts(samples) == tuple(range(0, 800, 100))
    assert samples[2:] == (800, 1, -2, 16384, 4, 5, -6)
    robot.call('set_imu', False, registers)
    assert cable.run(eeprom_records.read_samples())[3:] == (0, 0, 0, 0, 0, 0)


@pytest.mark.parametrize('dongle', [True, False])
def test_dongle_and_old_firmware_are_distinguished(dongle):
    task = Procedure(eeprom_records.read_calibration(), decode_from_board)
    task.port_opened(0)
    decoder, received = FrameDecoder(), b''
    for now_ns in range(0, 10_000_000_000, 10_000_000):
        for action in task.step(now_ns, received):
            if isinstance(action, Write):
                (data,) = decoder.feed(action.data)
                received = encode_frame(encode(_answer(data, dongle)))
    expected = 'this is the dongle' if dongle else 'make -C firmware flash'
    assert expected in task.error


def _answer(data, dongle):
    if data[0] == 3:
        return Pong(data[1], data[2:], 0, 2, 2, 0, 1, 0, 0, 0, 1, 0, 82, b'T3MPC', 0)
    if data[0] == 2 and dongle:
        return Configured(data[1], 82, 1, 3, 1, 4, b'T3MPC', 1)
    return Refusal(1, data[0])
