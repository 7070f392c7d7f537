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
"""What a reviewer of a release looks at: headers and the description of the package."""

import csv
from importlib.metadata import version
import json
from pathlib import Path
import re
import shutil
import subprocess
from xml.etree import ElementTree

from packaging.requirements import Requirement
import pytest
from support.headers import COMMENT, header, sources

from bench import release_results
from t3mpc_ros.missing_library import REQUIREMENTS

ROOT = Path(__file__).resolve().parent.parent


def test_every_header_is_one_that_ament_copyright_recognises():
    """It recognised none of 323."""
    found = sources(ROOT)
    assert len(found) > 600
    for path in found:
        text = path.read_text(encoding='utf-8')
        mark = COMMENT[path.suffix]
        words = f'{path}: run python test/support/headers.py'
        assert header(mark) in text[:1000], words
        assert not text.partition(header(mark))[2].startswith(mark), words
    for path in (ROOT / 'scripts').iterdir():
        assert path.is_dir() or 'Apache' in path.read_text(encoding='utf-8')[:300], path


def requirements(name):
    lines = (line.partition('#')[0].strip() for line in (ROOT / name).read_text().splitlines())
    return [Requirement(line) for line in lines if line and not line.startswith('-')]


def test_every_library_has_an_upper_bound_that_is_tried():
    """CI installs the newest below it: a new major version is tried before it is allowed."""
    wanted = [each for each in requirements('requirements.txt') if each.name != 'pip']
    assert len(wanted) > 15
    for each in [*wanted, *map(Requirement, REQUIREMENTS.values())]:
        assert {'>=', '<'} <= {clause.operator for clause in each.specifier}, each
        assert each.specifier.contains(version(each.name), prereleases=True), each


def test_the_package_description_is_complete():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert package.find('url') is not None
    assert package.findtext('author') == 'The t3mpc_ros developers'
    imported = {
        name
        for path in (ROOT / 't3mpc_ros' / 'nodes').rglob('*.py')
        for name in re.findall(
            r'^\s*(?:from|import) (\w+_(?:msgs|srvs|interfaces))', path.read_text(), re.M
        )
    }
    depends = {each.text for each in package.findall('exec_depend')}
    assert {'geometry_msgs', 'std_srvs'} < imported <= depends


def test_the_image_follows_the_readme():
    """No container can be built in the tests: its steps are those that the README names."""
    file = (ROOT / 'Dockerfile').read_text()
    readme = (ROOT / 'README.md').read_text()
    for step in (
        'rosdep install --from-paths src --ignore-src -y',
        'python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE',
        '"numba>=0.68,<1" "cma>=4.0,<5" "daqp>=0.11,<1"',
        'python3 -m colcon build',
        'install/setup.bash',
    ):
        assert step in file
        assert step in readme
    settings = json.loads((ROOT / '.devcontainer' / 'devcontainer.json').read_text())
    assert (
        ROOT / '.devcontainer' / settings['build']['dockerfile']
    ).resolve() == ROOT / 'Dockerfile'


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (None, ''),
        (('package.xml', '<version>', '<version>9'), 'package.xml is not of version'),
        (('CITATION.cff', '\nversion: ', '\nversion: 9'), 'CITATION.cff is not of version'),
        (
            ('CHANGELOG.rst', '\n0.1.0 (', '\nForthcoming\n\n0.1.0 ('),
            'changes that are forthcoming',
        ),
        (('README.md', 't3mpc', 'T3MPC'), 'not committed'),
    ],
)
def test_a_release_is_tagged_only_if_its_files_agree(change, words, tmp_path):
    names = ('package.xml', 'CITATION.cff', 'README.md', 'CHANGELOG.rst')
    for name in (*names, 't3mpc_ros/version.py', 'scripts/tag'):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    changes = tmp_path / 'CHANGELOG.rst'
    if not (change and change[0] == 'CHANGELOG.rst'):
        changes.write_text(changes.read_text().replace('Forthcoming', 'Before'))

    def git(*arguments):
        who = ['-c', 'user.name=a', '-c', 'user.email=a@b']
        subprocess.run(['git', *who, *arguments], cwd=tmp_path, check=True, capture_output=True)

    git('init')
    git('add', '.')
    if change and change[0] == 'README.md':
        git('commit', '-m', 'a')
    if change:
        path = tmp_path / change[0]
        path.write_text(path.read_text().replace(*change[1:], 1))
    if not (change and change[0] == 'README.md'):
        git('commit', '-a', '-m', 'a')
    done = subprocess.run(
        [tmp_path / 'scripts' / 'tag', '--dry-run'], capture_output=True, text=True
    )
    assert done.returncode == bool(words), done.stderr
    assert words in done.stderr


def test_the_runs_of_a_release_are_one_file(tmp_path, monkeypatch):
    """Parts that are there are not made again; every row says of which study it is."""
    file, made = tmp_path / 'runs.csv', []

    def command(words):
        (part,) = (path for path, known in parts.items() if known == words[: len(known)])
        if len(made) == 2:
            return 130
        made.append(part)
        part.write_text(f'seed,{part.stem}\n1,{len(made)}\n')
        return 0

    parts = release_results.parts(tmp_path / 'runs.parts', quick=False)
    monkeypatch.setattr(release_results, 't3mpc', command)
    monkeypatch.setattr('sys.argv', ['release_results.py', str(file)])
    assert release_results.main() == 130
    assert len(made) == 2
    del made[:]
    assert release_results.main() == 0
    rows = list(csv.DictReader(file.read_text().splitlines()))
    assert [row['study'] for row in rows] == ['paper', 'compare', 'compare', 'compare']
    assert [path.stem for path in made] == ['servo', 'twin']
    assert list(tmp_path.iterdir()) == [file]
