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
"""The header of a source file, in the form that ament_copyright recognises.

``python test/support/headers.py`` writes it in place of the short form of a new file.
"""

from pathlib import Path
import subprocess

COPYRIGHT = 'Copyright 2026 The t3mpc_ros developers'
SHORT = f'SPDX-License-Identifier: {"Apache-2.0"}'
LICENCE = """
Licensed under the Apache License, Version 2.0 (the "License");
you may not use this file except in compliance with the License.
You may obtain a copy of the License at

    http://www.apache.org/licenses/LICENSE-2.0

Unless required by applicable law or agreed to in writing, software
distributed under the License is distributed on an "AS IS" BASIS,
WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
See the License for the specific language governing permissions and
limitations under the License.
"""
COMMENT = {'.py': '#', '.c': '//', '.h': '//'}
"""Start of a comment by the suffixes that ament_copyright examines."""


def header(mark):
    """Return the header with the comment sign of a language."""
    lines = [COPYRIGHT, *LICENCE.removesuffix('\n').split('\n')]
    return ''.join(f'{mark} {line}'.rstrip() + '\n' for line in lines)


def sources(root):
    """Return the files of a checkout that have the header."""
    listed = subprocess.check_output(
        ['git', '-c', 'safe.directory=*', 'ls-files', '-co', '--exclude-standard'],
        cwd=root,
        text=True,
    )
    paths = (root / name for name in listed.splitlines())
    return [path for path in paths if path.suffix in COMMENT and path.is_file()]


def complete(path):
    """Replace the short header of a file; return whether it had one."""
    mark = COMMENT[path.suffix]
    text = path.read_text(encoding='utf-8')
    short = f'{mark} {COPYRIGHT}\n{mark} {SHORT}\n'
    at = text.find(short, 0, 300)
    if at < 0:
        return False
    rest = text[at + len(short) :]
    # A comment that follows at once would be taken for a part of the header.
    gap = '\n' if rest.startswith(mark) else ''
    path.write_text(text[:at] + header(mark) + gap + rest, encoding='utf-8')
    return True


if __name__ == '__main__':
    for each in sources(Path(__file__).resolve().parents[2]):
        if complete(each):
            print(each)
