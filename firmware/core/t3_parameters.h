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

// Parameters of the robot. All but microsteps and steps per turn are in RAM only: the host writes them after each
// HELLO.
#ifndef T3_PARAMETERS_H
#define T3_PARAMETERS_H

#include <stdbool.h>
#include <stdint.h>

enum t3_parameter {
    T3_MAX_SPEED,      // mrad/s of a wheel
    T3_ACCELERATION,   // mrad/s^2
    T3_DECELERATION,   // mrad/s^2
    T3_TTL_MAX,        // ms
    T3_MICROSTEPS,     // per full step; of the settings
    T3_STEPS_PER_REV,  // full steps; of the settings
    T3_GYRO_RANGE,     // deg/s
    T3_BATTERY_LOW,    // mV
    T3_IDLE_OFF,       // ms at rest until the drivers switch off; 0: never
    T3_INVERT_WHEELS,  // bit 0 left, bit 1 right: against the settings
    T3_BATTERY_CUTOFF,  // mV below which the robot does not drive; 0: none
    T3_BOOTS,           // starts of the board, modulo 2**31
    T3_PARAMETERS
};

struct t3_parameters {
    int32_t values[T3_PARAMETERS];
};

struct t3_bounds {
    int32_t initial, low, high;
    bool read_only;
    bool at_rest;  // writable only at rest
};

// Return the bounds of a parameter, NULL if the id is unknown.
const struct t3_bounds *t3_parameter_bounds(uint8_t id);

void t3_parameters_start(struct t3_parameters *parameters);

// Write a parameter if it exists, is writable and in range; return one of T3_RC_*.
uint8_t t3_parameter_set(struct t3_parameters *parameters, uint8_t id, int32_t value, bool busy);

#endif
