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
"""What bags and reports say about the program that made them."""

import platform
import subprocess

import t3mpc_ros
from t3mpc_ros.parameters.version_and_commit import provenance


def test_the_commit_says_whether_files_differ(tmp_path):
    package = tmp_path / 't3mpc_ros'
    package.mkdir()
    (package / 'module.py').write_text('1')
    assert provenance(package) == {
        'version': t3mpc_ros.__version__,
        'commit': 'unknown',
        'python': platform.python_version(),
    }

    def git(*words):
        command = ['git', '-C', tmp_path, '-c', 'user.name=a', '-c', 'user.email=a@b', *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    git('init', '-q')
    assert provenance(package)['commit'] == 'unknown'  # nothing is committed
    git('add', '.')
    git('commit', '-qm', 'one')
    commit = git('rev-parse', 'HEAD').strip()
    git('tag', 'v1')  # a tag is no commit
    assert provenance(package)['commit'] == commit
    (package / 'module.py').write_text('2')
    assert provenance(package)['commit'] == f'{commit}-dirty'
