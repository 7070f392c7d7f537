# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The key: drawn into a file, and carried to the robot's board over the board's own USB."""

from collections.abc import Callable
import os
from pathlib import Path
from typing import NoReturn

from t3mpc_ros.radio import frames
from t3mpc_ros.radio.authentication import KeyFileError, key_check
from t3mpc_ros.radio.bench.errand import Ask, ErrandError, Reply, Talk, look
from t3mpc_ros.radio.frames import Key, KeyState, Refusal
from t3mpc_ros.radio.siphash import KEY_SIZE

NO_BOARD = "nothing on the port answers like the robot's board: is it the robot's own USB?"
A_DONGLE = (
    "this is the dongle: a key is written over the USB of the robot's own board; "
    'ls -l /dev/serial/by-id names both'
)
FORGET = bytes(KEY_SIZE)
_PATIENCE = 0.3
_WRITING = 1.0
"""s; 25 cells of 3.4 ms, and a board that is busy with its radio"""
_TRIES = 5


def new_key_file(path: Path, entropy: Callable[[int], bytes]) -> int:
    """Return the check value of a key that was drawn into a new file, mode 600.

    Raises
    ------
    KeyFileError
        There is such a file already, or it cannot be made.
    """
    key = FORGET
    while key == FORGET:  # which means something else
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


def ask_key() -> Talk[KeyState]:
    """Return what the robot says of its key."""
    yield from look(NO_BOARD)
    return (yield from _ask())


def write_key(key: bytes) -> Talk[KeyState]:
    """Let the robot keep a key, or forget the one it has (:data:`FORGET`); return what it says.

    An answer that is lost costs nothing: what counts is what the robot then has.
    """
    yield from look(NO_BOARD)
    yield from _ask()  # a dongle says here that it is one: it never hears the key
    for _ in range(_TRIES):
        heard = yield Ask(Key(0, key), _WRITING)
        reply = heard.reply
        told = reply if isinstance(reply, KeyState) else (yield from _ask())
        if told.rc == frames.BUSY:
            raise ErrandError(
                'the robot takes no key while it moves or its drivers have power: stop the '
                'bridge, or press the reset button of the board'
            )
        if told.rc == frames.FAILED:
            raise ErrandError(
                'the memory of the board does not hold the key: the robot is locked now; try '
                'again, and if that does not help, the chip is worn out'
            )
        if is_kept(told, key):
            return told
    raise ErrandError('the robot does not say that it has the key: is the cable sound?')


def is_kept(told: KeyState, key: bytes) -> bool:
    """Return whether the robot has this key, or none if it is :data:`FORGET`."""
    if key == FORGET:
        return told.state == frames.NO_KEY
    return (told.state, told.check) == (frames.KEY_HELD, key_check(key))


def describe(told: KeyState) -> str:
    """Return in words what the robot has."""
    if told.state == frames.KEY_HELD:
        return f'the robot has a key, check value {told.check:08x}'
    if told.state == frames.KEY_DAMAGED:
        return (
            'the key of the robot is damaged: it can be stopped, but nobody moves it until '
            'radio_tool key write (or key forget) puts that right'
        )
    return 'the robot has no key: anybody with such a radio can drive it'


def _ask() -> Talk[KeyState]:
    for _ in range(_TRIES):
        heard = yield Ask(Key(0), _PATIENCE)
        if isinstance(heard.reply, KeyState):
            return heard.reply
        if isinstance(heard.reply, Refusal):
            _explain(heard.reply)
    raise ErrandError('the board has fallen silent: was it restarted, is the cable sound?')


def _explain(refusal: Reply) -> NoReturn:
    unknown = isinstance(refusal, Refusal) and refusal.code == 1
    raise ErrandError(
        A_DONGLE if unknown else 'the board does not understand: is its firmware old?'
    )
