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
"""Fault injection of the emulator: notation, bounds and defaults."""

import pytest

from t3mpc_ros.emulator import fault_injection


def test_a_fault_is_written_as_name_time_duration_value():
    assert fault_injection.parse_fault('jam:5:1.0') == fault_injection.Fault(
        'jam', 5.0, 1.0, fault_injection.parse_fault('jam:5').value
    )
    assert fault_injection.parse_fault('loss:5:inf:0.3') == fault_injection.Fault(
        'loss', 5.0, float('inf'), 0.3
    )
    assert fault_injection.parse_fault('robot_reset:2').duration == 0.5


@pytest.mark.parametrize(
    'text, words',
    [
        ('jamm:5', 'did you mean jam'),
        ('jam', 'name:at'),
        ('jam:1:2:3:4', 'name:at'),
        ('jam:soon', 'numbers'),
        ('jam:-1', 'at least 0 s'),
        ('jam:nan', 'at least 0 s'),
        ('jam:1:0', 'more than 0 s'),
        ('jam:1:1:0.5', 'takes no value'),
        ('loss:1:1:1.5', 'from 0 to 1'),
    ],
)
def test_an_invalid_fault_is_rejected_with_a_reason(text, words):
    with pytest.raises(fault_injection.FaultError, match=words):
        fault_injection.parse_fault(text)


def test_every_fault_has_valid_defaults():
    for kind in fault_injection.FAULT_KINDS:
        assert fault_injection.check_fault(fault_injection.Fault(kind.name, 0.0)).duration > 0.0


def test_of_two_faults_of_a_kind_the_later_one_holds():
    """A link that always loses a little gets much worse for a second, then is as before."""
    now_ns = 0
    faults = fault_injection.FaultInjection(lambda: now_ns, seed=1)
    for text in ('loss:1:10:0.1', 'loss:3:1:0.9', 'loss:20:1:0.5'):
        faults.add(fault_injection.parse_fault(text), 0)
    values = []
    for seconds in (0, 1, 2, 3, 3.5, 4, 5, 11, 20.5):
        now_ns = round(seconds * 1e9)
        values.append(faults.value('loss'))
    assert values == [0.0, 0.1, 0.1, 0.9, 0.9, 0.1, 0.1, 0.0, 0.5]
