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

// Settings of a robot in EEPROM, in two copies (t3_copies.h), written over its own USB only. Without
// valid settings the robot accepts no session.
//
// The record, version 2: format u8 (2), channel u8, microsteps u16, address 5, rate u8, power u8,
// steps per turn u16, inverted wheels and wired battery u8, divider u16, sensor types 8. Version 1 had no more than the
// address; it is refused as T3_SETTINGS_OLD.
#ifndef T3_SETTINGS_H
#define T3_SETTINGS_H

#include "t3_copies.h"
#include "t3_port.h"
#include "t3_sensors.h"

struct t3_setup {
    uint8_t channel;
    uint16_t microsteps;
    uint8_t address[5];       // last transmitted byte first
    uint8_t rate, power;      // as in t3_radio_settings
    uint16_t steps_per_turn;  // full steps of a turn of the wheel
    uint8_t inverted;         // bit 0 left, bit 1 right: the motor is reversed
    uint8_t wired;            // 1: the battery is measured, so a voltage of 0 is a fault
    uint16_t divider;         // battery voltage / voltage at the converter, 1/1000
    uint8_t sensors[T3_RANGES];  // T3_SENSOR_*
};

#define T3_SETUP_BODY (T3_STORE_SETTINGS_SIZE - T3_CRC_SIZE)
#define T3_SETUP_DEFAULTS                                                                         \
    {T3_RADIO_CHANNEL, T3_DEFAULT_MICROSTEPS, {'T', '3', 'M', 'P', 'C'}, T3_RADIO_RATE, 3, 200, 0,  \
     0, 4000, {1, 1, 1, 1, 1, 1, 1, 1}}

struct t3_settings {
    struct t3_setup now;  // in effect; the defaults without a valid copy
    struct t3_copies copies;
};

// Read the record; begin to repair a damaged or differing copy.
void t3_settings_boot(struct t3_settings *settings, const struct t3_port *port);

// Return whether a session may start.
bool t3_settings_usable(const struct t3_settings *settings);

// Convert between the values and the T3_SETUP_BODY bytes of a record without its CRC.
void t3_setup_encode(const struct t3_setup *setup, uint8_t *body);
void t3_setup_decode(const uint8_t *body, struct t3_setup *setup);

// Return whether a body has this format and possible values: a channel of the chip, microsteps a power
// of two up to 256, an address of different bytes.
bool t3_setup_valid(const uint8_t *body);

// Begin to write a valid body to both copies; until t3_settings_tick reports the end, the record counts as damaged.
void t3_settings_write(struct t3_settings *settings, const struct t3_port *port,
                       const uint8_t *body);

// Call in each pass of the main loop; return whether a write has just ended. Once it is done, the new
// values are in effect; after a failure the record remains damaged.
enum t3_progress t3_settings_tick(struct t3_settings *settings, const struct t3_port *port,
                                  const struct t3_console_port *console);

#endif
