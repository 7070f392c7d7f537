// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// What converter counts mean on the radio.
#ifndef T3_SENSORS_H
#define T3_SENSORS_H

#include <stdint.h>

// Codes of a distance sensor that are no distance; all others are half centimetres.
#define T3_RANGE_NOT_MEASURED 0u
#define T3_RANGE_TOO_NEAR 1u
#define T3_RANGE_BEYOND 254u
#define T3_RANGE_FAULT 255u

// Return the code of a Sharp GP2Y0A21YK0F from a 10-bit count of 5 V.
uint8_t t3_range_code(uint16_t count);

// Return the supply in mV from a 10-bit count behind a divider of 1 : 4; 0 if not measured.
uint16_t t3_battery_mv(uint16_t count);

#endif
