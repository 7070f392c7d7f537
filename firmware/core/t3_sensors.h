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

// Conversion of converter counts to radio codes.
#ifndef T3_SENSORS_H
#define T3_SENSORS_H

#include <stdint.h>

// Codes of a range sensor that are not distances; all others are in 0.5 cm.
#define T3_RANGE_NOT_MEASURED 0u
#define T3_RANGE_TOO_NEAR 1u
#define T3_RANGE_BEYOND 254u
#define T3_RANGE_FAULT 255u

// Types of a distance sensor, as in the settings.
enum {
    T3_SENSOR_NONE,
    T3_SENSOR_GP2Y0A21,  // 10 to 80 cm
    T3_SENSOR_GP2Y0A41,  // 4 to 30 cm
    T3_SENSORS
};

// V = scale / (d + shift) + offset
struct t3_curve {
    uint16_t scale;  // 0.1 mV m
    int16_t shift;   // 0.1 mm
    int16_t offset;  // 0.1 mV
};
#define T3_CURVE_SCALE_LIMIT 10485u

// Return the code of a sensor from a 10-bit count of 5 V; without a curve (NULL), that of its data sheet
// holds.
uint8_t t3_range_code_of(uint8_t sensor, const struct t3_curve *curve, uint16_t count);

// Return the code of a GP2Y0A21YK0F with the curve of its data sheet.
uint8_t t3_range_code(uint16_t count);

// Return the supply voltage (mV) of a 10-bit count behind a divider of `divider` / 1000 : 1; 0 if not
// measured.
uint16_t t3_battery_mv_of(uint16_t divider, uint16_t count);

// Return it behind a divider of 4 : 1.
uint16_t t3_battery_mv(uint16_t count);

#endif
