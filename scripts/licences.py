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
"""List the licences of what an installation of t3mpc_ros brings; fail at one that is not known.

``python scripts/licences.py [EXTRA ...]``: in the environment of this Python, with the extras.
"""

from importlib.metadata import Distribution, PackageNotFoundError, distribution
import re
import sys
from xml.etree import ElementTree

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ALLOWED = {
    'Apache-2.0',
    'MIT',
    'MIT-CMU',
    'BSD',
    'BSD-2-Clause',
    'BSD-3-Clause',
    '0BSD',
    'ISC',
    'Zlib',
    'CC0-1.0',
    'PSF-2.0',
    'any-OSI',
    # Of whole libraries, which are imported and not changed.
    'MPL-2.0',
    'LGPL-3.0-or-later',
}
"""Licences of libraries that a program under Apache-2.0 may import."""
NAMES = {
    'apache license 2.0': 'Apache-2.0',
    'apache license, version 2.0': 'Apache-2.0',
    'apache 2.0': 'Apache-2.0',
    'apache software license': 'Apache-2.0',
    'bsd license': 'BSD',
    'gnu lesser general public license v3 or later (lgplv3+)': 'LGPL-3.0-or-later',
    'isc license (iscl)': 'ISC',
    'mit license': 'MIT',
    'mozilla public license 2.0 (mpl 2.0)': 'MPL-2.0',
    'python software foundation license': 'PSF-2.0',
    'zlib license': 'Zlib',
}
"""Other names of a licence."""
STATED = {
    'ros-fastcdr': ('Apache-2.0', 'the text LICENSE in its wheel'),
    'ros-fastrtps': ('Apache-2.0', 'the text LICENSE in its wheel'),
    'ros-jazzy-common-interfaces': ('Apache-2.0', 'has no files: requires ros-common-interfaces'),
    'ros-jazzy-rclpy': ('Apache-2.0', 'has no files: requires ros-rclpy'),
    'setuptools': ('MIT', 'the text LICENSE in its wheel'),
}
"""Licences of packages whose metadata say nothing, and where it stands."""


def licence_of(found: Distribution) -> tuple[str, str]:
    """Return the licence as an SPDX expression, empty if unknown, and where it stands."""
    if text := found.metadata.get('License-Expression'):
        return text, 'License-Expression'
    classifiers = [
        text.rpartition(' :: ')[2]
        for text in found.metadata.get_all('Classifier') or ()
        if text.startswith('License :: OSI Approved :: ')
    ]
    if classifiers:
        return ' AND '.join(map(_spdx, classifiers)), 'classifier'
    text = (found.metadata.get('License') or '').strip()
    if text and '\n' not in text:
        return _spdx(text), 'License'
    for file in found.files or ():
        if file.name == 'package.xml' and file.locate().exists():
            tree = ElementTree.parse(file.locate())
            texts = [element.text or '' for element in tree.iter('license')]
            return ' AND '.join(map(_spdx, texts)), 'package.xml'
    return STATED.get(canonicalize_name(found.name), ('', ''))


def is_allowed(expression: str) -> bool:
    """Return whether an SPDX expression allows the use; an exception only allows more."""
    words = re.findall(r'[()]|[^\s()]+', re.sub(r' WITH \S+', '', expression))
    truth = {'AND': 'and', 'OR': 'or', '(': '(', ')': ')'}
    terms = [truth.get(word, str(word in ALLOWED)) for word in words]
    try:
        return bool(eval(' '.join(terms)))
    except SyntaxError:
        return False


def required(name: str, extras: set[str]) -> dict[str, Distribution | None]:
    """Return all that one requires, directly or not, and itself; None for what is missing."""
    found: dict[str, Distribution | None] = {}
    seen: set[tuple[str, str]] = set()
    pending = [(name, extra) for extra in ('', *extras)]
    while pending:
        name, extra = item = pending.pop()
        if item in seen:
            continue
        seen.add(item)
        try:
            library = found[name] = distribution(name)
        except PackageNotFoundError:
            found[name] = None
            continue
        for need in map(Requirement, library.requires or ()):
            if need.marker is None or need.marker.evaluate({'extra': extra}):
                pending += [(canonicalize_name(need.name), each) for each in ('', *need.extras)]
    return found


def main(extras: set[str]) -> int:
    """Print a line for each library; return 1 if one has no licence that is allowed."""
    refused = []
    for name, found in sorted(required('t3mpc-ros', extras).items()):
        licence, source = licence_of(found) if found else ('', 'not installed')
        print(f'{name:<40} {licence:<30} {source}')
        if not is_allowed(licence):
            refused.append(f'{name} ({licence or source or "no licence in its metadata"})')
    if refused:
        print(f'error: not a known licence: {", ".join(refused)}', file=sys.stderr)
        print('remedy: see ALLOWED and STATED in scripts/licences.py', file=sys.stderr)
    return 1 if refused else 0


def _spdx(text: str) -> str:
    return NAMES.get(text.strip().lower(), text.strip())


if __name__ == '__main__':
    sys.exit(main({*sys.argv[1:]}))
