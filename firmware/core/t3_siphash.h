// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// SipHash-2-4 with 64-bit output: J.-P. Aumasson, D. J. Bernstein, SipHash: a fast short-input PRF,
// INDOCRYPT 2012, DOI 10.1007/978-3-642-34931-7_28.
#ifndef T3_SIPHASH_H
#define T3_SIPHASH_H

#include <stdint.h>

#define T3_KEY_SIZE 16u

// Write the 8 bytes (little endian) of the hash of `size` bytes of `data`.
void t3_siphash(const uint8_t key[T3_KEY_SIZE], const uint8_t *data, uint8_t size, uint8_t out[8]);

#endif
