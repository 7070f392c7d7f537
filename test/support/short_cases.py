# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Plugin that ends each test after a second of processor time: ``-p support.short_cases``.

For the coverage of kernels, which are a hundred times slower without the compiler. A test that is
ended counts as skipped; one that fails before fails.
"""

import signal

import pytest

LIMIT = 1.0
"""Processor time of a test without its fixtures, s."""


class EnoughError(BaseException):
    """Ends a test, past every ``except Exception``."""


def _end(number, frame):
    raise EnoughError


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    signal.signal(signal.SIGVTALRM, _end)
    signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT)
    try:
        return (yield)
    except EnoughError:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        pytest.skip(f'ended after {LIMIT:g} s of processor time')
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
