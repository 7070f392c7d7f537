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
"""Fuzzers of the firmware core, the search over its sessions, and the core with a 16-bit int."""

import re
import shutil
import subprocess

import pytest
from support.firmware_core import FIRMWARE, run_make
from support.long_tests import few_of
from support.missing_tools import needing, needs

pytestmark = needing('gcc')


@pytest.mark.slow
@pytest.mark.long
def test_fuzzers_find_no_error(tmp_path):
    """Ten million bytes and a million packets with sanitizers; all states of a session."""
    needs('make')
    run = run_make(tmp_path, 'test')
    assert run.returncode == 0, run.stderr
    assert run.stdout.count('robot, ') == 2
    assert run.stdout.count(' deep, all\n') == 2


def search(folder, firmware=FIRMWARE, slots=2, depth=1000):
    """Compile and run the search over the states of a session; return the process."""
    program = folder / 'search'
    sources = sorted(map(str, [*firmware.glob('core/*.c'), firmware / 'test/search_sessions.c']))
    options = ['-std=c99', '-O2', f'-DT3_SLOTS={slots}']
    folders = [f'-I{firmware / part}' for part in ('core', 'test')]
    subprocess.run(['gcc', *options, *folders, '-o', program, *sources], check=True)
    return subprocess.run([program, str(depth)], capture_output=True, text=True)


@pytest.mark.parametrize('slots, depth', few_of([(2, 4), (2, 5), (3, 6)]))
def test_no_order_of_frames_breaks_a_session(tmp_path, slots, depth):
    """All made and delivered in every order, or fewer with time, resets, button and battery.

    ``make test`` goes on with two frames until there is no new state.
    """
    run = search(tmp_path, slots=slots, depth=depth)
    print(f'\n{run.stdout}')
    assert run.returncode == 0, run.stderr
    assert run.stdout.count(f'{depth} deep') == 2


ROBOT, SESSION = 't3_robot.c', 't3_session.c'
MUTATIONS = {
    'a sequence number counts twice': (ROBOT, '(ahead == 0 || ahead >= 0x80)', '(ahead >= 0x80)'),
    'older numbers count': (ROBOT, '(ahead == 0 || ahead >= 0x80)', '(ahead == 0)'),
    'the echo is not used': (ROBOT, 'ttl_us - excess_us : UINT32_MAX', 'ttl_us : ttl_us'),
    'old echoes take nothing': (ROBOT, 'ttl_us - excess_us : UINT32_MAX', 'ttl_us : UINT32_MAX'),
    'the TTL does not run': (ROBOT, 'robot->ttl_runs = ttl_us != 0;', ''),
    'HELLO keeps the motion': (ROBOT, 'disable(robot); robot->expired =', 'robot->expired ='),
    'HELLO keeps the number': (
        ROBOT,
        'robot->seq_known = robot->command_seen = robot->action_done = false; robot->seq = 0;',
        'robot->command_seen = robot->action_done = false;',
    ),
    'ESTOP is not latched': (ROBOT, 'robot->estop = true;', ''),
    'ESTOP does not stop': (ROBOT, 'robot->estop = true; disable(robot);', 'robot->estop = true;'),
    'a pressed button is cleared': (ROBOT, '!robot->pressed && !button(robot)', 'true'),
    'an empty battery drives': (ROBOT, 'robot->estop || robot->flat ||', 'robot->estop ||'),
    'a late stop is ignored': (ROBOT, 'if (wants_to_stand(packet))', 'if (false)'),
    'silence ends no session': (ROBOT, 't3_session_end(&robot->session); disable(robot);', ''),
    'a session is not needed': (SESSION, 'if (!session->id || packet', 'if (packet'),
    'any session will do': (SESSION, '|| packet->session != session->id)', ')'),
    'a signed frame counts twice': (SESSION, 'packet->host_us == session->last_us', 'false'),
    'older signed frames count': (SESSION, '(packet->host_us < session->last_us)', '0'),
    'HELLO begins a session twice': (SESSION, 'if (*repeated) return', 'if (false) return'),
    'the robot has no nonce': (SESSION, 'draw_nonce(session, port); t3', 't3'),
}


@pytest.mark.long
@pytest.mark.parametrize('name', MUTATIONS)
def test_the_search_finds_each_broken_rule(tmp_path, name):
    """Else the search would prove nothing."""
    file, before, after = MUTATIONS[name]
    for part in ('core', 'test'):
        shutil.copytree(FIRMWARE / part, tmp_path / part)
    path = tmp_path / 'core' / file
    pattern = re.sub(r'(\\ )+', r'\\s+', re.escape(before))
    text, count = re.subn(pattern, after, path.read_text())
    assert count == 1
    path.write_text(text)
    run = search(tmp_path, tmp_path, depth=12)
    print(f'\n{name}: {run.stderr}')
    assert run.returncode == 1
    assert 'not so' in run.stderr


# Golden frames and every rule on the boards: test_avr_*.
@pytest.mark.long
@needing('make', 'avr-gcc', 'simavr')
def test_results_are_independent_of_the_int_width(tmp_path):
    """2250 packets through robot and dongle, on this machine and on a simulated ATmega2560."""
    run = run_make(tmp_path, 'same')
    assert run.returncode == 0, run.stderr
    output = run.stdout + run.stderr  # the simulator prints the output of the board to stderr
    assert len(re.findall(r'moving, \w+ [5-7][0-9]{2}', output)) == 6
    first, second = re.findall(r'checksum (\d+)', output)
    assert first == second
    cycles = dict(re.findall(r'cycles of (an? [\w ]+?) (\d+)\.', output))
    # The reply to a signed CMD must be loaded before the POLL, 2.3 ms later; the step interrupt
    # takes a third of that time.
    parts = ('a signed CMD', 'a round with ramp', 'a round with STATE')
    assert 0 < sum(int(cycles[part]) for part in parts) < 2 / 3 * 2.3e-3 * 16e6
