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

// The stepping interrupt at 20 kHz, the pins of both drivers, and the robot's clock, which counts
// the same interrupts.
#ifndef STEPPING_H
#define STEPPING_H

#include <stdbool.h>
#include <stdint.h>

#include "t3_robot.h"

// The interrupt works on its `steps`.
extern struct t3_robot robot;

// Drivers without power, steps low.
void stepping_pins(void);

// Begin with the interrupts: only after t3_robot_boot.
void stepping_start(void);

void stepping_power(bool on);

// Return the microseconds since stepping_start, modulo 2**32.
uint32_t stepping_time_us(void);

// Keep all interrupts out for a few copied words, and let them in again. Not before stepping_start.
void stepping_lock(void);
void stepping_unlock(void);

// Return true once per eighth interrupt: a pass of the main loop is due.
bool stepping_due(void);

#endif
