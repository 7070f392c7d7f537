# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""SipHash-2-4 equals the published one."""

import json
from pathlib import Path

import pytest

from t3mpc_ros.radio.protocol.authentication import siphash

VECTORS = json.loads((Path(__file__).parents[1] / 'golden' / 'radio_vectors.json').read_text())


def test_all_64_vectors_of_the_reference_implementation():
    key, tags = bytes.fromhex(VECTORS['siphash']['key']), VECTORS['siphash']['tags']
    assert len(tags) == 64
    for length, tag in enumerate(tags):
        assert siphash(key, bytes(range(length))).hex() == tag


def test_the_worked_example_of_the_paper():
    """Appendix A of the paper: 15 bytes under the key 00 … 0f give a129ca6149be45e5."""
    tag = siphash(bytes(range(16)), bytes(range(15)))
    assert int.from_bytes(tag, 'little') == 0xA129CA6149BE45E5


def test_every_input_bit_changes_about_half_of_the_tag():
    key, message = bytes(range(16)), bytes(range(40, 61))
    tag = int.from_bytes(siphash(key, message), 'little')
    changed = []
    for bit in range(8 * (len(key) + len(message))):
        data = bytearray(key + message)
        data[bit // 8] ^= 1 << bit % 8
        other = siphash(bytes(data[:16]), bytes(data[16:]))
        changed.append((tag ^ int.from_bytes(other, 'little')).bit_count())
    assert min(changed) > 12  # 5 sigma below 32
    assert max(changed) < 52
    assert abs(sum(changed) / len(changed) - 32.0) < 1.0


@pytest.mark.parametrize('size', [0, 15, 17])
def test_a_key_of_wrong_length_is_rejected(size):
    with pytest.raises(ValueError, match=f'key must be 16 bytes long: got {size}'):
        siphash(bytes(size), b'')
