// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Wheel speeds on their way to a target. Both wheels follow one factor, so that the robot keeps its
// curvature while it speeds up or stops.
#ifndef T3_RAMP_H
#define T3_RAMP_H

#include <stdbool.h>
#include <stdint.h>

#include "t3_steps.h"

// A longer step is cut to this: after a stall of the main loop a ramp continues, it does not jump.
#define T3_RAMP_STEP_LIMIT_US UINT32_C(20000)

struct t3_ramp {
    int32_t speed[T3_WHEELS];   // urad/s
    int32_t target[T3_WHEELS];  // urad/s
};

// Go on for `elapsed_us`. Rates are in mrad/s^2; `deceleration` rules where wheels slow down, the
// smaller one where one wheel speeds up while the other slows down.
void t3_ramp_step(struct t3_ramp *ramp, int32_t acceleration, int32_t deceleration,
                  uint32_t elapsed_us);

// Return whether both wheels are as fast as they are to be.
bool t3_ramp_settled(const struct t3_ramp *ramp);

// Return whether a wheel turns.
bool t3_ramp_moving(const struct t3_ramp *ramp);

// Return whether a wheel turns or is going to.
bool t3_ramp_busy(const struct t3_ramp *ramp);

// Scale a command (mrad/s) down to `limit` by one factor and make it the target; return whether
// that changed it.
bool t3_ramp_aim(struct t3_ramp *ramp, int16_t left, int16_t right, int32_t limit);

// Come to rest.
void t3_ramp_halt(struct t3_ramp *ramp);

#endif
