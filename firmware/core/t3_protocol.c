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
#include "t3_protocol.h"

#include <string.h>

#include "t3_bytes.h"

// -- radio payloads ------------------------------------------------------------------------------

// Sizes by kind; a signed one ends with the clock of the host and a tag (in HELLO with a nonce
// between them). 0: there is no signed form.
struct form {
    uint8_t plain, tagged;
};

static const struct form FORMS[] = {
    [T3_CMD] = {T3_CMD_SIZE, 26},
    [T3_PARAM_GET] = {4, 0},
    [T3_PARAM_SET] = {8, 20},
    [T3_HELLO] = {4, 24},
    [T3_POLL] = {4, 0},
    [T3_ACTION] = {6, 18},
};

// Sizes of a CMD of version 1.
static const struct form COMMAND_1 = {14, 22};
// Return whether every value is valid.
static bool read_command(const uint8_t *data, struct t3_packet *packet)
{
    packet->ttl = data[4];
    packet->left = t3_signed16(t3_get16(data + 6));
    packet->right = t3_signed16(t3_get16(data + 8));
    packet->echo_us = t3_get32(data + 10);
    if (packet->tag)
        packet->host_us = t3_get32(data + 14);
    return packet->what <= (T3_FLAG_ENABLE | T3_FLAG_ESTOP | T3_FLAG_ESTOP_CLEAR) && !data[5];
}

static bool read_param_set(const uint8_t *data, struct t3_packet *packet)
{
    packet->value = t3_signed32(t3_get32(data + 4));
    if (packet->tag)
        packet->host_us = t3_get32(data + 8);
    return true;
}

static bool read_hello(const uint8_t *data, struct t3_packet *packet)
{
    if (packet->tag) {
        packet->host_us = t3_get32(data + 4);
        packet->nonce = data + 8;
    }
    // Flag and length agree; session 0 means none and cannot be started.
    return packet->session && packet->what == (packet->tag ? 1 : 0);
}

static bool read_action(const uint8_t *data, struct t3_packet *packet)
{
    if (packet->tag)
        packet->host_us = t3_get32(data + 6);
    return !t3_get16(data + 4);
}

static bool has_form(struct form form, uint8_t size)
{
    return size == form.plain || (form.tagged && size == form.tagged);
}

static bool read_body(const uint8_t *data, struct t3_packet *packet)
{
    switch (packet->kind) {
    case T3_CMD:
        return read_command(data, packet);
    case T3_PARAM_SET:
        return read_param_set(data, packet);
    case T3_HELLO:
        return read_hello(data, packet);
    case T3_POLL:
        return packet->what <= T3_POLL_INFO;
    case T3_ACTION:
        return read_action(data, packet);
    default:
        return true;  // PARAM_GET: any id may be asked for
    }
}

enum t3_refusal t3_decode(const uint8_t *data, uint8_t size, struct t3_packet *packet)
{
    memset(packet, 0, sizeof *packet);
    if (size < 1 || size > T3_RADIO_LIMIT)
        return T3_REFUSED_FORM;
    packet->kind = data[0] & 0x0F;
    if (data[0] >> 4 != T3_VERSION)
        return T3_REFUSED_VERSION;
    if (packet->kind < T3_CMD || packet->kind > T3_ACTION)
        return T3_REFUSED_FORM;
    const struct form form = FORMS[packet->kind];
    if (!has_form(form, size))
        return T3_REFUSED_FORM;
    packet->session = data[1];
    packet->seq = data[2];
    packet->what = data[3];
    if (size == form.tagged)
        packet->tag = data + size - T3_TAG_SIZE;
    return read_body(data, packet) ? T3_ADMITTED : T3_REFUSED_FORM;
}

bool t3_asks_to_stop(const uint8_t *data, uint8_t size)
{
    if (!has_form(FORMS[T3_CMD], size) && !has_form(COMMAND_1, size))
        return false;
    const uint8_t version = data[0] >> 4;
    return version >= 1 && version <= T3_VERSION && (data[0] & 0x0F) == T3_CMD &&
           (data[3] & T3_FLAG_ESTOP);
}

