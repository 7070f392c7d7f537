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
#include "t3_calibration.h"

#include <string.h>

#include "t3_bytes.h"

#define FORMAT 1u

// Positions in the body.
enum {
    WHEEL_RADIUS = 1,  // u32, 0.1 um; uncertainty u16, 0.1 um
    TRACK = 7,         // the same
    GYRO_SCALE = 13,   // i16, true rate / nominal rate - 1, 1e-5; uncertainty u16, 1e-5
    GYRO_BIAS = 17,    // i16, 0.001 deg/s; uncertainty u16, 0.001 deg/s
    DIVIDER = 21,      // gain - 1 i16, 1e-5; offset i16, mV; uncertainty u16, mV
    CURVES = 27        // 8 times: scale u16, shift i16, offset i16 (t3_curve); uncertainty u8, mm
};
#define CURVE_SIZE 7u
#define SHARE INT32_C(100000)
#define SHARE_LIMIT INT16_C(20000)
#define LENGTH_LEAST UINT32_C(10000)  // 1 mm
#define LENGTH_LIMIT UINT32_C(100000000)  // 10 m

static bool lengths_valid(const uint8_t *from)
{
    const uint32_t length = t3_get32(from);
    return t3_get16(from + 4) ? length >= LENGTH_LEAST && length <= LENGTH_LIMIT : !length;
}

static bool share_valid(uint16_t share)
{
    const int16_t value = t3_signed16(share);
    return value >= -SHARE_LIMIT && value <= SHARE_LIMIT;
}

static bool curve_valid(const uint8_t *from)
{
    const uint16_t scale = t3_get16(from);
    if (!from[6])
        return !scale && !t3_get16(from + 2) && !t3_get16(from + 4);
    return scale && scale <= T3_CURVE_SCALE_LIMIT;
}

bool t3_calibration_valid(const uint8_t *body)
{
    const uint16_t scale = t3_get16(body + GYRO_SCALE), bias = t3_get16(body + GYRO_BIAS);
    const uint16_t gain = t3_get16(body + DIVIDER), offset = t3_get16(body + DIVIDER + 2);
    if (body[0] != FORMAT || !lengths_valid(body + WHEEL_RADIUS) || !lengths_valid(body + TRACK) ||
        !share_valid(scale) || !share_valid(gain))
        return false;
    if ((!t3_get16(body + GYRO_SCALE + 2) && scale) || (!t3_get16(body + GYRO_BIAS + 2) && bias) ||
        (!t3_get16(body + DIVIDER + 4) && (gain || offset)))
        return false;
    for (uint8_t i = 0; i < T3_RANGES; i++)
        if (!curve_valid(body + CURVES + i * CURVE_SIZE))
            return false;
    return true;
}

static const struct t3_copies_kind KIND = {T3_STORE_CALIBRATION, T3_STORE_CALIBRATION_COPY,
                                           T3_STORE_CALIBRATION_SIZE, FORMAT,
                                           t3_calibration_valid};

void t3_calibration_boot(struct t3_calibration *calibration, const struct t3_port *port)
{
    memset(calibration->now, 0, sizeof calibration->now);
    calibration->now[0] = FORMAT;
    if (t3_copies_boot(&calibration->copies, &KIND, port))
        memcpy(calibration->now, calibration->copies.record, sizeof calibration->now);
}

bool t3_calibration_usable(const struct t3_calibration *calibration)
{
    return calibration->copies.state <= T3_SETTINGS_MISSING;
}

void t3_calibration_write(struct t3_calibration *calibration, const struct t3_port *port,
                          const uint8_t *body)
{
    t3_copies_write(&calibration->copies, port, body);
}

enum t3_progress t3_calibration_tick(struct t3_calibration *calibration,
                                     const struct t3_port *port,
                                     const struct t3_console_port *console)
{
    const enum t3_progress progress = t3_copies_tick(&calibration->copies, port, console);
    if (progress == T3_PROGRESS_DONE)
        memcpy(calibration->now, calibration->copies.record, sizeof calibration->now);
    return progress;
}

uint16_t t3_calibration_battery(const struct t3_calibration *calibration, uint16_t voltage)
{
    const uint8_t *from = calibration->now + DIVIDER;
    if (!voltage || !t3_get16(from + 4))
        return voltage;
    const int32_t gain = t3_signed16(t3_get16(from)), offset = t3_signed16(t3_get16(from + 2));
    // 65535 mV times 20000 has 31 bits.
    const int32_t corrected = (int32_t)voltage + (int32_t)voltage * gain / SHARE + offset;
    if (corrected < 1)
        return 1;
    return corrected > UINT16_MAX ? UINT16_MAX : (uint16_t)corrected;
}

bool t3_calibration_curve(const struct t3_calibration *calibration, uint8_t sensor,
                          struct t3_curve *curve)
{
    const uint8_t *from = calibration->now + CURVES + sensor * CURVE_SIZE;
    curve->scale = t3_get16(from);
    curve->shift = t3_signed16(t3_get16(from + 2));
    curve->offset = t3_signed16(t3_get16(from + 4));
    return from[6] != 0;
}
