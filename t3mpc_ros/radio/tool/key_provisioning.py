# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Key provisioning: key generation into a file, and transfer over the USB of the robot board."""

from collections.abc import Callable
import os
from pathlib import Path
from typing import NoReturn

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KEY_SIZE, KeyFileError, key_check
from t3mpc_ros.radio.protocol.frames import Key, KeyState, Refusal
from t3mpc_ros.radio.tool.procedure import (
    ProcedureError,
    ReplyFrame,
    Request,
    Script,
    wait_for_board,
)

NO_BOARD = "nothing on the port answers like the robot's board: is it the robot's own USB?"
WRONG_BOARD = (
    "this is the dongle: a key is written over the USB of the robot's own board; "
    'ls -l /dev/serial/by-id names both'
)
ERASE_KEY = bytes(KEY_SIZE)
_REPLY_TIMEOUT = 0.3
_WRITE_TIMEOUT = 1.0
"""s; 25 cells of 3.4 ms, and a board that is busy with its radio"""
_MAX_ATTEMPTS = 5


def create_key_file(path: Path, entropy: Callable[[int], bytes]) -> int:
    """Return the check value of a key that was drawn into a new file, mode 600.

    Raises
    ------
    KeyFileError
        There is such a file already, or it cannot be made.
    """
    key = ERASE_KEY
    while key == ERASE_KEY:  # which means something else
        key = entropy(KEY_SIZE)
    try:
        # Never through a link or over a file, and closed to others from the first moment on.
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise KeyFileError(
            f'{path} is there already: a key is never overwritten; choose another name'
        ) from None
    except OSError as error:
        raise KeyFileError(f'{path} cannot be made: {error.strerror}') from error
    with os.fdopen(handle, 'w') as target:
        target.write(key.hex() + '\n')
    return key_check(key)


def read_key_state() -> Script[KeyState]:
    """Return what the robot says of its key."""
    yield from wait_for_board(NO_BOARD)
    return (yield from _request_key_state())


def write_key(key: bytes) -> Script[KeyState]:
    """Let the robot keep a key, or forget the one it has (:data:`FORGET`); return what it says.

    An answer that is lost costs nothing: what counts is what the robot then has.
    """
    yield from wait_for_board(NO_BOARD)
    yield from _request_key_state()  # a dongle says here that it is one: it never hears the key
    for _ in range(_MAX_ATTEMPTS):
        heard = yield Request(Key(0, key), _WRITE_TIMEOUT)
        reply = heard.reply
        told = reply if isinstance(reply, KeyState) else (yield from _request_key_state())
        if told.rc == frames.BUSY:
            raise ProcedureError(
                'the robot takes no key while it moves or its drivers have power: stop the '
                'bridge, or press the reset button of the board'
            )
        if told.rc == frames.FAILED:
            raise ProcedureError(
                'the memory of the board does not hold the key: the robot is locked now; try '
                'again, and if that does not help, the chip is worn out'
            )
        if holds_key(told, key):
            return told
    raise ProcedureError('the robot does not say that it has the key: is the cable sound?')


def holds_key(told: KeyState, key: bytes) -> bool:
    """Return whether the robot has this key, or none if it is :data:`FORGET`."""
    if key == ERASE_KEY:
        return told.state == frames.NO_KEY
    return (told.state, told.check) == (frames.KEY_HELD, key_check(key))


def format_key_state(told: KeyState) -> str:
    """Return in words what the robot has."""
    if told.state == frames.KEY_HELD:
        return f'the robot has a key, check value {told.check:08x}'
    if told.state == frames.KEY_DAMAGED:
        return (
            'the key of the robot is damaged: it can be stopped, but nobody moves it until '
            't3mpc robot key write (or key forget) puts that right'
        )
    return 'the robot has no key: anybody with such a radio can drive it'


def _request_key_state() -> Script[KeyState]:
    for _ in range(_MAX_ATTEMPTS):
        heard = yield Request(Key(0), _REPLY_TIMEOUT)
        if isinstance(heard.reply, KeyState):
            return heard.reply
        if isinstance(heard.reply, Refusal):
            _raise_refusal(heard.reply)
    raise ProcedureError('the board has fallen silent: was it restarted, is the cable sound?')


def _raise_refusal(refusal: ReplyFrame) -> NoReturn:
    unknown = isinstance(refusal, Refusal) and refusal.code == 1
    raise ProcedureError(
        WRONG_BOARD if unknown else 'the board does not understand: is its firmware old?'
    )
