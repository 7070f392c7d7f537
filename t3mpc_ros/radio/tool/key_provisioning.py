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
"""Key provisioning: key generation into a file, and transfer over the USB of the robot board."""

from collections.abc import Callable
import os
from pathlib import Path

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import KEY_SIZE, KeyFileError, key_check
from t3mpc_ros.radio.protocol.frames import Key, KeyState
from t3mpc_ros.radio.tool import procedure
from t3mpc_ros.radio.tool.eeprom_records import check_stored

ERASE_KEY = bytes(KEY_SIZE)
_WRITE_TIMEOUT = 1.0  # s; 25 EEPROM cells of 3.4 ms, and the load of the radio
_MAX_ATTEMPTS = 5


def create_key_file(path: Path, entropy: Callable[[int], bytes]) -> int:
    """Generate a key into a new file with mode 600; return its check value."""
    key = ERASE_KEY
    while key == ERASE_KEY:  # reserved
        key = entropy(KEY_SIZE)
    try:
        # O_EXCL follows no link and overwrites no file; the mode protects it from the start.
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise KeyFileError(
            f'{path} exists: a key is never overwritten; choose another name'
        ) from None
    except OSError as error:
        raise KeyFileError(f'{path} cannot be created: {error.strerror}') from error
    with os.fdopen(handle, 'w') as target:
        target.write(key.hex() + '\n')
        target.flush()
        os.fsync(target.fileno())  # the robot may hold it before a power failure
    return key_check(key)


def read_key_state() -> procedure.Script[KeyState]:
    """Return the state of the key in the robot."""
    yield from procedure.wait_for_board()
    return (yield from procedure.request_reply(Key(0), KeyState))


def write_key(key: bytes) -> procedure.Script[KeyState]:
    """Store or erase (:data:`ERASE_KEY`) the key; return its state, as read back."""
    yield from read_key_state()  # rejects a dongle, before the key is sent
    for _ in range(_MAX_ATTEMPTS):
        response = yield procedure.Request(Key(0, key), _WRITE_TIMEOUT)
        key_state = response.reply
        if not isinstance(key_state, KeyState):
            key_state = yield from procedure.request_reply(Key(0), KeyState)
        check_stored(key_state.rc)
        if holds_key(key_state, key):
            return key_state
    raise procedure.ProcedureError('the robot does not confirm the key: is the cable good?')


def holds_key(key_state: KeyState, key: bytes) -> bool:
    """Return whether the robot has this key; for :data:`ERASE_KEY`, whether it has none."""
    if key == ERASE_KEY:
        return key_state.state == frames.NO_KEY
    return (key_state.state, key_state.check) == (frames.KEY_HELD, key_check(key))


def format_key_state(key_state: KeyState) -> str:
    """Return the state of the key as text."""
    if key_state.state == frames.KEY_HELD:
        return f'the robot has a key, check value {key_state.check:08x}'
    if key_state.state == frames.KEY_DAMAGED:
        return (
            'the key of the robot is damaged: the robot accepts only an emergency stop until '
            't3mpc robot key write (or key erase) replaces the key'
        )
    return 'the robot has no key: any nRF24 radio can drive it'
