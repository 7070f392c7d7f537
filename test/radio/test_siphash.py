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


@pytest.mark.parametrize('size', [0, 15, 17])
def test_a_key_of_wrong_length_is_rejected(size):
    with pytest.raises(ValueError, match=f'key must be 16 bytes long: got {size}'):
        siphash(bytes(size), b'')
