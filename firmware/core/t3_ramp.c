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
#include "t3_ramp.h"

static uint32_t magnitude(int32_t value)
{
    return value < 0 ? 0u - (uint32_t)value : (uint32_t)value;
}

static uint32_t larger(uint32_t a, uint32_t b)
{
    return a > b ? a : b;
}

static bool speeds_up(int32_t speed, int32_t target)
{
    return (target > speed && speed >= 0) || (target < speed && speed <= 0);
}

static int32_t rate_of(const struct t3_ramp *ramp, int32_t acceleration, int32_t deceleration)
{
    bool up = false, down = false;
    for (uint8_t i = 0; i < T3_WHEELS; i++) {
        const bool faster = speeds_up(ramp->speed[i], ramp->target[i]);
        up = up || faster;
        down = down || (!faster && ramp->speed[i] != ramp->target[i]);
    }
    if (up && down)
        return acceleration < deceleration ? acceleration : deceleration;
    return up ? acceleration : deceleration;
}

// Return limit * part / whole for part <= whole, without a 64-bit division.
static uint32_t share(uint32_t limit, uint32_t part, uint32_t whole)
{
    while (whole > UINT32_C(0xFFFF)) {
        whole >>= 1;
        part >>= 1;
    }
    return (uint32_t)((uint64_t)limit * ((part << 16) / whole) >> 16);
}

void t3_ramp_step(struct t3_ramp *ramp, int32_t acceleration, int32_t deceleration,
                  uint32_t elapsed_us)
{
    uint32_t gap[T3_WHEELS];
    for (uint8_t i = 0; i < T3_WHEELS; i++)
        gap[i] = magnitude(ramp->target[i] - ramp->speed[i]);
    const uint32_t widest = larger(gap[T3_LEFT], gap[T3_RIGHT]);
    if (elapsed_us > T3_RAMP_STEP_LIMIT_US)
        elapsed_us = T3_RAMP_STEP_LIMIT_US;
    // mrad/s^2 * us = nrad/s: at most 200000 * 20000, which just fits.
    const uint32_t limit =
        (uint32_t)rate_of(ramp, acceleration, deceleration) * elapsed_us / 1000u;
    for (uint8_t i = 0; i < T3_WHEELS; i++) {
        if (widest <= limit) {
            ramp->speed[i] = ramp->target[i];
            continue;
        }
        const int32_t step = (int32_t)(gap[i] == widest ? limit : share(limit, gap[i], widest));
        ramp->speed[i] += ramp->target[i] < ramp->speed[i] ? -step : step;
    }
}

bool t3_ramp_settled(const struct t3_ramp *ramp)
{
    return ramp->speed[T3_LEFT] == ramp->target[T3_LEFT] &&
           ramp->speed[T3_RIGHT] == ramp->target[T3_RIGHT];
}

bool t3_ramp_moving(const struct t3_ramp *ramp)
{
    return ramp->speed[T3_LEFT] || ramp->speed[T3_RIGHT];
}

bool t3_ramp_busy(const struct t3_ramp *ramp)
{
    return t3_ramp_moving(ramp) || ramp->target[T3_LEFT] || ramp->target[T3_RIGHT];
}

bool t3_ramp_aim(struct t3_ramp *ramp, int16_t left, int16_t right, int32_t limit)
{
    int32_t wanted[T3_WHEELS] = {left, right};
    const int32_t fastest = (int32_t)larger(magnitude(left), magnitude(right));
    const bool limited = fastest > limit;
    for (uint8_t i = 0; i < T3_WHEELS; i++) {
        if (limited)
            wanted[i] = wanted[i] * limit / fastest;  // below 32768 * 19635
        ramp->target[i] = wanted[i] * 1000;
    }
    return limited;
}

void t3_ramp_halt(struct t3_ramp *ramp)
{
    ramp->target[T3_LEFT] = ramp->target[T3_RIGHT] = 0;
}
