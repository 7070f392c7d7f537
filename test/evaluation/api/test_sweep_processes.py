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
"""Sweeps in processes of their own: Ctrl-C, and a cluster that has none of the user's files."""

import json
import os
import signal
import subprocess
import sys

import pytest
from support.checkout import ROOT
from support.waiting import communicate, wait_until

pytestmark = pytest.mark.long

SLOW = '''
import sys
import time

import t3mpc_ros as t3


class Law:
    """Every second run takes for ever."""

    def __init__(self, model, slow=0):
        self.period, self.slow = model.period, slow

    def step(self, o):
        if self.slow:
            time.sleep(3600.0)
        return (o.next_reference - o.reference) / self.period


if __name__ == '__main__':
    executor = 2
    if len(sys.argv) > 1:
        import distributed

        executor = distributed.Client(sys.argv[1])
    t3.sweep(
        Law, {'slow': [0, 1]}, seeds=[1, 2, 3], plant='servo', duration=2.0,
        output='out.parquet', executor=executor,
    )
'''

OWN = """
import sys

import distributed
import t3mpc_ros as t3
from laws.mine import Law

found = []
options = {'plant': 'servo', 'duration': 2.0, 'seeds': [1, 2]}
with distributed.Client(sys.argv[1]) as client:
    for executor in (1, client, client.get_executor(pure=False)):
        swept = t3.sweep(Law, {'noise': [0.0, 0.04]}, executor=executor, **options)
        found.append(swept.columns['overall'])
assert found[0] == found[1] == found[2]
print(found[0])
"""


def _environment():
    return {**os.environ, 'PYTHONPATH': str(ROOT)}


@pytest.fixture(scope='module')
def scheduler(tmp_path_factory):
    """Return the address of a cluster whose processes were started in another folder."""
    pytest.importorskip('distributed')
    pytest.importorskip('pyarrow')
    folder = tmp_path_factory.mktemp('elsewhere')
    log = folder / 'log'
    start = [sys.executable, '-m']
    options = {'cwd': folder, 'env': _environment(), 'stderr': subprocess.STDOUT}
    processes = []
    with log.open('w') as output:
        words = ['distributed.cli.dask_scheduler', '--host', '127.0.0.1', '--port', '0']
        words += ['--no-dashboard', '--scheduler-file', 'address.json']
        processes.append(subprocess.Popen([*start, *words], stdout=output, **options))
        wait_until((folder / 'address.json').exists, 'the scheduler does not start')
        words = ['distributed.cli.dask_worker', '--scheduler-file', 'address.json']
        words += ['--nworkers', '2', '--nthreads', '1', '--no-dashboard']
        processes.append(subprocess.Popen([*start, *words], stdout=output, **options))
        yield json.loads((folder / 'address.json').read_text())['address']
        for process in reversed(processes):
            process.terminate()
            communicate(process)


def test_a_module_beside_the_script_runs_on_a_cluster(scheduler, tmp_path):
    """Neither scheduler nor workers had the module: 40 lines from inside the scheduler."""
    (tmp_path / 'laws').mkdir()
    (tmp_path / 'laws' / 'mine.py').write_text(
        'from gains import GAIN\n\n\nclass Law:\n'
        '    def __init__(self, model):\n        self.period = model.period\n\n'
        '    def step(self, o):\n        slope = (o.next_reference - o.reference) / self.period\n'
        '        return slope - GAIN * (o.speeds - o.reference)\n'
    )
    (tmp_path / 'script.py').write_text(OWN)
    printed = []
    for gain in (10.0, 40.0):  # the second one on the same workers
        (tmp_path / 'gains.py').write_text(f'GAIN = {gain}\n')
        done = subprocess.run(
            [sys.executable, 'script.py', scheduler],
            cwd=tmp_path,
            env=_environment(),
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout)
    assert printed[0] != printed[1]


@pytest.mark.parametrize('where', ['processes', 'cluster'])
def test_ctrl_c_waits_for_no_run_and_keeps_finished_ones(where, tmp_path, request):
    """It returned after 10 to 15 s, when the runs that had begun were done."""
    words = [request.getfixturevalue('scheduler')] if where == 'cluster' else []
    (tmp_path / 'script.py').write_text(SLOW)
    journal = tmp_path / 'out.parquet.runs.jsonl'
    process = subprocess.Popen(
        [sys.executable, 'script.py', *words],
        cwd=tmp_path,
        env=_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_until(lambda: journal.exists() and journal.read_text(), 'no run is finished')
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, errors = communicate(process)
    assert process.returncode == -signal.SIGINT
    assert errors.count('Traceback') == 1, errors
    assert journal.read_text().count('\n') >= 1
