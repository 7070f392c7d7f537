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
"""The firmware's portable C core as a shared library, compiled at its first use.

The core (``firmware/core``) holds the rules of both boards; ``firmware/host`` gives it hardware in
virtual time. A compiled library is kept in the cache of the package, under a digest of its
sources: it is compiled again when they change.
"""

from collections.abc import Callable
import ctypes
from ctypes import POINTER, c_bool, c_char_p, c_double, c_uint8, c_uint16, c_uint32, c_void_p
from functools import cache, partial
import hashlib
import os
from pathlib import Path
import platform
import shutil
import subprocess
import tempfile
from typing import Any

from t3mpc_ros.kernels import writable_directory

FIRMWARE = Path(__file__).resolve().parent / 'firmware'
FLAGS = ('-std=c99', '-O2', '-fPIC', '-shared')
_COMPILERS = ('cc', 'gcc', 'clang')


class FirmwareLibraryError(Exception):
    """The core cannot be compiled or loaded; the text contains the reason and the remedy."""


class CompilerMissingError(FirmwareLibraryError):
    """There is no C compiler."""


class Motion(ctypes.Structure):
    """``struct t3_host_motion``: what the surroundings of a robot see of it."""

    _fields_ = (
        ('left', c_double),
        ('right', c_double),
        ('loads', c_uint32),
        ('setups', c_uint32),
        ('usb_size', c_uint32),
        ('powered', c_bool),
        ('turning', c_bool),
    )


_HOST, _BYTES = c_void_p, c_char_p
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    'robot_new': (_HOST, ()),
    'robot_free': (None, (_HOST,)),
    'robot_store_key': (None, (_HOST, _BYTES)),
    'robot_store_settings': (None, (_HOST, c_uint8, c_uint16, _BYTES)),
    'robot_erase': (None, (_HOST,)),
    'robot_set_cell_us': (None, (_HOST, c_uint32)),
    'robot_store_rate': (None, (_HOST, c_uint8)),
    'robot_set_noise': (None, (_HOST, c_uint32)),
    'robot_boot': (None, (_HOST, c_uint8, c_uint32)),
    'robot_advance': (c_uint32, (_HOST, c_uint32, POINTER(Motion))),
    'robot_packet': (c_bool, (_HOST, _BYTES, c_uint8)),
    'robot_ack': (c_uint8, (_HOST, _BYTES)),
    'robot_press': (None, (_HOST, c_bool)),
    'robot_set_imu': (None, (_HOST, c_bool, POINTER(ctypes.c_int16))),
    'robot_imu': (_HOST, (_HOST,)),
    'robot_adcs': (_HOST, (_HOST,)),
    'robot_usb': (None, (_HOST, _BYTES, c_uint32)),
    'robot_usb_take': (c_uint32, (_HOST, _BYTES, c_uint32)),
    'robot_changing': (c_bool, (_HOST,)),
    'robot_status': (c_uint8, (_HOST,)),
    'robot_session': (c_uint8, (_HOST,)),
    'robot_stale': (c_uint16, (_HOST,)),
    'robot_speed': (ctypes.c_int32, (_HOST, c_uint8)),
    'robot_steps': (ctypes.c_int32, (_HOST, c_uint8)),
    'robot_microsteps': (c_uint16, (_HOST,)),
    'robot_channel': (c_uint8, (_HOST,)),
    'robot_rate': (c_uint8, (_HOST,)),
    'robot_address': (None, (_HOST, _BYTES)),
    'robot_cell': (c_uint8, (_HOST, c_uint16)),
    'robot_poke_eeprom': (None, (_HOST, c_uint16, c_uint8)),
    'dongle_new': (_HOST, (c_uint8,)),
    'dongle_free': (None, (_HOST,)),
    'dongle_boot': (None, (_HOST, c_uint8)),
    'dongle_tick': (None, (_HOST, c_uint32)),
    'dongle_idle_us': (c_uint32, (_HOST,)),
    'dongle_bytes': (None, (_HOST, _BYTES, c_uint32)),
    'dongle_take': (c_uint32, (_HOST, _BYTES, c_uint32)),
    'dongle_sent': (c_uint8, (_HOST, _BYTES)),
    'dongle_answer': (None, (_HOST, c_bool, c_uint8, _BYTES, c_uint8)),
    'dongle_set_chip': (None, (_HOST, c_bool)),
    'dongle_radio': (None, (_HOST, _BYTES)),
}


class Board:
    """One board of the library: ``call('run', 5)`` is ``t3_host_<kind>_run(board, 5)``.

    ``kind`` is ``robot`` or ``dongle``, the arguments are those of ``t3_host_<kind>_new``.
    """

    def __init__(self, kind: str, *arguments: Any) -> None:
        library = load_library()
        self._functions = {
            name.removeprefix(f'{kind}_'): getattr(library, f't3_host_{name}')
            for name in _SIGNATURES
            if name.startswith(kind)
        }
        self._board = self._functions['new'](*arguments)

    def __del__(self) -> None:
        if hasattr(self, '_board'):
            self._functions['free'](self._board)

    def function(self, name: str) -> Callable[..., Any]:
        """Return a function of this board, for many calls."""
        return partial(self._functions[name], self._board)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of this board."""
        return self._functions[name](self._board, *arguments)


@cache
def load_library() -> ctypes.CDLL:
    """Return the core with the signatures of its functions, compiled if necessary."""
    try:
        library = ctypes.CDLL(str(compile_library()))
    except OSError as error:
        raise FirmwareLibraryError(
            f'the C core of the firmware cannot be used: {error}'
        ) from error
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, f't3_host_{name}')
        function.restype, function.argtypes = result, arguments
    return library


def compile_library() -> Path:
    """Return the path of the core, compiled unless it is cached, or raise FirmwareLibraryError."""
    target = writable_directory(os.environ, f'firmware-{_digest()}') / 'libt3core.so'
    if not target.exists():
        _compile(target)
    return target


def _sources() -> list[Path]:
    return sorted(path for part in ('core', 'host') for path in (FIRMWARE / part).glob('*.[ch]'))


def _digest() -> str:
    """Return 16 hexadecimal digits that change with the sources, the flags and the processor."""
    digest = hashlib.sha256(' '.join((*FLAGS, platform.machine())).encode())
    for path in _sources():
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _compile(target: Path) -> None:
    """Compile to a temporary name and rename: several processes may start together."""
    names = [os.environ['CC']] if os.environ.get('CC') else _COMPILERS
    compiler = next(filter(None, map(shutil.which, names)), None)
    if compiler is None:
        raise CompilerMissingError(
            'the emulator compiles the C core of the firmware and needs a C compiler; not found: '
            f'{", ".join(names)}. Install one (sudo apt install gcc libc6-dev), or set CC to one'
        )
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = Path(folder) / target.name
        command = [compiler, *FLAGS, *(f'-I{FIRMWARE / part}' for part in ('core', 'host'))]
        sources = [str(path) for path in _sources() if path.suffix == '.c']
        done = subprocess.run([*command, '-o', made, *sources], capture_output=True, text=True)
        if done.returncode:
            first = '\n'.join(done.stderr.splitlines()[:5])
            raise FirmwareLibraryError(
                f'{compiler} must compile the C core of the firmware (are the headers of libc '
                f'installed? sudo apt install libc6-dev): got\n{first}'
            )
        made.replace(target)
