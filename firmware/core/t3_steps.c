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
#include "t3_steps.h"

#include <string.h>

// 2**32 of phase * 2**32 of scale / (20000 ticks/s * 2 pi rad * 1e6 urad/rad), per microstep of a
// revolution.
#define GAIN_PER_MICROSTEP UINT32_C(146794498)
// 10000 steps/s * 2 pi * 1e6 urad
#define TOP_SPEED_OF_ONE UINT64_C(62831853071)

void t3_steps_start(struct t3_steps *steps, uint32_t microsteps_per_rev)
{
    memset(steps, 0, sizeof *steps);
    t3_steps_scale(steps, microsteps_per_rev);
}

void t3_steps_scale(struct t3_steps *steps, uint32_t microsteps_per_rev)
{
    steps->gain_shift = 0;
    steps->top_speed = (uint32_t)(TOP_SPEED_OF_ONE / microsteps_per_rev);
    // As many bits as fit, so that a product of 32 bits each is enough later.
    uint64_t gain = (uint64_t)microsteps_per_rev * GAIN_PER_MICROSTEP;
    for (; gain > UINT32_MAX; gain >>= 1)
        steps->gain_shift++;
    steps->gain = (uint32_t)gain;
}

int32_t t3_steps_increment(const struct t3_steps *steps, int32_t speed)
{
    uint32_t size = speed < 0 ? 0u - (uint32_t)speed : (uint32_t)speed;
    if (size > steps->top_speed)
        size = steps->top_speed;
    // The top speed is just below an increment of 2**31, so neither this shift nor the product can
    // overflow.
    const uint32_t scaled = size << steps->gain_shift;
    const int32_t increment = (int32_t)((uint64_t)steps->gain * scaled >> 32);
    return speed < 0 ? -increment : increment;
}
