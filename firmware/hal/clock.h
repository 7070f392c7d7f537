// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The dongle's clock.
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

void clock_start(void);

// Return the microseconds since the start, modulo 2**32.
uint32_t clock_us(void);

#endif
