// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
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
