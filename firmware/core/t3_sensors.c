// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "t3_sensors.h"

#include "t3_port.h"

// Sharp, data sheet E4-A00201EN, figure 2, from 10 to 80 cm within 2 %:
//     V = 0.282 / (d + 0.0257) + 0.061          (V, m)
// With V = 5 (count + 1/2) / 1024 the distance in 1/128 of half a centimetre is
//     3696230400 / (2500 count - 29982) - 658.
#define FRACTION 7u  // bits
#define SLOPE UINT32_C(3696230400)
#define COUNT_SCALE UINT32_C(2500)
#define COUNT_OFFSET UINT32_C(29982)
#define SHIFT UINT32_C(658)
#define NEAREST (UINT32_C(20) << FRACTION)    // 10 cm
#define FARTHEST (UINT32_C(160) << FRACTION)  // 80 cm
#define HALF (UINT32_C(1) << (FRACTION - 1))
// The sensor gives 3.2 V at most: above 4.8 V its wire hangs on the supply.
#define COUNT_LIMIT 983u
#define CONVERTER_END 1023u
// Below this the formula has no distance: nothing there.
#define COUNT_LEAST 12u

uint8_t t3_range_code(uint16_t count)
{
    if (count == T3_ADC_NOT_MEASURED)
        return T3_RANGE_NOT_MEASURED;
    if (count > COUNT_LIMIT)
        return T3_RANGE_FAULT;
    if (count < COUNT_LEAST)
        return T3_RANGE_BEYOND;
    // Nearer than 10 cm the voltage falls again; the far branch is never extrapolated.
    const uint32_t shifted = SLOPE / (COUNT_SCALE * count - COUNT_OFFSET);
    if (shifted < NEAREST + SHIFT)
        return T3_RANGE_TOO_NEAR;
    if (shifted > FARTHEST + SHIFT)
        return T3_RANGE_BEYOND;
    return (uint8_t)((shifted - SHIFT + HALF) >> FRACTION);
}

uint16_t t3_battery_mv(uint16_t count)
{
    if (count > CONVERTER_END)
        return 0;
    return (uint16_t)((uint32_t)count * UINT32_C(20000) / UINT32_C(1024));
}
