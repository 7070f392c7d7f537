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
"""Modules of one's own reach the workers of a cluster with each job."""

from concurrent.futures import ThreadPoolExecutor
import sys

import pytest

from t3mpc_ros.evaluation import modules_on_cluster
from t3mpc_ros.evaluation.api.script_inputs import FileController
from t3mpc_ros.evaluation.modules_on_cluster import SourceText, own_sources, run_carried
from t3mpc_ros.evaluation.run_cache_key import source_digest
from t3mpc_ros.script_error import ScriptError

NAMES = ('carried', 'carried.law', 'carried_helper')


@pytest.fixture
def finder(monkeypatch):
    """A process that knows none of the modules, as a worker of another machine."""
    found = modules_on_cluster._Finder()
    monkeypatch.setattr(modules_on_cluster, 'FINDER', found)
    monkeypatch.setattr(sys, 'meta_path', [*sys.meta_path])
    yield found
    for name in NAMES:
        sys.modules.pop(name, None)


def sources(gain):
    """Return a module in a folder without ``__init__.py`` that imports one beside it."""
    return {
        'carried': SourceText('', '', True),
        'carried.law': SourceText(
            '/elsewhere/carried/law.py',
            'from carried_helper import gain\ndef law():\n    return 2 * gain()\n',
            False,
        ),
        'carried_helper': SourceText(
            '/elsewhere/carried_helper.py', f'def gain():\n    return {gain}\n', False
        ),
    }


def job(module, name):
    """Return the bytes of a job, without the module, as a process pickles that has it."""
    function = f'c{module}\n{name}\n'.encode()
    return b'(' + function + b'(t(dt.'


def test_a_worker_gets_the_modules_of_each_job(finder):
    """A module that was edited between two sweeps is not run as it was."""
    law = job('carried.law', 'law')
    assert run_carried(source_digest(), sources(10), law) == 20
    assert sys.modules['carried.law'].__file__ == '/elsewhere/carried/law.py'
    first = sys.modules['carried.law']
    assert run_carried(source_digest(), sources(10), law) == 20
    assert sys.modules['carried.law'] is first
    # The helper alone is another one: what has imported it is run again, too.
    assert run_carried(source_digest(), sources(15), law) == 30


def test_a_module_whose_loader_keeps_no_text_stays(finder):
    """That of a test is one: it was run again, and its functions could no longer be pickled."""
    here = sys.modules[__name__]
    finder.provide(own_sources())
    assert sys.modules[__name__] is here


def test_a_module_that_the_worker_has_already_stays(finder, tmp_path, monkeypatch):
    """Of a worker that is a thread of the program: reloading finds its file, as before."""
    (tmp_path / 'carried_helper.py').write_text('def gain():\n    return 7\n')
    monkeypatch.syspath_prepend(tmp_path)
    import carried_helper

    text = (tmp_path / 'carried_helper.py').read_text()
    given = {'carried_helper': SourceText(carried_helper.__file__, text, False)}
    assert run_carried(source_digest(), given, job('carried_helper', 'gain')) == 7
    assert sys.modules['carried_helper'] is carried_helper
    assert finder.find_spec('carried_helper') is None


def test_own_modules_are_not_those_of_libraries(tmp_path, monkeypatch):
    (tmp_path / 'carried').mkdir()
    (tmp_path / 'carried' / 'law.py').write_text('def law():\n    return 1\n')
    monkeypatch.syspath_prepend(tmp_path)
    import carried.law  # noqa: F401

    found = own_sources()
    assert found['carried.law'].text.startswith('def law')
    assert found['carried'].package
    assert not {'numpy', 'pytest', 'json', 't3mpc_ros', '__main__'} & set(found)
    assert not [name for name in found if name.startswith('t3mpc_ros')]
    for name in NAMES:
        sys.modules.pop(name, None)


@pytest.mark.parametrize(
    'package, given, text',
    [
        (None, {}, 'lacks the module carried'),
        (None, {'carried.law': SourceText('x.py', '1 / 0', False)}, 'cannot load the run: Zero'),
        ('other', {}, 'another t3mpc_ros'),
    ],
)
def test_what_a_worker_lacks_is_one_sentence(package, given, text, finder):
    """It was 40 lines from inside the scheduler."""
    if given:
        given = {'carried': SourceText('', '', True), **given}
    with pytest.raises(ScriptError, match=text):
        run_carried(package or source_digest(), given, job('carried.law', 'law'))


def test_threads_of_a_worker_wait_for_a_file_that_is_being_run(tmp_path):
    """A worker of two threads: one found the module of the other, which defined nothing yet."""
    file = tmp_path / 'slow.py'
    file.write_text(
        'import time\ntime.sleep(0.1)\ndef step(observation):\n    return observation\n'
    )
    source = FileController(str(file), file.read_text(), 'step')
    with ThreadPoolExecutor(4) as threads:
        steps = [*threads.map(lambda _: source.resolve(), range(4))]
    assert len({*steps}) == 1
