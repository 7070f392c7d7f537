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

// LED and buzzer of the robot: for a person beside it. docs/robot.md has the table.
//
// A fault is a number of short flashes (and, when it begins, of beeps), repeated every 2 s; otherwise
// the LED shows the session and the motion.
#ifndef T3_SIGNAL_H
#define T3_SIGNAL_H

#include <stdbool.h>
#include <stdint.h>

struct t3_robot;

// Codes: from T3_SIGNAL_ESTOP (2) to T3_SIGNAL_BATTERY (6) faults, with as many flashes.
enum {
    T3_SIGNAL_BOOTING,     // LED on for the first second
    T3_SIGNAL_NO_SESSION,  // on and off, 1 s each
    T3_SIGNAL_ESTOP,       // latched
    T3_SIGNAL_LOCKED,      // settings, calibration or key: no session is accepted
    T3_SIGNAL_SENSOR,      // the inertial sensor does not answer
    T3_SIGNAL_RADIO,       // the radio chip does not answer
    T3_SIGNAL_BATTERY,     // low, or below the cut-off
    T3_SIGNAL_CODES,
    T3_SIGNAL_STANDING = T3_SIGNAL_CODES,  // in a session: short gaps
    T3_SIGNAL_DRIVING                      // drivers enabled: on
};

#define T3_SIGNAL_LED 1u
#define T3_SIGNAL_BUZZER 2u

struct t3_signal {
    uint8_t code;
    bool booted;
    uint32_t boot_us;
    uint32_t step_us;  // start of the current step of the pattern
    uint8_t step;      // of 0.1 s, counted to 2 s
    uint8_t rounds;    // of the pattern
};

// Return the code of a robot whose radio chip answers or not, `uptime_us` after boot (UINT32_MAX: more).
// The most urgent fault wins.
uint8_t t3_signal_code(const struct t3_robot *robot, bool chip_ok, uint32_t uptime_us);

// Return the levels of LED and buzzer (T3_SIGNAL_*) in a step of 0.1 s (0 to 19) of a round of a code.
uint8_t t3_signal_levels(uint8_t code, uint8_t step, uint8_t round);

void t3_signal_boot(struct t3_signal *signal, uint32_t now_us);

// Call often; return the levels now.
uint8_t t3_signal_tick(struct t3_signal *signal, const struct t3_robot *robot, bool chip_ok,
                       uint32_t now_us);

#endif
