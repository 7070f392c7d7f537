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
"""Seed fingerprints identify the right seed, and reveal no information about it."""

import hashlib

import pytest

from t3mpc_ros.chaos.seed_fingerprint import fingerprint_seed, matches_fingerprint

SALT = bytes(range(16))


@pytest.mark.parametrize('seed', [0, 42, 2**127 + 12345])
def test_the_right_seed_is_recognised_and_others_are_not(seed):
    text = fingerprint_seed(seed, SALT)
    assert matches_fingerprint(text, seed)
    for other in (seed + 1, seed ^ 2**64, seed * 10):
        assert matches_fingerprint(text, other) == (other == seed)


def test_fingerprint_is_the_sha256_of_salt_and_seed():
    for salt in (SALT, SALT[::-1]):
        digest = hashlib.sha256(salt + b'42').hexdigest()
        assert fingerprint_seed(42, salt) == f'{salt.hex()}:{digest}'


@pytest.mark.parametrize('text', ['', 'a:b', '00' * 16, f'{"00" * 16}:{"g" * 64}', '0' * 97])
def test_a_malformed_fingerprint_is_an_error(text):
    with pytest.raises(ValueError, match='salt:digest'):
        matches_fingerprint(text, 1)


def test_invalid_salt_and_seed_are_rejected_without_the_seed():
    with pytest.raises(ValueError, match='at least 16 bytes: got 15'):
        fingerprint_seed(123456789, SALT[:15])
    with pytest.raises(ValueError, match='negative') as error:
        fingerprint_seed(-123456789, SALT)
    assert '123456789' not in str(error.value)
