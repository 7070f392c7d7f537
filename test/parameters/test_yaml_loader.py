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
"""YAML files of users: what is refused, with the place."""

import pytest

from t3mpc_ros.parameters.yaml_loader import (
    MAX_FILE_SIZE,
    YamlError,
    parse_yaml,
    read_yaml,
    shortened,
)

BAD = {
    b'walls: [': 'is not YAML: line 1: ',
    b'a: 1\nb: {c: 1\n': 'is not YAML: line 3: ',
    b'a:\n\tb: 1\n': 'that cannot start any token; indent with spaces',
    b'name: \x07': 'is not YAML: ',
    b'name: 2026-13-45': 'is not YAML: month must be in 1..12',
    b'name: !!int ""': 'is not YAML: ',
    b'name: ' + 700 * b'[': 'is not YAML: maximum recursion depth exceeded',
    b'!!python/object:os.system {}': 'is not YAML: line 1: could not determine a constructor',
    b'walls: !!map [1]': 'is not YAML: line 1: expected a mapping node',
    b'- at: 1\n  for: 2\n  at: 3\n': 'line 3: at is given twice in one entry; a new entry of a ',
    'name: Küche'.encode('latin-1'): 'must be UTF-8 text: ',
    b'#' * (MAX_FILE_SIZE + 1): f'must have at most {MAX_FILE_SIZE} bytes: it has more',
}


@pytest.mark.parametrize(('content', 'words'), BAD.items(), ids=range(len(BAD)))
def test_what_is_wrong_is_said_in_one_line(content, words, tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_bytes(content)
    with pytest.raises(YamlError) as caught:
        read_yaml(path)
    message = str(caught.value)
    assert words in message
    assert '\n' not in message
    assert len(message) < 250


def test_a_file_that_cannot_be_read_says_why(tmp_path):
    for path, words in ((tmp_path / 'none', 'No such file'), (tmp_path, 'Is a directory')):
        with pytest.raises(YamlError, match=f'cannot be read: {words}'):
            read_yaml(path)


def test_the_longest_file_and_an_empty_one_are_read(tmp_path, monkeypatch):
    path = tmp_path / 'file.yaml'
    path.write_bytes(b'a: [1, 2.5, Z\xc3\xbcrich] #'.ljust(MAX_FILE_SIZE, b'x'))
    assert read_yaml(path) == {'a': [1, 2.5, 'Zürich']}
    path.write_bytes(b'')
    assert read_yaml(path) is None


def test_an_error_does_not_write_out_a_list_of_lists():
    """An entry of ten lines, each nine times the one before, took all memory in an error."""
    text = 'a0: &a0 [x]\n' + ''.join(
        f'a{n + 1}: &a{n + 1} [{", ".join([f"*a{n}"] * 9)}]\n' for n in range(12)
    )
    content = parse_yaml(text)
    assert isinstance(content, dict)
    assert shortened(content['a12']).startswith('[[[')
    assert len(shortened(content['a12'])) == 80
    assert shortened({'at': 1, 'fault': 'gyro_dead'}) == "{'at': 1, 'fault': 'gyro_dead'}"
