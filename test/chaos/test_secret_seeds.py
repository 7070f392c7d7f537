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
"""Fingerprints and random numbers of a secret seed identify it, and say nothing of it."""

import hashlib

import numpy as np
import pytest
from scipy.stats import kstest

from t3mpc_ros.chaos.salted_seed_hash import fingerprint_seed, matches_fingerprint
from t3mpc_ros.chaos.secret_random import SecretRandom

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


def test_numbers_are_those_of_the_keyed_hash():
    """53 bits each of the blocks of BLAKE2b, whose key is the digest of the seed."""
    key = hashlib.blake2b((300).to_bytes(2, 'little')).digest()
    first = hashlib.blake2b(bytes(16), key=key, person=b'mirrors').digest()
    expected = [int.from_bytes(first[k : k + 8], 'little') / 2.0**64 for k in range(0, 64, 8)]
    np.testing.assert_allclose(SecretRandom(300, 'mirrors').uniform(8), expected, atol=1e-15)


def test_numbers_are_even_and_those_of_other_seeds_independent():
    one = SecretRandom(2**127 + 5, 'a').uniform(4000)
    assert kstest(one, 'uniform').pvalue > 0.01
    np.testing.assert_array_equal(one, SecretRandom(2**127 + 5, 'a').uniform(4000))
    others = [SecretRandom(seed, 'a') for seed in (5, 2**127 + 4, 2**128 + 2**127 + 5)]
    for other in (*others, SecretRandom(2**127 + 5, 'b')):
        drawn = other.uniform(4000)
        assert abs(np.corrcoef(one, drawn)[0, 1]) < 0.05
        assert abs(np.corrcoef(one[1:], drawn[:-1])[0, 1]) < 0.05


def test_whole_numbers_and_times():
    source = SecretRandom(1, 'a')
    shares = np.bincount([source.below(6) for _ in range(6000)]) / 6000
    np.testing.assert_allclose(shares, 1.0 / 6.0, atol=0.02)
    times = [source.exponential(8.0) for _ in range(3000)]
    assert kstest(times, 'expon', args=(0.0, 8.0)).pvalue > 0.01
    with pytest.raises(ValueError, match='negative') as error:
        SecretRandom(-918273645, 'a')
    assert '918273645' not in str(error.value)