bool t3_asks_for_identity(const uint8_t *data, uint8_t size)
{
    if (size <= T3_HEADER_SIZE || size > T3_RADIO_LIMIT || data[0] >> 4 == T3_VERSION)
        return false;
    const uint8_t kind = data[0] & 0x0F;
    return kind == T3_HELLO || (kind == T3_POLL && data[3] == T3_POLL_INFO);
}
// Write what every payload begins with.
static uint8_t *put_header(uint8_t *to, uint8_t kind, uint8_t session, uint8_t seq)
{
    to = t3_put8(to, (uint8_t)(T3_VERSION << 4 | kind));
    to = t3_put8(to, session);
    return t3_put8(to, seq);
}

uint8_t t3_encode_state(const struct t3_state *state, uint8_t *to)
{
    to = put_header(to, T3_STATE, state->session, state->seq);
    to = t3_put8(to, state->status);
    to = t3_put32(to, state->time_us);
    to = t3_put32(to, (uint32_t)state->left);
    to = t3_put32(to, (uint32_t)state->right);
    to = t3_put16(to, (uint16_t)state->gyro_z);
    to = t3_put16(to, (uint16_t)state->accel_x);
    to = t3_put16(to, (uint16_t)state->accel_y);
    to = t3_put16(to, state->age);
    for (uint8_t i = 0; i < sizeof state->ranges; i++)
        to = t3_put8(to, state->ranges[i]);
    return T3_STATE_SIZE;
}

uint8_t t3_encode_param(const struct t3_param *param, uint8_t *to)
{
    to = put_header(to, T3_PARAM, param->session, param->seq);
    to = t3_put8(to, param->id);
    to = t3_put8(to, param->rc);
    to = t3_put32(to, (uint32_t)param->value);
    to = t3_put32(to, (uint32_t)param->low);
    t3_put32(to, (uint32_t)param->high);
    return T3_PARAM_SIZE;
}

static uint8_t *put_radio(uint8_t *to, uint8_t channel, const uint8_t *address)
{
    to = t3_put8(to, channel);
    for (uint8_t i = 0; i < 5; i++)
        to = t3_put8(to, address[i]);
    return to;
}

uint8_t t3_encode_info(const struct t3_info *info, uint8_t *to)
{
    to = t3_put8(to, (uint8_t)(info->version << 4 | T3_INFO));
    to = t3_put8(to, info->session);
    to = t3_put8(to, info->seq);
    to = t3_put8(to, info->protocol);
    to = t3_put8(to, info->major);
    to = t3_put8(to, info->minor);
    to = t3_put8(to, info->reset_cause);
    to = t3_put8(to, info->parameters);
    to = t3_put16(to, info->steps_per_rev);
    to = t3_put16(to, info->microsteps);
    to = t3_put8(to, info->refusal);
    to = t3_put8(to, info->settings);
    to = put_radio(to, info->channel, info->address);
    to = t3_put32(to, info->build);
    if (!info->nonce)
        return T3_INFO_SIZE;
    for (uint8_t i = 0; i < T3_NONCE_SIZE; i++)
        to = t3_put8(to, info->nonce[i]);
    return T3_INFO_SIZE + T3_NONCE_SIZE;
}

uint8_t t3_encode_ack(uint8_t session, uint8_t seq, uint8_t verb, uint8_t rc, uint8_t *to)
{
    to = put_header(to, T3_ACK, session, seq);
    to = t3_put8(to, verb);
    t3_put8(to, rc);
    return T3_ACK_SIZE;
}

uint8_t t3_encode_aux(const struct t3_aux *aux, uint8_t *to)
{
    to = put_header(to, T3_AUX, aux->session, aux->seq);
    to = t3_put8(to, aux->status);
    to = t3_put16(to, aux->battery);
    to = t3_put16(to, (uint16_t)aux->temperature);
    to = t3_put16(to, (uint16_t)aux->accel_z);
    to = t3_put16(to, (uint16_t)aux->gyro_x);
    to = t3_put16(to, (uint16_t)aux->gyro_y);
    to = t3_put16(to, aux->counters.received);
    to = t3_put16(to, aux->counters.duplicates);
    to = t3_put16(to, aux->counters.bad_session);
    to = t3_put16(to, aux->counters.stale);
    to = t3_put16(to, aux->counters.expired);
    to = t3_put16(to, aux->counters.bad_version);
    to = t3_put16(to, aux->counters.malformed);
    to = t3_put8(to, aux->refusal);
    for (uint8_t i = 0; i < T3_HEADER_SIZE; i++)
        to = t3_put8(to, aux->refused[i]);
    return T3_AUX_SIZE;
}

