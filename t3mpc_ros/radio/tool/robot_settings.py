# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Settings of the robot (radio address, channel, microsteps), over the USB of its board."""

from collections.abc import Callable
from typing import NamedTuple

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import Refusal, Settings, SettingsState
from t3mpc_ros.radio.tool.procedure import ProcedureError, Request, Script, wait_for_board

NO_BOARD = 'no robot board answers on this port: is it the USB port of the robot?'
WRONG_BOARD = (
    'this is the dongle: settings are written over the USB port of the robot board; '
    'ls -l /dev/serial/by-id lists both'
)
SETTINGS_TEXTS = (
    'settings stored in both copies',
    'settings stored, one of their two copies is damaged: t3mpc robot set writes both',
    'no settings: the robot does not move until t3mpc robot set',
    'settings damaged: the robot does not move until t3mpc robot set',
)
"""By state of the settings."""
ADDRESS_SIZE = 5
_REPLY_TIMEOUT = 0.3
_WRITE_TIMEOUT = 1.0
"""s; 24 EEPROM cells of 3.4 ms, and the load of the radio"""
_MAX_ATTEMPTS = 5
_CONFUSABLE = (0x00, 0x55, 0xAA, 0xFF)
"""Bytes that the receiver takes for noise or a preamble (nRF24L01+ data sheet 1.0, 7.3.2)."""


class Changes(NamedTuple):
    """Values to change; None keeps the stored value, or takes the default on a new board."""

    address: bytes | None = None
    channel: int | None = None
    microsteps: int | None = None


def draw_address(entropy: Callable[[int], bytes]) -> bytes:
    """Return a random address; its text is no number, which ROS would not take for a string."""
    while True:
        address = entropy(ADDRESS_SIZE)
        letters = set(address.hex()) & set('abcdf')
        if letters and len(set(address)) > 1 and not set(address) & set(_CONFUSABLE):
            return address


def read_settings() -> Script[SettingsState]:
    """Return the settings of the robot."""
    yield from wait_for_board(NO_BOARD)
    return (yield from _request_settings())


def write_settings(changes: Changes, entropy: Callable[[int], bytes]) -> Script[SettingsState]:
    """Store settings in both copies; return the result.

    A robot without settings gets a random address, so that two robots never obey one host by
    accident. A lost answer is harmless: the settings are read back.
    """
    yield from wait_for_board(NO_BOARD)
    now = yield from _request_settings()
    stored = now.state in (frames.SETTINGS_GOOD, frames.SETTINGS_ONE_COPY)
    address = changes.address or (now.address if stored else draw_address(entropy))
    wanted = Settings(
        0,
        now.channel if changes.channel is None else changes.channel,
        now.microsteps if changes.microsteps is None else changes.microsteps,
        address,
    )
    for _ in range(_MAX_ATTEMPTS):
        response = yield Request(wanted, _WRITE_TIMEOUT)
        reply = response.reply
        if not isinstance(reply, SettingsState):
            reply = yield from _request_settings()
        if reply.rc in _REASONS:
            raise ProcedureError(_REASONS[reply.rc])
        if reply.state == frames.SETTINGS_GOOD and reply[3:] == wanted[1:]:
            return reply
    raise ProcedureError('the robot does not confirm the settings: is the cable good?')


_REASONS = {
    frames.OUT_OF_RANGE: (
        'the robot rejects the settings: channel 0 to 125, microsteps a power of two up to 256, '
        'an address of different bytes'
    ),
    frames.BUSY: (
        'the robot stores no settings while it moves, its drivers are on, or it writes: stop the '
        'bridge, or press the reset button of the board'
    ),
    frames.FAILED: (
        'the EEPROM of the board did not store the settings: the robot is locked; try again; '
        'if it fails repeatedly, the chip is worn out'
    ),
}


def format_settings(settings: SettingsState) -> str:
    """Return the settings as text, with the parameters of the bridge that belong to them."""
    text = (
        f'{SETTINGS_TEXTS[settings.state]}: address {settings.address.hex()}, '
        f'channel {settings.channel}, {settings.microsteps} microsteps'
    )
    if settings.state in (frames.SETTINGS_MISSING, frames.SETTINGS_DAMAGED):
        return text
    return (
        f'{text}\nradio_bridge: -p link.address:={settings.address.hex()} '
        f'-p link.channel:={settings.channel}'
    )


def parameter_file(settings: SettingsState) -> str:
    """Return a ROS parameter file with which a host talks to this robot."""
    # Quoted: 1234567890 would be a number.
    return (
        '# Radio of the robot, written by t3mpc robot set.\n'
        '/**:\n'
        '  ros__parameters:\n'
        '    link:\n'
        f"      address: '{settings.address.hex()}'\n"
        f'      channel: {settings.channel}\n'
    )


def _request_settings() -> Script[SettingsState]:
    for _ in range(_MAX_ATTEMPTS):
        response = yield Request(Settings(0), _REPLY_TIMEOUT)
        if isinstance(response.reply, SettingsState):
            return response.reply
        if isinstance(response.reply, Refusal):
            raise ProcedureError(WRONG_BOARD)
    raise ProcedureError('the board stopped answering: did it restart, is the cable good?')
