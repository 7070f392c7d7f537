// Copyright 2026 The t3mpc_ros developers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

// SipHash-2-4 with 64-bit output: J.-P. Aumasson, D. J. Bernstein, SipHash: a fast short-input PRF,
// INDOCRYPT 2012, DOI 10.1007/978-3-642-34931-7_28.
#ifndef T3_SIPHASH_H
#define T3_SIPHASH_H

#include <stdint.h>

#define T3_KEY_SIZE 16u

// Write the 8 bytes (little endian) of the hash of `size` bytes of `data`.
void t3_siphash(const uint8_t key[T3_KEY_SIZE], const uint8_t *data, uint8_t size, uint8_t out[8]);

#endif
