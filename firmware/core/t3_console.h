// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The robot's own USB: how the board fares, and its key. A key comes in over this cable and no other
// way; it never goes out, only a check value of 32 bits for comparing keys.
//
// While a key is being written no session starts, and nothing moves. If the supply fails meanwhile,
// the board finds at its next start what it had before, the new key, or a damaged one; with a damaged
// one it only ever stops, until it is given a key again.
#ifndef T3_CONSOLE_H
#define T3_CONSOLE_H

#include "t3_robot.h"

// State of the key in KEY.
enum { T3_KEY_NONE, T3_KEY_HELD, T3_KEY_DAMAGED };

struct t3_console {
    const struct t3_console_port *port;
    struct t3_robot *robot;
    struct t3_splitter splitter;
    uint16_t overruns;
    enum { T3_KEY_RESTS, T3_KEY_MARKED, T3_KEY_WRITTEN, T3_KEY_VERIFIED } step;
    uint8_t id;  // of the frame whose key is being written
    uint8_t key[T3_KEY_SIZE];
};

// Only after t3_robot_boot.
void t3_console_boot(struct t3_console *console, const struct t3_console_port *port,
                     struct t3_robot *robot);

// Take a byte from USB; return whether it ended a frame, which takes longer.
bool t3_console_byte(struct t3_console *console, uint8_t byte);

// Count a byte that was lost because it was not read in time.
void t3_console_overrun(struct t3_console *console);

// Call as often as the main loop runs: a key takes the EEPROM a while.
void t3_console_tick(struct t3_console *console);

#endif
