# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""SipHash-2-4, the keyed hash behind every tag of the radio link.

J.-P. Aumasson, D. J. Bernstein, SipHash: a fast short-input PRF, INDOCRYPT 2012,
DOI 10.1007/978-3-642-34931-7_28. Checked against the 64 published vectors of its 8-byte output.
"""

KEY_SIZE = 16
"""bytes"""
TAG_SIZE = 8
"""bytes"""

_MASK = 0xFFFFFFFFFFFFFFFF


def siphash(key: bytes, message: bytes) -> bytes:
    """Return the 8 bytes (little endian) of SipHash-2-4 of ``message`` under ``key``.

    Raises
    ------
    ValueError
        The key is not 16 bytes long.
    """
    if len(key) != KEY_SIZE:
        raise ValueError(f'key must be {KEY_SIZE} bytes long: got {len(key)}')
    low, high = int.from_bytes(key[:8], 'little'), int.from_bytes(key[8:], 'little')
    # The nothing-up-my-sleeve number of the paper: "somepseudorandomlygeneratedbytes".
    state = (
        low ^ 0x736F6D6570736575,
        high ^ 0x646F72616E646F6D,
        low ^ 0x6C7967656E657261,
        high ^ 0x7465646279746573,
    )
    whole = len(message) - len(message) % 8
    last = (len(message) & 0xFF) << 56 | int.from_bytes(message[whole:], 'little')
    words = [int.from_bytes(message[at : at + 8], 'little') for at in range(0, whole, 8)]
    for word in (*words, last):
        a, b, c, d = _rounds(state[0], state[1], state[2], state[3] ^ word, 2)
        state = a ^ word, b, c, d
    a, b, c, d = _rounds(state[0], state[1], state[2] ^ 0xFF, state[3], 4)
    return (a ^ b ^ c ^ d).to_bytes(TAG_SIZE, 'little')


def _rounds(a: int, b: int, c: int, d: int, count: int) -> tuple[int, int, int, int]:
    """Return the state (v0..v3) after ``count`` SipRounds."""
    for _ in range(count):
        a = (a + b) & _MASK
        b = (b << 13 & _MASK | b >> 51) ^ a
        a = a << 32 & _MASK | a >> 32
        c = (c + d) & _MASK
        d = (d << 16 & _MASK | d >> 48) ^ c
        a = (a + d) & _MASK
        d = (d << 21 & _MASK | d >> 43) ^ a
        c = (c + b) & _MASK
        b = (b << 17 & _MASK | b >> 47) ^ c
        c = c << 32 & _MASK | c >> 32
    return a, b, c, d
