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
"""Sizes of new environments with the package and each of its extras, installed by pip.

    .venv/bin/python bench/install_sizes.py [EXTRA ...]

It prints the table of docs/tutorial.md: everything below the folder of the environment, with the
modules that pip has compiled. Libraries come from the package index that pip is configured for.
"""

import argparse
from pathlib import Path
import subprocess
import sys
import tempfile

ROOT = Path(__file__).resolve().parent.parent
EXTRAS = ('none', 'bags', 'ros', 'compare', 'cluster', 'gym')


def size_of(folder: Path) -> int:
    """Return the bytes of the files below a folder, links not followed."""
    return sum(path.lstat().st_size for path in folder.rglob('*') if not path.is_dir())


def size_with(extra: str) -> int:
    """Return the bytes of an environment with an extra."""
    with tempfile.TemporaryDirectory() as folder:
        source, environment = Path(folder, 'source'), Path(folder, 'environment')
        source.mkdir()
        archive = subprocess.run(
            ['git', '-C', str(ROOT), 'archive', 'HEAD'], check=True, capture_output=True
        )
        subprocess.run(['tar', '-x', '-C', str(source)], input=archive.stdout, check=True)
        subprocess.run([sys.executable, '-m', 'venv', str(environment)], check=True)
        name = str(source) if extra == 'none' else f'{source}[{extra}]'
        python = environment / 'bin' / 'python'
        subprocess.run([str(python), '-m', 'pip', 'install', '-q', name], check=True)
        return size_of(environment)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('extras', nargs='*', metavar='EXTRA', default=EXTRAS)
    print('| extra | MB |', '|---|---|', sep='\n')
    for extra in parser.parse_args().extras:
        print(f'| {extra} | {size_with(extra) / 1e6:.0f} |', flush=True)


if __name__ == '__main__':
    main()
