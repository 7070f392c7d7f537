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
#include "t3_sensors.h"

#include <stddef.h>

#include "t3_port.h"

// With V = 5 (count + 1/2) / 1024 a distance in 1/128 of half a centimetre is
//     409600 scale / ((3125 (2 count + 1) - 128 offset) / 8) - 2.56 shift.
#define FRACTION 7u  // bits
#define SCALE_UNIT UINT32_C(409600)
#define HALF (INT32_C(1) << (FRACTION - 1))
#define SHIFT_BIAS INT32_C(32768)
// The sensors give 3.2 V at most: above 4.8 V the wire hangs on the supply.
#define COUNT_LIMIT 983u
#define CONVERTER_END 1023u

struct sensor {
    struct t3_curve curve;
    uint8_t nearest, farthest;  // half centimetres
};

static const struct sensor SENSORS[T3_SENSORS] = {
    // Data sheet E4-A00201EN, figure 2, from 10 to 80 cm within 2 %.
    [T3_SENSOR_GP2Y0A21] = {{2820, 257, 610}, 20, 160},
    // Data sheet OP13008EN, electro-optical characteristics, typical: 0.4 V (0.25 to 0.55) at 30 cm, and
    // 2.25 V (1.95 to 2.55) more at 4 cm. The curve through these two points without an offset; the usual
    // fits to measured sensors give distances within 8 % of it. A single sensor may differ by 40 % at
    // 30 cm: calibrate it.
    [T3_SENSOR_GP2Y0A41] = {{1225, 62, 0}, 8, 60},
};

uint8_t t3_range_code_of(uint8_t sensor, const struct t3_curve *curve, uint16_t count)
{
    if (sensor == T3_SENSOR_NONE || sensor >= T3_SENSORS || count == T3_ADC_NOT_MEASURED)
        return T3_RANGE_NOT_MEASURED;
    if (count > COUNT_LIMIT)
        return T3_RANGE_FAULT;
    const struct sensor *known = &SENSORS[sensor];
    if (!curve)
        curve = &known->curve;
    const int32_t above = INT32_C(3125) * (2 * (int32_t)count + 1) - INT32_C(128) * curve->offset;
    if (above < 8)
        return T3_RANGE_BEYOND;
    const uint32_t shifted = SCALE_UNIT * curve->scale / ((uint32_t)above >> 3);
    // 2.56 is 10486 / 4096, rounded; of a number without a sign, since the AVR divides others by a loop.
    const uint32_t positive = (uint32_t)((int32_t)curve->shift + SHIFT_BIAS);
    const int32_t shift = (int32_t)((positive * 10486u + 2048u) >> 12) - SHIFT_BIAS / 4096 * 10486;
    // Nearer than its least distance the voltage falls again; the far branch is never extrapolated.
    if (shifted > UINT32_C(1) << 20)
        return T3_RANGE_BEYOND;
    const int32_t distance = (int32_t)shifted - shift;
    if (distance < (int32_t)known->nearest << FRACTION)
        return T3_RANGE_TOO_NEAR;
    if (distance > (int32_t)known->farthest << FRACTION)
        return T3_RANGE_BEYOND;
    return (uint8_t)((distance + HALF) >> FRACTION);
}

uint8_t t3_range_code(uint16_t count)
{
    return t3_range_code_of(T3_SENSOR_GP2Y0A21, NULL, count);
}

uint16_t t3_battery_mv_of(uint16_t divider, uint16_t count)
{
    if (count > CONVERTER_END)
        return 0;
    return (uint16_t)((uint32_t)count * divider * 5u / 1024u);
}

uint16_t t3_battery_mv(uint16_t count)
{
    return t3_battery_mv_of(4000, count);
}
