# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Signals as a flag."""

import os
import signal
import subprocess
import sys

import pytest
from support.signals import attended

from t3mpc_ros.stop_signal import SIGNALS, StopSignal


@pytest.mark.parametrize('number', SIGNALS)
def test_the_first_signal_is_kept(number):
    with attended():
        before = [signal.getsignal(each) for each in SIGNALS]
        with StopSignal() as stop:
            assert not stop()
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop()
            assert stop.number == number
        assert [signal.getsignal(each) for each in SIGNALS] == before


def test_an_ignored_hangup_stays_ignored():
    """A handler would end what was started with nohup when its terminal closes."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_during_the_start_ends_the_process_with_code_0():
    program = (
        'import os, signal; from t3mpc_ros.stop_signal import StopSignal; '
        'StopSignal().install().exit_at_once = True; '
        'os.kill(os.getpid(), signal.SIGTERM); raise SystemExit(3)'
    )
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0
