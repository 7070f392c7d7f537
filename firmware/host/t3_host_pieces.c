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
#include <stdlib.h>
#include <string.h>

#include "t3_host.h"
#include "t3_protocol.h"
#include "t3_sensors.h"
#include "t3_siphash.h"
#include "t3_steps.h"

uint16_t t3_host_crc16(const uint8_t *data, uint8_t size)
{
    return t3_crc16(data, size);
}

uint8_t t3_host_to_wire(const uint8_t *frame, uint8_t size, uint8_t *wire)
{
    return t3_to_wire(frame, size, wire);
}

void t3_host_siphash(const uint8_t *key, const uint8_t *data, uint8_t size, uint8_t *out)
{
    t3_siphash(key, data, size, out);
}

uint8_t t3_host_range_code(uint16_t count)
{
    return t3_range_code(count);
}

uint32_t t3_host_time_us(uint32_t last_tick_us, uint8_t timer_us, bool tick_waits)
{
    return t3_time_us(last_tick_us, timer_us, tick_waits);
}

uint8_t t3_host_decode(const uint8_t *data, uint8_t size, int64_t *twelve)
{
    struct t3_packet packet;
    const enum t3_refusal fault = t3_decode(data, size, &packet);
    const int64_t numbers[12] = {
        packet.kind, packet.session, packet.seq,   packet.what,
        packet.ttl,  packet.left,    packet.right, packet.value,
        packet.echo_us, packet.host_us, packet.nonce != NULL, packet.tag != NULL,
    };
    memcpy(twelve, numbers, sizeof numbers);
    return (uint8_t)fault;
}

static uint8_t encode_state(const int64_t *f, uint8_t *to)
{
    struct t3_state state = {
        (uint8_t)f[0],  (uint8_t)f[1], (uint8_t)f[2], (uint32_t)f[3], (int32_t)f[4], (int32_t)f[5],
        (int16_t)f[6],  (int16_t)f[7], (int16_t)f[8], (uint16_t)f[9], {0},
    };
    for (int i = 0; i < 8; i++)
        state.ranges[i] = (uint8_t)f[10 + i];
    return t3_encode_state(&state, to);
}

static uint8_t encode_param(const int64_t *f, uint8_t *to)
{
    const struct t3_param param = {
        (uint8_t)f[0], (uint8_t)f[1], (uint8_t)f[2], (uint8_t)f[3],
        (int32_t)f[4], (int32_t)f[5], (int32_t)f[6],
    };
    return t3_encode_param(&param, to);
}

static uint8_t encode_info(const int64_t *f, bool with_nonce, uint8_t *to)
{
    uint8_t nonce[T3_NONCE_SIZE], address[5];
    for (unsigned i = 0; i < sizeof address; i++)
        address[i] = (uint8_t)f[12 + i];
    for (unsigned i = 0; with_nonce && i < T3_NONCE_SIZE; i++)
        nonce[i] = (uint8_t)f[18 + i];
    const struct t3_info info = {
        T3_VERSION,     (uint8_t)f[0],  (uint8_t)f[1],  (uint8_t)f[2],  (uint8_t)f[3],
        (uint8_t)f[4],  (uint8_t)f[5],  (uint8_t)f[6],  (uint16_t)f[7], (uint16_t)f[8], (uint8_t)f[9],
        (uint8_t)f[10], (uint8_t)f[11], address,        (uint32_t)f[17], with_nonce ? nonce : NULL,
    };
    return t3_encode_info(&info, to);
}

static uint8_t encode_aux(const int64_t *f, uint8_t *to)
{
    const struct t3_aux aux = {
        (uint8_t)f[0], (uint8_t)f[1], (uint8_t)f[2], (uint16_t)f[3], (int16_t)f[4],
        (int16_t)f[5], (int16_t)f[6], (int16_t)f[7],
        {(uint16_t)f[8], (uint16_t)f[9], (uint16_t)f[10], (uint16_t)f[11], (uint16_t)f[12],
         (uint16_t)f[13], (uint16_t)f[14]},
        (uint8_t)f[15], {(uint8_t)f[16], (uint8_t)f[17], (uint8_t)f[18]},
    };
    return t3_encode_aux(&aux, to);
}

uint8_t t3_host_encode(uint8_t kind, const int64_t *fields, bool with_nonce, uint8_t *to)
{
    switch (kind) {
    case T3_STATE:
        return encode_state(fields, to);
    case T3_PARAM:
        return encode_param(fields, to);
    case T3_INFO:
        return encode_info(fields, with_nonce, to);
    case T3_ACK:
        return t3_encode_ack((uint8_t)fields[0], (uint8_t)fields[1], (uint8_t)fields[2],
                             (uint8_t)fields[3], to);
    case T3_AUX:
        return encode_aux(fields, to);
    default:
        return 0;
    }
}

struct t3_host_splitter {
    struct t3_splitter splitter;
};

struct t3_host_splitter *t3_host_splitter_new(void)
{
    struct t3_host_splitter *host = calloc(1, sizeof *host);
    if (host)
        t3_splitter_start(&host->splitter);
    return host;
}

void t3_host_splitter_free(struct t3_host_splitter *host)
{
    free(host);
}

uint32_t t3_host_splitter_feed(struct t3_host_splitter *host, const uint8_t *data, uint32_t count,
                               uint8_t *frame, uint8_t *size)
{
    uint32_t taken = 0;
    *size = 0;
    while (taken < count && !*size)
        *size = t3_splitter_byte(&host->splitter, data[taken++]);
    memcpy(frame, host->splitter.frame, *size);
    return taken;
}

void t3_host_splitter_counts(const struct t3_host_splitter *host, uint16_t *three)
{
    three[0] = host->splitter.frames;
    three[1] = host->splitter.crc_errors;
    three[2] = host->splitter.frame_errors;
}
