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
"""Salted hash of a seed: proves knowledge of the seed without publishing it.

The seed of a patrol determines the path of the robot, so no parameter, log or bag contains it. The
diagnostics contain its fingerprint: a random salt and the SHA-256 of salt and seed. It hides a
seed of 128 random bits; a small number chosen by hand is found by trying every one.
"""

import hashlib
import hmac
import re

SALT_BYTES = 16
FINGERPRINT_KEY = 'seed_fingerprint'
"""Key of the fingerprint in a node's diagnostics."""

_PATTERN = re.compile(r'([0-9a-f]{32,}):([0-9a-f]{64})')


def fingerprint_seed(seed: int, salt: bytes) -> str:
    """Return the fingerprint of ``seed``: salt and digest as hexadecimal digits, with a colon.

    The salt has at least :data:`SALT_BYTES` random bytes, new ones for each fingerprint.
    """
    if len(salt) < SALT_BYTES:
        raise ValueError(f'salt must have at least {SALT_BYTES} bytes: got {len(salt)}')
    if seed < 0:
        raise ValueError('seed must not be negative')  # without its value, which is secret
    digest = hashlib.sha256(salt + str(seed).encode('ascii')).hexdigest()
    return f'{salt.hex()}:{digest}'


def matches_fingerprint(text: str, seed: int) -> bool:
    """Return whether ``text`` is a fingerprint of ``seed``.

    ValueError: ``text`` does not have the form of a fingerprint.
    """
    match = _PATTERN.fullmatch(text)
    if not match or len(match[1]) % 2:
        raise ValueError(f'a fingerprint must look like salt:digest in hexadecimal: got {text!r}')
    return hmac.compare_digest(fingerprint_seed(seed, bytes.fromhex(match[1])), text)
