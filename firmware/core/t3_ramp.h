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

// Ramp of the wheel speeds. Both wheels follow one factor, which keeps the curvature while the robot
// accelerates or stops.
#ifndef T3_RAMP_H
#define T3_RAMP_H

#include <stdbool.h>
#include <stdint.h>

#include "t3_steps.h"

// Longest step of the ramp: after a stall of the main loop the speed does not jump.
#define T3_RAMP_STEP_LIMIT_US UINT32_C(20000)

struct t3_ramp {
    int32_t speed[T3_WHEELS];   // urad/s
    int32_t target[T3_WHEELS];  // urad/s
};

// Advance by `elapsed_us`. Rates are in mrad/s^2; `deceleration` applies where wheels slow down, the
// smaller rate where one wheel speeds up and the other slows down.
void t3_ramp_step(struct t3_ramp *ramp, int32_t acceleration, int32_t deceleration,
                  uint32_t elapsed_us);

// Return whether both wheels have their target speed.
bool t3_ramp_settled(const struct t3_ramp *ramp);

// Return whether a wheel turns.
bool t3_ramp_moving(const struct t3_ramp *ramp);

// Return whether a wheel turns or has a target speed other than zero.
bool t3_ramp_busy(const struct t3_ramp *ramp);

// Set the target (mrad/s), both wheels scaled down to `limit` by one factor; return whether it was
// limited.
bool t3_ramp_aim(struct t3_ramp *ramp, int16_t left, int16_t right, int32_t limit);

// Set the target to zero.
void t3_ramp_halt(struct t3_ramp *ramp);

#endif
