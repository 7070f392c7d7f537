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
"""The documentation site is built by one command, strictly; its notebooks run and stay short."""

import importlib.util
import json
import re
import subprocess

import pytest
from support.checkout import ROOT

from t3mpc_ros.version import VERSION

SHORT = '6'
"""Duration of each run of an example, s."""
MKDOCS = ROOT / 'mkdocs.yml'
NOTEBOOKS = sorted((ROOT / 'examples').glob('*.ipynb'))
TEXT = 5000
"""Maximum size of what a cell shows beside a picture, bytes."""


def _gallery():
    pytest.importorskip('nbclient')
    pytest.importorskip('ipykernel')
    spec = importlib.util.spec_from_file_location('gallery', ROOT / 'docs' / 'gallery.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('path', NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_without_outputs(path):
    """They are made where it runs: a stored one would be of an older version."""
    for cell in json.loads(path.read_text())['cells']:
        assert not cell.get('outputs')
        assert cell.get('execution_count') is None


def test_every_page_has_a_place_in_the_navigation():
    """Without one the build of the site, which only a long test does, ends."""
    placed = re.findall(r'^ +- .*: (\w+\.md)$', MKDOCS.read_text(), re.MULTILINE)
    pages = {path.name for path in (ROOT / 'docs').glob('*.md')}
    assert pages <= {*placed, 'index.md'}
    assert len(placed) == len({*placed})


def test_a_module_that_a_page_links_to_is_on_the_site():
    """The link of the page on patrols was dead: only the programs in docs are left out."""
    pytest.importorskip('mkdocs')  # which needs pathspec
    from pathspec import GitIgnoreSpec

    [lines] = re.findall(r'^exclude_docs: \|\n((?:  .*\n)+)', MKDOCS.read_text(), re.MULTILINE)
    left_out = GitIgnoreSpec.from_lines(line.strip() for line in lines.splitlines()).match_file
    assert left_out('gallery.py')
    assert not left_out('source/t3mpc_ros/geometry/path_smoothing.py')


@pytest.mark.long
@pytest.mark.parametrize('path', NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_shows_little_text_and_its_figures(path, tmp_path):
    """A result in a cell printed 256 110 characters; figures needed a magic word."""
    cells = [cell for cell in _gallery().execute(path, tmp_path, SHORT).cells if cell.source]
    kinds = dict.fromkeys(('image/png', 'text/html', 'latex', 'progress'), 0)
    for cell in cells:
        shown = cell.get('outputs', ())
        assert not [each for each in shown if each.output_type == 'error']
        size = 0
        for each in shown:
            data = each.get('data', {'text/plain': each.get('text', '')})
            kinds['latex'] += r'\begin{tabular}' in data['text/plain']
            kinds['progress'] += each.get('name') == 'stderr' and '100%' in data['text/plain']
            for kind in ('image/png', 'text/html'):
                kinds[kind] += kind in data
            size += sum(len(data[kind]) for kind in data if kind.startswith('text/'))
        assert size < TEXT, cell.source
    assert kinds['image/png'] >= 2
    assert kinds['text/html'] >= 2
    assert kinds['latex'] == 1
    assert kinds['progress'] >= 1


@pytest.mark.long
def test_the_site_is_built_strictly_and_is_complete(tmp_path):
    """A dead link or anchor, or a page without a place in the navigation, ends the build."""
    pytest.importorskip('mkdocs')
    command = [ROOT / 'scripts' / 'docs', '--duration', SHORT, tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    site = tmp_path / VERSION
    pages = {path.relative_to(site).as_posix(): path.read_text() for path in site.rglob('*.html')}
    for page in (ROOT / 'docs').glob('*.md'):
        assert f'{page.stem}.html' in pages
    for example in (ROOT / 'examples').glob('*.py'):
        text = pages[f'gallery/{example.stem}.html']
        assert re.search('Output|<img', text), example
    assert 'cell_' not in pages['gallery/own_controller_notebook.html']
    for name, text in pages.items():
        fetched = re.findall(r'<(?:script|img|iframe|link)\b[^>]*(?:src|href)="(http[^"]+)"', text)
        assert not fetched, name
    anchors = set(re.findall(r'id="([^"]+)"', pages['api.html']))
    assert {'simulate', 'observation', 'scripterror'} <= anchors
    index = (site / 'search' / 'search_index.js').read_text()
    assert 'dead time estimator' in index or 'dead_time_estimator' in index
    [entry] = json.loads((tmp_path / 'versions.json').read_text())
    assert entry['version'] == VERSION
