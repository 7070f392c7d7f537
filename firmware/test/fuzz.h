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

// Shared by the fuzzers: a random generator with equal numbers everywhere, and a check that reports
// what failed.
#ifndef FUZZ_H
#define FUZZ_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#define CHECK(condition)                                                                       \
    do {                                                                                       \
        if (!(condition)) {                                                                    \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition);            \
            exit(1);                                                                           \
        }                                                                                      \
    } while (0)

// G. Marsaglia, Xorshift RNGs, J. Stat. Softw. 8 (2003), DOI 10.18637/jss.v008.i14.
static uint64_t fuzz_seed = 0x74336D70635F726Full;

static inline uint32_t fuzz_next(void)
{
    fuzz_seed ^= fuzz_seed << 13;
    fuzz_seed ^= fuzz_seed >> 7;
    fuzz_seed ^= fuzz_seed << 17;
    return (uint32_t)(fuzz_seed >> 32);
}

// From 0 to below `count`.
static inline uint32_t fuzz_below(uint32_t count)
{
    return fuzz_next() % count;
}

static inline uint8_t fuzz_byte(void)
{
    return (uint8_t)fuzz_next();
}

#endif
