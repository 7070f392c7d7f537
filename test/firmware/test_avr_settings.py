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
"""Settings of the real firmware in simavr, and builds that follow their options."""

from contextlib import contextmanager
import re
import subprocess
from typing import Any

import pytest
from support.avr_boards import (
    FIRMWARE,
    ROBOT,
    SETTINGS_ADDRESSES,
    Boards,
    booted,
    build,
    drive,
    request,
    settings_record,
)
from support.firmware_core import run_make
from support.long_tests import few_of
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.radio.tool.robot_settings import RobotSettings, decode_settings, encode_settings

pytestmark = needing(*AVR)

NEW = RobotSettings(bytes.fromhex('c25a33a6e1'), 100, microsteps=8)
WRITING = 0.3
"""Sufficient time to write both copies, s: 56 cells of 3.4 ms, started in passes of 0.4 ms."""


def store(boards: Boards, settings: RobotSettings, seconds: float = WRITING) -> list[Any]:
    """Stage and store settings; return the answers to STORE within a time."""
    body = encode_settings(settings)
    for part, data in enumerate(
        (body[: frames.PART_SIZE], body[frames.PART_SIZE :].ljust(frames.PART_SIZE, b'\0'))
    ):
        assert (
            request(boards, frames.Record(2, frames.SETTINGS_RECORD, part, data))[0].rc
            == frames.OK
        )
    return request(boards, frames.Store(2, frames.SETTINGS_RECORD, crc16(body)), seconds)


def read(boards: Boards) -> tuple[int, RobotSettings]:
    """Return state and values of the settings."""
    first, second = (
        request(boards, frames.Record(1, frames.SETTINGS_RECORD, part))[0] for part in (0, 1)
    )
    return first.state, decode_settings((first.data + second.data)[: first.size])


def copy_of(settings: RobotSettings) -> bytes:
    return settings_record(settings.channel, settings.microsteps, settings.address)


def tune(boards: Boards, channel: int, address: bytes) -> None:
    """Configure the radio of the dongle."""
    wanted = frames.Configure(1, channel, 1, 3, 1, 4, address)
    assert boards.ask(wanted)[1:-1] == wanted[1:]


def read_info(boards: Boards) -> Any:
    return boards.request(frames.Poll(0, 0, 2), frames.Poll(0, 0, 2))


def test_an_erased_robot_moves_only_after_its_settings() -> None:
    """A new chip once followed whatever host came first on the default channel."""
    with contextmanager(booted)(1, True) as boards:
        boards.run(0.13)
        assert boards.hello().session == 0
        for _ in range(10):
            assert boards.drive(4000, 4000).status == frames.StatusFlag.NO_SESSION
        assert not boards.call('powered')
        assert read_info(boards).settings == frames.SETTINGS_MISSING
        (pong,) = request(boards, frames.Ping(1, b'ping'))
        assert (pong.settings, pong.channel) == (frames.SETTINGS_MISSING, 82)
        (stored,) = store(boards, NEW)
        assert (stored.id, stored.rc, stored.state) == (2, frames.OK, frames.SETTINGS_GOOD)
        copy = copy_of(NEW)
        assert [boards.eeprom(at, len(copy)) for at in SETTINGS_ADDRESSES] == [copy, copy]
        # The radio follows at once: nothing answers at the old place.
        assert boards.request(frames.Poll(0, 0, 0)) is None
        tune(boards, NEW.channel, NEW.address)
        info = boards.hello()
        assert (info.session, info.microsteps) == (boards.session, 8)
        identity = info.settings, info.channel, info.address
        assert identity == (frames.SETTINGS_GOOD, NEW.channel, NEW.address)
        drive(boards, 0.5, 5000, 5000)
        assert min(boards.pulses()) > 300
        boards.call('reset', ROBOT)
        boards.run(0.15)
        assert boards.hello().microsteps == 8
        (pong,) = request(boards, frames.Ping(3, b'ping'))
        assert pong[-4:-1] == (frames.SETTINGS_GOOD, NEW.channel, NEW.address)


def make(folder: Any, *options: str) -> tuple[str, dict[str, tuple[int, bytes]]]:
    """Build the firmware; return its id, and time and content of both programs."""
    done = run_make(folder, 'avr', *options)
    done.check_returncode()
    (number,) = re.findall(r'^build ([0-9a-f]{8})$', done.stdout, re.MULTILINE)
    files = [folder / name for name in ('dongle.hex', 'robot.hex')]
    return number, {file.name: (file.stat().st_mtime_ns, file.read_bytes()) for file in files}


@pytest.mark.long
def test_a_build_follows_its_options(tmp_path: Any) -> None:
    """`make avr RADIO_CHANNEL=100` after `make avr` once rebuilt nothing."""
    plain, before = make(tmp_path)
    assert make(tmp_path) == (plain, before)  # nothing to do
    other, after = make(tmp_path, 'RADIO_CHANNEL=100')
    assert other != plain
    for name in before:
        assert before[name][1] != after[name][1]
    again, third = make(tmp_path)
    assert again == plain
    assert {name: third[name][1] for name in third} == {name: before[name][1] for name in before}
    for wrong in ('RADIO_CHANNEL=126', 'RADIO_RATE=3'):
        with pytest.raises(subprocess.CalledProcessError):
            make(tmp_path, wrong)


def test_both_boards_report_their_build(boards: Boards) -> None:
    number, _ = make(FIRMWARE / 'build')
    boards.start()
    info, (pong,) = read_info(boards), request(boards, frames.Ping(1, b'ping'))
    assert isinstance(info, frames.Info)
    reply = boards.ask(frames.Ping(2, b'ping'))
    assert isinstance(reply, frames.Pong)
    assert {info.build, pong.build, reply.build} == {int(number, 16)}
    assert (reply.channel, reply.address) == (82, b'T3MPC')


@pytest.mark.parametrize(
    'cuts', few_of([[0.002, WRITING], [0.001, 0.002, 0.003, 0.005, 0.008, 0.012, WRITING]])
)
def test_power_loss_during_a_write_leaves_no_mixture(cuts: list[float]) -> None:
    """Power fails at several times: the old settings or the new ones, in both places."""
    build()
    seen = set()
    for cut in cuts:
        boards = Boards()
        boards.start()
        store(boards, NEW, cut)
        boards.call('reset', ROBOT)
        boards.run(0.15)
        state, found = read(boards)
        assert state in (frames.SETTINGS_GOOD, frames.SETTINGS_ONE_COPY)
        assert found in (RobotSettings(), NEW)
        seen.add(found)
        tune(boards, found.channel, found.address)
        assert boards.hello().session == boards.session
        boards.run(WRITING)
        copy = copy_of(found)
        assert [boards.eeprom(at, len(copy)) for at in SETTINGS_ADDRESSES] == [copy, copy]
        boards.close()
    assert len(seen) == 2


def test_damaged_settings_lock_the_robot(boards: Boards) -> None:
    """It once fell back to 16 microsteps: double speed with jumpers for 8."""
    for at in SETTINGS_ADDRESSES:
        damaged = bytearray(settings_record(82, 8))
        damaged[2] ^= 0x18
        boards.store(at, bytes(damaged))
    boards.run(0.13)
    assert boards.hello().session == 0
    assert drive(boards, 0.3, 4000, 4000).status == frames.StatusFlag.NO_SESSION
    assert boards.pulses() == (0, 0)
    assert read_info(boards).settings == frames.SETTINGS_DAMAGED
