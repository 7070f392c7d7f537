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

#include "t3_dongle.h"
#include "t3_host.h"

#define ROOM 65536u

struct t3_host_dongle {
    struct t3_dongle dongle;
    struct t3_dongle_port port;
    uint32_t time_us, configured;
    bool chip_ok;
    uint8_t sent[T3_RADIO_LIMIT], sent_size;
    uint8_t written[ROOM];
    uint32_t written_size;
};

static uint32_t time_us(void *context)
{
    const struct t3_host_dongle *host = context;
    return host->time_us;
}

static void reply(void *context, const uint8_t *wire, uint8_t size)
{
    struct t3_host_dongle *host = context;
    if (host->written_size + size > ROOM)
        return;  // buffer full: lost, as on a serial line
    memcpy(host->written + host->written_size, wire, size);
    host->written_size += size;
}

static void send(void *context, const uint8_t *payload, uint8_t size)
{
    struct t3_host_dongle *host = context;
    if (!size || size > T3_RADIO_LIMIT)
        abort();
    memcpy(host->sent, payload, size);
    host->sent_size = size;
}

static bool configure(void *context, const struct t3_radio_settings *settings)
{
    struct t3_host_dongle *host = context;
    if (settings->channel > 125)
        abort();
    host->configured++;
    return host->chip_ok;
}

struct t3_host_dongle *t3_host_dongle_new(uint8_t reset_cause)
{
    struct t3_host_dongle *host = calloc(1, sizeof *host);
    if (!host)
        return NULL;
    const struct t3_dongle_port port = {host, time_us, reply, send, configure};
    host->port = port;
    host->chip_ok = true;
    t3_host_dongle_boot(host, reset_cause);
    return host;
}

void t3_host_dongle_boot(struct t3_host_dongle *host, uint8_t reset_cause)
{
    host->time_us = 0;
    host->sent_size = 0;
    host->written_size = 0;
    t3_dongle_boot(&host->dongle, &host->port, reset_cause);
}

void t3_host_dongle_free(struct t3_host_dongle *host)
{
    free(host);
}

void t3_host_dongle_bytes(struct t3_host_dongle *host, const uint8_t *data, uint32_t size)
{
    for (uint32_t i = 0; i < size; i++)
        t3_dongle_byte(&host->dongle, data[i]);
}

void t3_host_dongle_run(struct t3_host_dongle *host, uint32_t us)
{
    // The main loop comes round every 10 us.
    while (us) {
        const uint32_t step = us < 10 ? us : 10;
        host->time_us += step;
        us -= step;
        t3_dongle_tick(&host->dongle);
    }
}

void t3_host_dongle_tick(struct t3_host_dongle *host, uint32_t now_us)
{
    host->time_us = now_us;
    t3_dongle_tick(&host->dongle);
}

uint32_t t3_host_dongle_idle_us(const struct t3_host_dongle *host)
{
    const struct t3_dongle *dongle = &host->dongle;
    if (dongle->phase == T3_IDLE)
        return UINT32_MAX;
    const uint32_t whole =
        dongle->phase == T3_GAP ? dongle->gap * T3_GAP_UNIT_US : T3_EXCHANGE_LIMIT_US;
    const uint32_t elapsed = host->time_us - dongle->phase_us;
    return elapsed < whole ? whole - elapsed : 0;
}

void t3_host_dongle_radio(const struct t3_host_dongle *host, uint8_t *ten)
{
    const struct t3_radio_settings *radio = &host->dongle.radio;
    const uint8_t numbers[] = {radio->channel, radio->rate, radio->power, radio->retry_delay,
                               radio->retries};
    memcpy(ten, numbers, sizeof numbers);
    memcpy(ten + sizeof numbers, radio->address, sizeof radio->address);
}

uint32_t t3_host_dongle_take(struct t3_host_dongle *host, uint8_t *to, uint32_t room)
{
    const uint32_t size = host->written_size < room ? host->written_size : room;
    memcpy(to, host->written, size);
    host->written_size -= size;
    memmove(host->written, host->written + size, host->written_size);
    return size;
}

uint8_t t3_host_dongle_sent(struct t3_host_dongle *host, uint8_t *to)
{
    const uint8_t size = host->sent_size;
    memcpy(to, host->sent, size);
    host->sent_size = 0;
    return size;
}

void t3_host_dongle_answer(struct t3_host_dongle *host, bool acknowledged, uint8_t retransmits,
                           const uint8_t *answer, uint8_t size)
{
    t3_dongle_exchange(&host->dongle, acknowledged, retransmits, answer, size);
}

void t3_host_dongle_set_chip(struct t3_host_dongle *host, bool ok)
{
    host->chip_ok = ok;
}

void t3_host_dongle_overrun(struct t3_host_dongle *host)
{
    t3_dongle_overrun(&host->dongle);
}

uint32_t t3_host_dongle_time(const struct t3_host_dongle *host)
{
    return host->time_us;
}

uint32_t t3_host_dongle_configured(const struct t3_host_dongle *host)
{
    return host->configured;
}
