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

// A record in EEPROM in two copies, each with a CRC; its first byte is its format.
//
// A copy is written in three steps, each verified before the next: its first byte becomes invalid, the
// others change, its first byte becomes valid. A loss of power at any cell leaves the other copy, or no
// valid copy: never a mixture of two writes.
#ifndef T3_COPIES_H
#define T3_COPIES_H

#include "t3_port.h"
#include "t3_protocol.h"
#include "t3_store.h"

#define T3_BODY_LIMIT (T3_STORE_RECORD_LIMIT - T3_CRC_SIZE)

// States of a record, as in INFO, PONG and RECORD.
enum {
    T3_SETTINGS_GOOD,
    T3_SETTINGS_ONE_COPY,    // usable; the other copy is being repaired, or cannot be
    T3_SETTINGS_MISSING,     // never written
    T3_SETTINGS_DAMAGED,     // no valid copy, or being written
    T3_SETTINGS_OLD,         // of an older firmware, which this one does not read
    T3_SETTINGS_CALIBRATION  // INFO, PONG: the settings are usable, the calibration is damaged
};

struct t3_copies_kind {
    uint16_t first, second;  // addresses
    uint8_t size;            // with the CRC
    uint8_t format;          // never 0xFF
    bool (*valid)(const uint8_t *body);
};

struct t3_copies {
    const struct t3_copies_kind *kind;
    uint8_t state;
    // The write in progress.
    enum { T3_COPIES_IDLE, T3_COPIES_OPENED, T3_COPIES_FILLED, T3_COPIES_CLOSED } step;
    uint8_t left;  // copies to write, the current one included
    uint16_t at;   // address of the current one
    uint8_t record[T3_STORE_RECORD_LIMIT];  // stored, or being written; with its CRC
};

enum t3_progress { T3_PROGRESS_NONE, T3_PROGRESS_DONE, T3_PROGRESS_FAILED };

// Read the record; begin to repair a damaged or differing copy. Return whether `record` is valid.
bool t3_copies_boot(struct t3_copies *copies, const struct t3_copies_kind *kind,
                    const struct t3_port *port);

// Begin to write a valid body, without CRC, to both copies; until t3_copies_tick reports the end, the
// record counts as damaged.
void t3_copies_write(struct t3_copies *copies, const struct t3_port *port, const uint8_t *body);

// Call in each pass of the main loop; return whether a write has just ended. After a failure the record
// remains damaged.
enum t3_progress t3_copies_tick(struct t3_copies *copies, const struct t3_port *port,
                                const struct t3_console_port *console);

#endif
