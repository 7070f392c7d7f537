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
#include "t3_session.h"

#include <string.h>

#include "t3_bytes.h"
#include "t3_store.h"

#define HELLO_SIGNED_SIZE 16u  // a signed HELLO without its tag
#define EPOCH_SIZE 4u
#define NO_MARK 0xFFu

// Uses of the long-term key. The byte precedes what is hashed: no output of one use is ever valid, or
// known, in another.
enum { USE_HELLO = 1, USE_SESSION_KEY, USE_NONCE, USE_CHECK };
#define USE_LIMIT (2u * T3_NONCE_SIZE + 1u)

static void hash(const struct t3_session *session, uint8_t use, const uint8_t *data, uint8_t size,
                 uint8_t out[T3_TAG_SIZE])
{
    uint8_t text[1u + USE_LIMIT];
    text[0] = use;
    memcpy(text + 1, data, size);
    t3_siphash(session->key, text, (uint8_t)(size + 1u), out);
}

uint32_t t3_session_count_boot(const struct t3_port *port)
{
    uint8_t bytes[4];
    uint32_t boots;
    // A count that was lost in mid-write starts anywhere: not where it has been before.
    if (t3_store_read(port, T3_STORE_BOOTS, bytes, sizeof bytes) == T3_RECORD_GOOD)
        boots = t3_get32(bytes) + 1;
    else
        boots = port->noise(port->context);
    t3_put32(bytes, boots);
    t3_store_write(port, T3_STORE_BOOTS, bytes, sizeof bytes);
    return boots;
}

// Forget key and session. What keeps a nonce from repeating goes on until the next start of the board.
static void forget(struct t3_session *session)
{
    const uint32_t boots = session->boots, greetings = session->greetings;
    memset(session, 0, sizeof *session);
    session->boots = boots;
    session->greetings = greetings;
}

void t3_session_lock(struct t3_session *session)
{
    forget(session);
    session->keyed = session->locked = true;
}

void t3_session_boot(struct t3_session *session, const struct t3_port *port)
{
    forget(session);
    uint8_t mark;
    port->eeprom_read(port->context, T3_STORE_KEY_MARK, &mark, 1);
    if (mark != NO_MARK) {
        t3_session_lock(session);
        return;
    }
    switch (t3_store_read(port, T3_STORE_KEY, session->key, T3_KEY_SIZE)) {
    case T3_RECORD_BLANK:
        return;
    case T3_RECORD_DAMAGED:
        // A link that was keyed must not open because a cell of the memory died.
        t3_session_lock(session);
        return;
    case T3_RECORD_GOOD:
        break;
    }
    uint8_t digest[T3_TAG_SIZE];
    static const uint8_t NAME[] = {'t', '3', 'm', 'p', 'c'};
    hash(session, USE_CHECK, NAME, sizeof NAME, digest);
    session->check = t3_get32(digest);
    session->keyed = true;
}

void t3_session_end(struct t3_session *session)
{
    session->id = 0;
}

// Constant time: the duration does not reveal the number of matching bytes.
static bool same(const uint8_t *a, const uint8_t *b, uint8_t size)
{
    uint8_t difference = 0;
    while (size--)
        difference |= (uint8_t)(*a++ ^ *b++);
    return !difference;
}

static void draw_nonce(struct t3_session *session, const struct t3_port *port)
{
    uint8_t seed[16];
    uint8_t *to = t3_put32(seed, session->boots);
    to = t3_put32(to, ++session->greetings);
    to = t3_put32(to, port->time_us(port->context));
    t3_put32(to, port->noise(port->context));
    hash(session, USE_NONCE, seed, sizeof seed, session->robot_nonce);
}

void t3_session_derive_key(struct t3_session *session)
{
    uint8_t text[2 * T3_NONCE_SIZE + 1];
    memcpy(text, session->host_nonce, T3_NONCE_SIZE);
    memcpy(text + T3_NONCE_SIZE, session->robot_nonce, T3_NONCE_SIZE);
    for (uint8_t half = 0; half < 2; half++) {
        text[2 * T3_NONCE_SIZE] = half;
        hash(session, USE_SESSION_KEY, text, sizeof text, session->session_key + 8 * half);
    }
}

enum t3_refusal t3_session_greet(struct t3_session *session, const struct t3_port *port,
                                 const struct t3_packet *packet, const uint8_t *data,
                                 bool *repeated)
{
    *repeated = false;
    if (session->locked)
        return T3_REFUSED_KEY;
    if (session->keyed && !packet->tag)
        return T3_REFUSED_UNSIGNED;
    // A robot without a key cannot verify a signature.
    if (!session->keyed && packet->tag)
        return T3_REFUSED_SIGNED;
    if (session->keyed) {
        uint8_t tag[T3_TAG_SIZE];
        hash(session, USE_HELLO, data, HELLO_SIGNED_SIZE, tag);
        if (!same(tag, packet->tag, T3_TAG_SIZE))
            return T3_REFUSED_TAG;
        *repeated = session->id && same(session->host_nonce, packet->nonce, T3_NONCE_SIZE);
        if (*repeated)
            return T3_ADMITTED;
        memcpy(session->host_nonce, packet->nonce, T3_NONCE_SIZE);
        draw_nonce(session, port);
        t3_session_derive_key(session);
        session->epoch = 0;
        session->last_us = packet->host_us;
    }
    session->id = packet->session;
    return T3_ADMITTED;
}

enum t3_refusal t3_session_admit(struct t3_session *session, const struct t3_packet *packet,
                                 const uint8_t *data, uint8_t size)
{
    if (!session->id || packet->session != session->id)
        return T3_REFUSED_SESSION;
    if (!session->keyed)
        return packet->tag ? T3_REFUSED_SIGNED : T3_ADMITTED;
    if (!packet->tag)
        return T3_REFUSED_UNSIGNED;
    if (packet->host_us == session->last_us)
        return T3_REFUSED_TAG;
    // A clock that reads less than before has wrapped; if it has not, the tag will not fit.
    const uint32_t epoch = session->epoch + (packet->host_us < session->last_us);
    uint8_t text[T3_RADIO_LIMIT + EPOCH_SIZE], tag[T3_TAG_SIZE];
    const uint8_t body = (uint8_t)(size - T3_TAG_SIZE);
    memcpy(text, data, body);
    t3_put32(text + body, epoch);
    t3_siphash(session->session_key, text, (uint8_t)(body + EPOCH_SIZE), tag);
    if (!same(tag, packet->tag, T3_TAG_SIZE))
        return T3_REFUSED_TAG;
    session->epoch = epoch;
    session->last_us = packet->host_us;
    return T3_ADMITTED;
}

void t3_session_store_key(const struct t3_port *port, const uint8_t *key)
{
    if (key)
        t3_store_write(port, T3_STORE_KEY, key, T3_KEY_SIZE);
    else
        t3_store_erase(port, T3_STORE_KEY, T3_KEY_SIZE);
}

void t3_session_mark_key(const struct t3_port *port, bool changing)
{
    const uint8_t mark = changing ? 0 : NO_MARK;
    port->eeprom_write(port->context, T3_STORE_KEY_MARK, &mark, 1);
}
