// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Conversion of converter counts to radio codes.
#ifndef T3_SENSORS_H
#define T3_SENSORS_H

#include <stdint.h>

// Codes of a range sensor that are not distances; all others are in 0.5 cm.
#define T3_RANGE_NOT_MEASURED 0u
#define T3_RANGE_TOO_NEAR 1u
#define T3_RANGE_BEYOND 254u
#define T3_RANGE_FAULT 255u

// Return the code of a Sharp GP2Y0A21YK0F from a 10-bit count of 5 V.
uint8_t t3_range_code(uint16_t count);

// Return the supply voltage (mV) of a 10-bit count behind a 1:4 divider; 0 if not measured.
uint16_t t3_battery_mv(uint16_t count);

#endif
