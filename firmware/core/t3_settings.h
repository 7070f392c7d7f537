// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Settings of a robot in EEPROM: radio address, channel, microsteps. Written over its own USB only.
//
// Two copies, each with a CRC. A copy is written in three steps, each verified before the next: its
// first byte becomes invalid, the others change, its first byte becomes valid. A loss of power at any
// cell leaves the other copy, or no valid copy: never a mixture of two writes. Without a valid copy the
// robot accepts no session.
#ifndef T3_SETTINGS_H
#define T3_SETTINGS_H

#include "t3_port.h"
#include "t3_store.h"

// States of the record, as in INFO, PONG and SETTINGS.
enum {
    T3_SETTINGS_GOOD,
    T3_SETTINGS_ONE_COPY,  // usable; the other copy is being repaired, or cannot be
    T3_SETTINGS_MISSING,   // a board that was never set up
    T3_SETTINGS_DAMAGED    // no valid copy, or being written
};

struct t3_setup {
    uint8_t channel;
    uint16_t microsteps;
    uint8_t address[5];  // last transmitted byte first
};

struct t3_settings {
    struct t3_setup now;  // in effect; the defaults without a valid copy
    uint8_t state;
    // The write in progress.
    enum { T3_SETTINGS_IDLE, T3_SETTINGS_OPENED, T3_SETTINGS_FILLED, T3_SETTINGS_CLOSED } step;
    uint8_t copies;  // to write, the current one included
    uint8_t at;      // address of the current one
    uint8_t record[T3_STORE_SETTINGS_SIZE];
};

enum t3_progress { T3_PROGRESS_NONE, T3_PROGRESS_DONE, T3_PROGRESS_FAILED };

// Read the record; begin to repair a damaged or differing copy.
void t3_settings_boot(struct t3_settings *settings, const struct t3_port *port);

// Return whether a session may start.
bool t3_settings_usable(const struct t3_settings *settings);

// Return whether the values are possible: a channel of the chip, a power of two up to 256, an address
// of different bytes (the receiver takes noise for one of equal bytes).
bool t3_setup_valid(const struct t3_setup *setup);

// Begin to write both copies; until t3_settings_tick reports the end, the record counts as damaged.
void t3_settings_write(struct t3_settings *settings, const struct t3_port *port,
                       const struct t3_setup *setup);

// Call in each pass of the main loop; return whether a write has just ended. Once it is done, the new
// values are in effect; after a failure the record remains damaged.
enum t3_progress t3_settings_tick(struct t3_settings *settings, const struct t3_port *port,
                                  const struct t3_console_port *console);

#endif
