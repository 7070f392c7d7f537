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

// Log of the robot in EEPROM: a ring of entries, each with a CRC.
//
// Wear: a fault is logged once per boot, and a longest pass of the main loop only when it is half as long
// again as the last one that was logged: at most 16 entries a boot, over 16 places. A cell stands 100000
// writes.
#ifndef T3_LOG_H
#define T3_LOG_H

#include "t3_port.h"
#include "t3_store.h"

struct t3_robot;

// Kinds of an entry, and its value.
enum {
    T3_LOG_BOOT = 1,  // reset cause
    T3_LOG_ESTOP,     // 0
    T3_LOG_EXPIRED,   // number of expired commands; a stop without a command in time
    T3_LOG_IMU,       // 0; the inertial sensor does not answer
    T3_LOG_RADIO,     // 0; the radio chip does not answer
    T3_LOG_BATTERY,   // mV; below the cut-off
    T3_LOG_RECORDS,   // state of settings and calibration: no session is accepted
    T3_LOG_LOOP,      // us of the longest pass of the main loop, 65535 at most
    T3_LOG_KINDS
};
// Shorter passes are not logged: the main loop must come round every 2 ms.
#define T3_LOG_LOOP_US 2000u

// An entry: number u32, kind u8, 0 u8, seconds since boot u32, value u16, 0 u16, CRC u16.
struct t3_log {
    uint32_t number;   // of the next entry
    uint8_t place;     // of the next entry
    uint16_t logged;   // bits of the kinds since boot
    uint16_t longest;  // logged pass, us
    uint32_t seconds, second_us;  // since boot, and when the last one began
};

// Find the newest entry and log the boot.
void t3_log_boot(struct t3_log *log, const struct t3_port *port, const struct t3_robot *robot);

// Call in each pass of the main loop, after t3_robot_tick. An entry is added only while no other write
// is in progress.
void t3_log_tick(struct t3_log *log, const struct t3_robot *robot, bool chip_ok, bool settled);

// Read a place of the ring, T3_STORE_LOG_SIZE bytes as stored.
void t3_log_read(const struct t3_port *port, uint8_t place, uint8_t *entry);

#endif
