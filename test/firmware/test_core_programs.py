# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fuzzers of the firmware core, and the core with a 16-bit int."""

import re
import shutil
import subprocess

import pytest
from support.firmware_core import FIRMWARE

pytestmark = pytest.mark.skipif(shutil.which('gcc') is None, reason='needs gcc')


@pytest.mark.slow
@pytest.mark.long
def test_fuzzers_find_no_error(tmp_path):
    """Ten million bytes and a million packets with sanitizers."""
    if shutil.which('make') is None:
        pytest.skip('needs make')
    run = subprocess.run(
        ['make', '-C', FIRMWARE, 'test', f'BUILD={tmp_path}'], capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.count('robot, ') == 2


@pytest.mark.skipif(
    not (shutil.which('make') and shutil.which('avr-gcc') and shutil.which('simavr')),
    reason='needs make, avr-gcc and simavr',
)
def test_results_are_independent_of_the_int_width(tmp_path):
    """4500 packets through robot and dongle, on this machine and on a simulated ATmega2560."""
    run = subprocess.run(
        ['make', '-C', FIRMWARE, '-s', 'same', f'BUILD={tmp_path}'],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr
    output = run.stdout + run.stderr  # the simulator prints the output of the board to stderr
    assert len(re.findall(r'moving, \w+ 1[0-9]{3}', output)) == 6
    first, second = re.findall(r'checksum (\d+)', output)
    assert first == second
    cycles = dict(re.findall(r'cycles of (an? [\w ]+?) (\d+)\.', output))
    # The reply to a signed CMD must be loaded before the POLL, 2.3 ms later; the step interrupt
    # takes a third of that time.
    parts = ('a signed CMD', 'a round with ramp', 'a round with STATE')
    assert 0 < sum(int(cycles[part]) for part in parts) < 2 / 3 * 2.3e-3 * 16e6
