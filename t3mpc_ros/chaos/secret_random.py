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
"""Random numbers from which nobody finds the seed: BLAKE2b in counter mode, keyed by the seed.

The generators of numpy pass statistical tests, but from some outputs the others can be computed. A
keyed hash is taken to be a pseudo-random function (RFC 7693): without its key its numbers cannot
be told from others. What a robot has shown of its path says nothing of a seed of 128 random bits.
"""

import hashlib
import math

import numpy as np

from t3mpc_ros.geometry.types import Array

_BITS = 53


class SecretRandom:
    """Numbers of a seed, of any length, for a purpose; equal ones give equal numbers."""

    def __init__(self, seed: int, purpose: str) -> None:
        if seed < 0:
            raise ValueError('seed must not be negative')  # without its value, which is secret
        size = max(1, -(-seed.bit_length() // 8))
        self._key = hashlib.blake2b(seed.to_bytes(size, 'little')).digest()
        self._purpose = purpose.encode()
        self._block = 0
        self._words: list[int] = []
        """Rest of the last block."""

    def uniform(self, count: int) -> Array:
        """Return numbers from 0 to 1, the latter excluded, shape (count,)."""
        return np.array([self._word() / 2.0**_BITS for _ in range(count)])

    def below(self, bound: int) -> int:
        """Return a whole number from 0 to ``bound``, the latter excluded."""
        return self._word() * bound >> _BITS

    def exponential(self, mean: float) -> float:
        """Return a time without memory, whose mean is ``mean``."""
        return -mean * math.log(1.0 - self._word() / 2.0**_BITS)

    def _word(self) -> int:
        """Return the next whole number of 53 bits."""
        if not self._words:
            block = self._block.to_bytes(16, 'little')
            digest = hashlib.blake2b(block, key=self._key, person=self._purpose).digest()
            words = [digest[first : first + 8] for first in range(0, len(digest), 8)]
            self._words = [int.from_bytes(word, 'little') >> (64 - _BITS) for word in words]
            self._block += 1
        return self._words.pop(0)
