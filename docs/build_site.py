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
"""Builds the documentation site: ``scripts/docs``.

The site of a version is in a folder of its name; the selector of its pages shows every version
that is beside it.
"""

import argparse
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
import tarfile
import tempfile

from gallery import make_gallery

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / 'runs' / 'docs'
"""What is made for the site, and kept for the next build."""
LIBRARIES = {
    'mermaid.min.js': ('mermaid@11', 'package/dist/mermaid.min.js'),
    'iframe-worker.js': ('iframe-worker@1', 'package/shim/index.js'),
}
"""What draws diagrams, and what lets the search work without a server: packages of npm."""


def main():
    """Build the site and return 0; a dead link, or a page without a place, is an error."""
    parser = argparse.ArgumentParser(prog='scripts/docs', description=__doc__.partition('\n')[0])
    parser.add_argument(
        'folder', nargs='?', type=Path, default=ROOT / 'runs' / 'site', help='default runs/site'
    )
    parser.add_argument(
        '--duration',
        type=float,
        metavar='S',
        help='of each run of the examples: a check, no results',
    )
    options = parser.parse_args()
    from t3mpc_ros.version import VERSION

    gallery = WORK / ('gallery' if options.duration is None else 'gallery-short')
    make_gallery(gallery, options.duration)
    for library in LIBRARIES:
        _fetch(library)
    environment = {
        **os.environ,
        'T3MPC_GALLERY': str(gallery),
        'T3MPC_LIBRARIES': str(WORK / 'libraries'),
        'NO_MKDOCS_2_WARNING': '1',
    }
    folder = options.folder.resolve()
    words = ['build', '--strict', '-q', '-f', ROOT / 'mkdocs.yml', '-d', folder / VERSION]
    done = subprocess.run([sys.executable, '-m', 'mkdocs', *words], env=environment, check=False)
    if done.returncode:
        return done.returncode
    _list_versions(folder, VERSION)
    print(folder / VERSION / 'index.html')
    return 0


def _fetch(library):
    """Fetch a library from the registry of npm, once; without npm the pages do without it."""
    package, file = LIBRARIES[library]
    target = WORK / 'libraries' / library
    if target.exists() or not (npm := shutil.which('npm')):
        return
    with tempfile.TemporaryDirectory() as scratch:
        done = subprocess.run(
            [npm, 'pack', '--silent', package], cwd=scratch, capture_output=True, check=False
        )
        if done.returncode == 0:
            target.parent.mkdir(parents=True, exist_ok=True)
            (archive,) = Path(scratch).glob('*.tgz')
            with tarfile.open(archive) as files, files.extractfile(file) as source:
                target.write_bytes(source.read())


def _list_versions(folder, newest):
    """Write what the selector of versions reads, and a page that leads to the newest."""
    found = sorted((path.parent.name for path in folder.glob('*/index.html')), reverse=True)
    entries = [
        {'version': name, 'title': name, 'aliases': ['latest'] if name == newest else []}
        for name in found
    ]
    (folder / 'versions.json').write_text(json.dumps(entries) + '\n', encoding='utf-8')
    (folder / 'index.html').write_text(
        f'<!doctype html>\n<meta charset="utf-8">\n<title>t3mpc_ros</title>\n'
        f'<meta http-equiv="refresh" content="0; url={newest}/index.html">\n'
        f'<a href="{newest}/index.html">{newest}</a>\n',
        encoding='utf-8',
    )


if __name__ == '__main__':
    sys.exit(main())