// -- serial line ---------------------------------------------------------------------------------

uint8_t t3_encode_pong(const uint8_t *ping, const struct t3_pong *pong, uint8_t *to)
{
    memcpy(to, ping, T3_PING_SIZE);
    to[0] = T3_PONG;
    to = t3_put32(to + T3_PING_SIZE, pong->time_us);
    to = t3_put8(to, T3_VERSION);
    to = t3_put8(to, T3_FIRMWARE_MAJOR);
    to = t3_put8(to, T3_FIRMWARE_MINOR);
    to = t3_put8(to, pong->chip_ok);
    to = t3_put16(to, pong->crc_errors);
    to = t3_put16(to, pong->frame_errors);
    to = t3_put16(to, pong->overruns);
    to = t3_put8(to, pong->reset_cause);
    to = t3_put8(to, pong->settings);
    to = put_radio(to, pong->channel, pong->address);
    t3_put32(to, T3_BUILD);
    return T3_PONG_SIZE;
}

uint16_t t3_crc16(const uint8_t *data, uint8_t size)
{
    uint16_t crc = 0xFFFF;
    while (size--) {
        // Eight steps of the polynomial 0x1021 at once, without a table.
        crc = (uint16_t)((uint16_t)(crc << 8) | (uint16_t)(crc >> 8));
        crc = (uint16_t)(crc ^ *data++);
        crc = (uint16_t)(crc ^ (uint8_t)((uint8_t)crc >> 4));
        crc = (uint16_t)(crc ^ (uint16_t)((uint16_t)(crc & 0x0F) << 12));
        crc = (uint16_t)(crc ^ (uint16_t)((uint16_t)(crc & 0xFF) << 5));
    }
    return crc;
}

uint8_t t3_to_wire(const uint8_t *frame, uint8_t size, uint8_t *wire)
{
    if (size < 1 || size > T3_FRAME_LIMIT)
        return 0;
    uint8_t crc[T3_CRC_SIZE];
    t3_put16(crc, t3_crc16(frame, size));
    // No run reaches 254 bytes here, so COBS needs no case for that.
    uint8_t run = 0, at = 1;  // where the run's length goes, and where the next byte does
    for (uint8_t i = 0; i < size + T3_CRC_SIZE; i++) {
        const uint8_t byte = i < size ? frame[i] : crc[i - size];
        if (byte) {
            wire[at++] = byte;
        } else {
            wire[run] = (uint8_t)(at - run);
            run = at++;
        }
    }
    wire[run] = (uint8_t)(at - run);
    wire[at++] = 0;
    return at;
}

static void begin_frame(struct t3_splitter *splitter)
{
    splitter->size = splitter->left = 0;
    splitter->begun = splitter->bad = false;
}

void t3_splitter_start(struct t3_splitter *splitter)
{
    begin_frame(splitter);
    splitter->frames = splitter->crc_errors = splitter->frame_errors = 0;
}

static void keep(struct t3_splitter *splitter, uint8_t byte)
{
    if (splitter->size < sizeof splitter->frame)
        splitter->frame[splitter->size++] = byte;
    else
        splitter->bad = true;
}

static uint8_t end_frame(struct t3_splitter *splitter)
{
    const uint8_t size = splitter->size;
    const bool begun = splitter->begun;
    const bool bad = splitter->bad || splitter->left || size <= T3_CRC_SIZE;
    begin_frame(splitter);
    if (!begun)
        return 0;  // consecutive zeros: a sender may start with a zero to resynchronise
    if (bad) {
        splitter->frame_errors++;
        return 0;
    }
    const uint8_t body = (uint8_t)(size - T3_CRC_SIZE);
    if (t3_crc16(splitter->frame, body) != t3_get16(splitter->frame + body)) {
        splitter->crc_errors++;
        return 0;
    }
    splitter->frames++;
    return body;
}

uint8_t t3_splitter_byte(struct t3_splitter *splitter, uint8_t byte)
{
    if (!byte)
        return end_frame(splitter);
    if (splitter->bad)
        return 0;
    if (splitter->left) {
        splitter->left--;
        keep(splitter, byte);
        return 0;
    }
    // A run begins: between two runs there was a zero.
    if (splitter->begun)
        keep(splitter, 0);
    splitter->begun = true;
    splitter->left = (uint8_t)(byte - 1);
    return 0;
}
