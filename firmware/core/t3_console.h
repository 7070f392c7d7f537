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

// USB console of the robot board: status, key, records, raw sensors, and the transactions of a dongle, so
// that a host drives over the cable under the rules of the radio. The key is written over this port
// only and is never sent; a check value of 32 bits identifies it. A record (settings, calibration) is
// read and staged in parts of 16 bytes; STORE writes it if its CRC is that of all staged bytes.
//
// During a write no session is accepted and nothing moves. After a loss of power during the
// write, the board has the old key, the new key or a damaged key; with a damaged key it accepts only
// emergency stops until a key is written.
#ifndef T3_CONSOLE_H
#define T3_CONSOLE_H

#include "t3_log.h"
#include "t3_robot.h"
#include "t3_signal.h"

// States of the key in KEY.
enum { T3_KEY_NONE, T3_KEY_HELD, T3_KEY_DAMAGED };

// Records of RECORD and STORE.
// The parts of the log are its entries, in no order; it can only be read.
enum { T3_RECORD_SETTINGS, T3_RECORD_CALIBRATION, T3_RECORDS, T3_RECORD_LOG = T3_RECORDS };
#define T3_PART_SIZE 16u
#define T3_PARTS ((T3_BODY_LIMIT + T3_PART_SIZE - 1u) / T3_PART_SIZE)

struct t3_console {
    const struct t3_console_port *port;
    struct t3_robot *robot;
    struct t3_splitter splitter;
    uint16_t overruns;
    enum { T3_KEY_RESTS, T3_KEY_MARKED, T3_KEY_WRITTEN, T3_KEY_VERIFIED } step;
    bool sets;       // a record from a frame is being written, not a repair
    uint8_t record;  // which
    uint8_t id;      // of the frame whose key or record is being written
    struct t3_log log;
    struct t3_signal signal;
    enum { T3_TX_RESTS, T3_TX_TAKEN, T3_TX_DECODED, T3_TX_ANSWERED } tx;
    struct t3_answer answer;                           // of the first payload of a TX
    uint8_t second[T3_RADIO_LIMIT], second_size;       // payload of the TX, still to be executed
    uint8_t result[8u + T3_RADIO_LIMIT], result_size;  // its RESULT, still to be sent
    uint8_t staged_record;
    uint8_t staged[T3_PARTS * T3_PART_SIZE];
    uint8_t key[T3_KEY_SIZE];
};

// Call after t3_robot_boot.
void t3_console_boot(struct t3_console *console, const struct t3_console_port *port,
                     struct t3_robot *robot);

// Process a byte from USB; return whether it completed a frame, which takes longer.
bool t3_console_byte(struct t3_console *console, uint8_t byte);

// Count a byte lost to an overrun.
void t3_console_overrun(struct t3_console *console);

// Return whether a key or a record is being written.
bool t3_console_writes(const struct t3_console *console);

// Return whether t3_console_tick has something to do.
bool t3_console_waits(const struct t3_console *console);

// Call in each pass of the main loop: an EEPROM write takes many passes.
void t3_console_tick(struct t3_console *console);

// Call in each pass of the main loop: log what is new; return the levels of LED and buzzer.
uint8_t t3_console_watch(struct t3_console *console);

#endif
