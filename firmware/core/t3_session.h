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

// Session and authentication: which frames may command the robot.
//
// The radio has no access control. With a 128-bit key at both ends, HELLO is signed under the key with
// a nonce of the host, the robot replies with a nonce, and both ends derive a session key: frames of a
// recorded session are invalid in the next one. Within a session the clock of the host strictly
// increases over all signed frames.
#ifndef T3_SESSION_H
#define T3_SESSION_H

#include <stdbool.h>
#include <stdint.h>

#include "t3_port.h"
#include "t3_protocol.h"
#include "t3_siphash.h"

struct t3_session {
    uint8_t id;  // 0: none
    bool keyed;
    bool locked;  // the key is damaged or being written: no session is accepted
    uint32_t check;  // check value of the key, to compare both ends
    uint8_t key[T3_KEY_SIZE];
    uint8_t session_key[T3_KEY_SIZE];
    uint8_t host_nonce[T3_NONCE_SIZE], robot_nonce[T3_NONCE_SIZE];
    uint32_t epoch, last_us;  // host clock of the last accepted frame, and its number of wraps
    uint32_t boots, greetings;  // no pair repeats, so no nonce repeats
};

// Count the start of the board in its EEPROM; return the count.
uint32_t t3_session_count_boot(const struct t3_port *port);

// Read the key, if any; no session. With a damaged key the robot is locked and accepts only emergency
// stops. `boots` is set before, and kept like `greetings`.
void t3_session_boot(struct t3_session *session, const struct t3_port *port);

// End the session, and lock the robot until t3_session_boot.
void t3_session_lock(struct t3_session *session);

// Process a HELLO with the bytes `data`; return why it is refused. A repeated one changes nothing.
enum t3_refusal t3_session_greet(struct t3_session *session, const struct t3_port *port,
                                 const struct t3_packet *packet, const uint8_t *data,
                                 bool *repeated);
// Return T3_ADMITTED if a frame of `size` bytes belongs to this session and, on a keyed link, is signed
// and newer than all accepted frames; it then counts as accepted.
enum t3_refusal t3_session_admit(struct t3_session *session, const struct t3_packet *packet,
                                 const uint8_t *data, uint8_t size);
// Derive the session key from the long-term key and both nonces.
void t3_session_derive_key(struct t3_session *session);

// End the session; only a new HELLO starts another.
void t3_session_end(struct t3_session *session);

// Store a key, or erase it (NULL), in EEPROM; effective from the next t3_session_boot.
void t3_session_store_key(const struct t3_port *port, const uint8_t *key);

// Set or clear the mark of an unfinished key write in EEPROM. A loss of power leaves a mixture of two
// keys; one in 65536 mixtures has a valid CRC, so the CRC alone is not sufficient.
void t3_session_mark_key(const struct t3_port *port, bool changing);

#endif
