// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// USB console of the robot board: status and key. The key is written over this port only and is never
// sent; a check value of 32 bits identifies it.
//
// During the write of a key no session is accepted and nothing moves. After a loss of power during the
// write, the board has the old key, the new key or a damaged key; with a damaged key it accepts only
// emergency stops until a key is written.
#ifndef T3_CONSOLE_H
#define T3_CONSOLE_H

#include "t3_robot.h"

// States of the key in KEY.
enum { T3_KEY_NONE, T3_KEY_HELD, T3_KEY_DAMAGED };

struct t3_console {
    const struct t3_console_port *port;
    struct t3_robot *robot;
    struct t3_splitter splitter;
    uint16_t overruns;
    enum { T3_KEY_RESTS, T3_KEY_MARKED, T3_KEY_WRITTEN, T3_KEY_VERIFIED } step;
    bool sets;   // settings from a frame are being written, not a repair
    uint8_t id;  // of the frame whose key or settings are being written
    uint8_t key[T3_KEY_SIZE];
};

// Call after t3_robot_boot.
void t3_console_boot(struct t3_console *console, const struct t3_console_port *port,
                     struct t3_robot *robot);

// Process a byte from USB; return whether it completed a frame, which takes longer.
bool t3_console_byte(struct t3_console *console, uint8_t byte);

// Count a byte lost to an overrun.
void t3_console_overrun(struct t3_console *console);

// Return whether a key or settings are being written.
bool t3_console_writes(const struct t3_console *console);

// Call in each pass of the main loop: an EEPROM write takes many passes.
void t3_console_tick(struct t3_console *console);

#endif
