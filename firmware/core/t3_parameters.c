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
#include "t3_parameters.h"

#include <stddef.h>

#include "t3_port.h"
#include "t3_protocol.h"

// Silence at full speed brings the wheels to rest after TTL + speed / deceleration: with these and
// the host's usual TTL of 0.2 s that is 0.53 s. Within 0.45 s would take 40 rad/s^2, and 50 at the
// longest TTL.
static const struct t3_bounds BOUNDS[T3_PARAMETERS] = {
    [T3_MAX_SPEED] = {10000, 0, 19600, false, false},
    [T3_ACCELERATION] = {30000, 100, 100000, false, false},
    [T3_DECELERATION] = {60000, 100, 200000, false, false},
    [T3_TTL_MAX] = {250, 20, 500, false, false},
    [T3_MICROSTEPS] = {T3_DEFAULT_MICROSTEPS, 1, 256, true, false},
    [T3_STEPS_PER_REV] = {200, 20, 10000, true, false},
    [T3_GYRO_RANGE] = {500, 500, 500, true, false},
    [T3_BATTERY_LOW] = {10200, 0, 30000, false, false},
    [T3_IDLE_OFF] = {0, 0, 600000, false, false},
    [T3_INVERT_WHEELS] = {0, 0, 3, false, true},
    [T3_BATTERY_CUTOFF] = {9000, 0, 30000, false, false},
    [T3_BOOTS] = {0, 0, 2147483647, true, false},
};

const struct t3_bounds *t3_parameter_bounds(uint8_t id)
{
    return id < T3_PARAMETERS ? &BOUNDS[id] : NULL;
}

void t3_parameters_start(struct t3_parameters *parameters)
{
    for (uint8_t id = 0; id < T3_PARAMETERS; id++)
        parameters->values[id] = BOUNDS[id].initial;
}

uint8_t t3_parameter_set(struct t3_parameters *parameters, uint8_t id, int32_t value, bool busy)
{
    const struct t3_bounds *bounds = t3_parameter_bounds(id);
    if (!bounds)
        return T3_RC_UNKNOWN;
    if (bounds->read_only)
        return T3_RC_READ_ONLY;
    if (value < bounds->low || value > bounds->high)
        return T3_RC_RANGE;
    if (bounds->at_rest && busy && value != parameters->values[id])
        return T3_RC_BUSY;
    parameters->values[id] = value;
    return T3_RC_OK;
}
