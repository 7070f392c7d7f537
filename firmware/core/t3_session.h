// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Who may command the robot: the session, and on a keyed link the proof that a frame is the host's
// and new.
//
// The radio has no protection of its own. With a 128-bit key at both ends, HELLO is signed under it
// with a nonce of the host; the robot answers with one of its own, and both derive a session key
// from the two. So a recorded session is invalid in the next. Within a session the host clock
// strictly increases over all signed frames.
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
    bool locked;  // the key is damaged or about to change: no session starts
    uint32_t check;  // of the key, for people to compare both ends by
    uint8_t key[T3_KEY_SIZE];
    uint8_t session_key[T3_KEY_SIZE];
    uint8_t host_nonce[T3_NONCE_SIZE], robot_nonce[T3_NONCE_SIZE];
    uint32_t epoch, last_us;  // the host's clock in the last frame taken, and how often it wrapped
    uint32_t boots, greetings;  // no pair of them comes twice, so no nonce does
};

enum t3_greeting { T3_GREETING_REFUSED, T3_GREETING_NEW, T3_GREETING_REPEATED };

// Read the key, if there is one; no session. With a damaged key no session starts: the robot
// only accepts ESTOP.
void t3_session_boot(struct t3_session *session, const struct t3_port *port);

// End the session; start none until t3_session_boot.
void t3_session_lock(struct t3_session *session);

// Take a HELLO whose bytes are `data`. A repeated one changes nothing.
enum t3_greeting t3_session_greet(struct t3_session *session, const struct t3_port *port,
                                  const struct t3_packet *packet, const uint8_t *data);

// Return whether a frame of `size` bytes is of this session and, on a keyed link, signed and newer
// than all before; it then counts as seen.
bool t3_session_admits(struct t3_session *session, const struct t3_packet *packet,
                       const uint8_t *data, uint8_t size);

// Make the session's key of the long-term key and both nonces.
void t3_session_derive_key(struct t3_session *session);

// Forget the session; only a new HELLO starts another.
void t3_session_end(struct t3_session *session);

// Store a key, or none (NULL), in the EEPROM; it holds from the next t3_session_boot on.
void t3_session_store_key(const struct t3_port *port, const uint8_t *key);

// Mark in the EEPROM that the key is about to change, or has changed. A supply failure in between
// leaves a mixture of two keys; one in 65536 has the right CRC, so the CRC alone is not sufficient.
void t3_session_mark_key(const struct t3_port *port, bool changing);

#endif
