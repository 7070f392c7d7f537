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
"""Files that a reader, or a power failure, finds with the old content or with the new."""

from collections.abc import Iterator
from contextlib import contextmanager
import errno
import os
from pathlib import Path
from typing import BinaryIO

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a full disk, a quota, and a limit of the size of files: they do not name a file."""


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file that replaces ``path`` at the end; after an error ``path`` is unchanged.

    What cannot be replaced is written itself: a device, a pipe, a file in a read-only folder.
    """
    try:
        if path.exists() and not (path.is_file() and os.access(path.resolve().parent, os.W_OK)):
            with path.open('wb') as file:
                yield file
        else:
            with _replacement(path.resolve()) as file:  # a link remains one
                yield file
    except OSError as error:
        if error.errno in NO_ROOM:
            error.filename = str(path)
        raise


@contextmanager
def _replacement(path: Path) -> Iterator[BinaryIO]:
    temporary = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        with temporary.open('wb') as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # without it, a power failure may leave an empty file
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace the content of a file, in a folder that is created if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def check_new_folder(path: Path) -> None:
    """Raise ValueError unless ``path`` is a folder, or one can be made there."""
    for each in (path, *path.parents):
        if each.exists() and not each.is_dir():
            why = '' if each == path else f', and {each} is a file'
            raise ValueError(f'must be a folder, or the path of a new one: got {path}{why}')


def sync_folder(folder: Path) -> None:
    """Write the names in a folder to the disk: a power failure may lose a new file without it."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a network share, for example
            raise
    finally:
        os.close(handle)
