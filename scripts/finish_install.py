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
"""Finish the installation of t3mpc_ros into the environment of this Python."""

from collections import defaultdict
import contextlib
from hashlib import sha256
import os
from pathlib import Path
import shutil
import sys

import setuptools  # noqa: F401

# Brought by setuptools: Python 3.12 has none of its own.
from distutils.core import run_setup  # isort: skip

from t3mpc_ros.nodes.registry import NODES

LARGE = 500_000
"""Size from which equal files are linked, bytes."""


def write_executables(environment: Path, source: Path) -> None:
    """Write the executables to lib/t3mpc_ros, the folder that ros2 run searches."""
    folder = environment / 'lib' / 't3mpc_ros'
    shutil.rmtree(folder, ignore_errors=True)  # with those of an earlier version
    folder.mkdir()
    for name in (*NODES, 't3mpc'):
        shutil.copyfile(source / 'resource' / 'executable', folder / name)
        (folder / name).chmod(0o755)


def link_data_files(environment: Path, source: Path) -> None:
    """Link the data files of setup.py, which an editable installation leaves out."""
    shutil.rmtree(environment / 'share' / 't3mpc_ros', ignore_errors=True)
    with contextlib.chdir(source):  # its paths are relative
        data_files = run_setup('setup.py', stop_after='init').data_files
    for folder, files in data_files:
        (environment / folder).mkdir(parents=True, exist_ok=True)
        for file in map(Path, files):
            link = environment / folder / file.name
            link.unlink(missing_ok=True)
            link.symlink_to(source / file)


def shorten_path(environment: Path, source: Path) -> None:
    """Write the path of an editable installation relative to the environment.

    Python reads path files in the encoding of the locale: with ``LC_ALL=C`` no program started in
    a checkout whose path has other letters than ASCII.
    """
    for file in environment.glob('lib/python*/site-packages/__editable__.t3mpc_ros-*.pth'):
        file.write_text(f'{os.path.relpath(source, file.parent)}\n', encoding='utf-8')


def link_copies(environment: Path) -> None:
    """Keep one file of equal shared libraries: wheels cannot contain links, and hold copies."""
    libraries = defaultdict(list)
    for path in sorted(environment.rglob('*.so*')):
        if not path.is_symlink() and path.stat().st_size >= LARGE:
            libraries[path.stat().st_size].append(path)
    first = {}
    for path in (path for group in libraries.values() if len(group) > 1 for path in group):
        kept = first.setdefault(sha256(path.read_bytes()).digest(), path)
        if not kept.samefile(path):
            link = path.with_name(f'{path.name}.link')
            link.hardlink_to(kept)
            link.replace(path)


if __name__ == '__main__':
    write_executables(Path(sys.prefix), Path(__file__).resolve().parent.parent)
    link_data_files(Path(sys.prefix), Path(__file__).resolve().parent.parent)
    shorten_path(Path(sys.prefix), Path(__file__).resolve().parent.parent)
    link_copies(Path(sys.prefix))
