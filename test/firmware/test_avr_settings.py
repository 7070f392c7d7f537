# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
    missing_tools,
    request,
    settings_record,
)
from support.long_tests import few_of

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import (
    OK,
    Configure,
    Info,
    Ping,
    Poll,
    Pong,
    Settings,
    SettingsState,
    StatusFlag,
)

pytestmark = pytest.mark.skipif(bool(missing_tools()), reason=f'not installed: {missing_tools()}')

NEW = Settings(2, 100, 8, bytes.fromhex('c25a33a6e1'))
STORED = SettingsState(2, OK, frames.SETTINGS_GOOD, *NEW[1:])
WRITING = 0.3
"""Sufficient time to write both copies, s: 24 cells of 3.4 ms, started in passes of 0.4 ms."""


def tune(boards: Boards, channel: int, address: bytes) -> None:
    """Configure the radio of the dongle."""
    wanted = Configure(1, channel, 1, 3, 1, 4, address)
    assert boards.ask(wanted)[1:-1] == wanted[1:]


def read_info(boards: Boards) -> Any:
    return boards.request(Poll(0, 0, 2), Poll(0, 0, 2))


def test_an_erased_robot_moves_only_after_its_settings() -> None:
    """A new chip once followed whatever host came first on the default channel."""
    with contextmanager(booted)(1, True) as boards:
        boards.run(0.13)
        assert boards.hello().session == 0
        for _ in range(10):
            assert boards.drive(4000, 4000).status == StatusFlag.NO_SESSION
        assert not boards.call('powered')
        assert read_info(boards).settings == frames.SETTINGS_MISSING
        (pong,) = request(boards, Ping(1, b'ping'))
        assert (pong.settings, pong.channel) == (frames.SETTINGS_MISSING, 82)
        assert request(boards, NEW, WRITING) == [STORED]
        copy = settings_record(*NEW[1:])
        assert [boards.eeprom(at, len(copy)) for at in SETTINGS_ADDRESSES] == [copy, copy]
        # The radio follows at once: nothing answers at the old place.
        assert boards.request(Poll(0, 0, 0)) is None
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
        (pong,) = request(boards, Ping(3, b'ping'))
        assert pong[-4:-1] == (frames.SETTINGS_GOOD, NEW.channel, NEW.address)


@pytest.mark.parametrize(
    'cuts', few_of([[0.01, WRITING], [0.002, 0.01, 0.03, 0.05, 0.08, WRITING]])
)
def test_power_loss_during_a_write_leaves_no_mixture(cuts: list[float]) -> None:
    """Power fails at several times: the old settings or the new ones, in both places."""
    build()
    seen = set()
    for cut in cuts:
        boards = Boards()
        boards.start()
        request(boards, NEW, cut)
        boards.call('reset', ROBOT)
        boards.run(0.15)
        ((_, rc, state, *values),) = request(boards, Settings(1))
        assert rc == OK
        assert state in (frames.SETTINGS_GOOD, frames.SETTINGS_ONE_COPY)
        assert tuple(values) in ((82, 16, b'T3MPC'), NEW[1:])
        seen.add(tuple(values))
        tune(boards, values[0], values[2])
        assert boards.hello().session == boards.session
        boards.run(WRITING)
        copy = settings_record(*values)
        assert [boards.eeprom(at, len(copy)) for at in SETTINGS_ADDRESSES] == [copy, copy]
        boards.close()
    assert len(seen) == 2


def test_damaged_settings_lock_the_robot() -> None:
    """It once fell back to 16 microsteps: double speed with jumpers for 8."""
    build()
    boards = Boards()
    for at in SETTINGS_ADDRESSES:
        damaged = bytearray(settings_record(82, 8))
        damaged[2] ^= 0x18
        boards.store(at, bytes(damaged))
    boards.run(0.13)
    assert boards.hello().session == 0
    assert drive(boards, 0.3, 4000, 4000).status == StatusFlag.NO_SESSION
    assert boards.pulses() == (0, 0)
    assert read_info(boards).settings == frames.SETTINGS_DAMAGED
    boards.close()


def make(folder: Any, *options: str) -> tuple[str, dict[str, tuple[int, bytes]]]:
    """Build the firmware; return its id, and time and content of both programs."""
    command = ['make', '-C', str(FIRMWARE), 'avr', f'BUILD={folder}', *options]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
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


def test_both_boards_report_their_build() -> None:
    build()
    number, _ = make(FIRMWARE / 'build')
    boards = Boards()
    boards.start()
    info, (pong,) = read_info(boards), request(boards, Ping(1, b'ping'))
    assert isinstance(info, Info)
    reply = boards.ask(Ping(2, b'ping'))
    assert isinstance(reply, Pong)
    assert {info.build, pong.build, reply.build} == {int(number, 16)}
    assert (reply.channel, reply.address) == (82, b'T3MPC')
    boards.close()
