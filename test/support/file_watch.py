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
"""Which files are open, and which would survive a power failure."""

from contextlib import contextmanager, suppress
import gc
import hashlib
import os
from pathlib import Path
import stat


def open_files(folder=''):
    """Return the open file descriptors of this process that refer to something in a folder."""
    found = {}
    for number in os.listdir('/proc/self/fd'):
        with suppress(FileNotFoundError):  # that of the listing itself
            found[number] = os.readlink(f'/proc/self/fd/{number}')
    return {number: name for number, name in found.items() if name.startswith(f'{folder}')}


@contextmanager
def no_file_left_open(folder=''):
    """Fail if the block leaves a file open that only the garbage collector would close."""
    gc.collect()
    gc.freeze()  # all that is there already; else each collection examines every test
    gc.disable()
    try:
        before = open_files(folder)
        yield
        assert open_files(folder) == before
    finally:
        gc.enable()


class Disk:
    """What a power failure leaves: contents and names that were synchronized.

    Contents count from ``fsync`` of a file, names in a folder from ``fsync`` of the folder. A
    file that replaces another one must be on the disk before.
    """

    def __init__(self, monkeypatch):
        self.contents, self.names = {}, {}
        self._fsync, self._replace = os.fsync, os.replace
        monkeypatch.setattr(os, 'fsync', self._on_fsync)
        monkeypatch.setattr(os, 'replace', self._on_replace)
        monkeypatch.setattr(Path, 'replace', lambda path, target: self._on_replace(path, target))

    def _on_fsync(self, file):
        number = file if isinstance(file, int) else file.fileno()
        status = os.fstat(number)
        path = Path(os.readlink(f'/proc/self/fd/{number}'))
        if stat.S_ISDIR(status.st_mode):
            self.names[path] = {each.name: each.stat().st_ino for each in path.iterdir()}
        else:
            self.contents[status.st_ino] = _digest(path)
        self._fsync(number)

    def _on_replace(self, source, target):
        assert self.has_content(source), f'{target} is replaced by a file that is not on the disk'
        self._replace(source, target)

    def has_content(self, path):
        return self.contents.get(Path(path).stat().st_ino) == _digest(path)

    def has(self, path):
        """Return whether a file and its name are on the disk."""
        names = self.names.get(path.parent, {})
        on_disk = path.is_dir() or self.has_content(path)
        return on_disk and names.get(path.name) == path.stat().st_ino


def _digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
