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
#include "t3_dongle.h"

#include <string.h>

#include "t3_bytes.h"

#define TX_HEAD 4u
#define CFG_SIZE 12u
#define CFG_READ_SIZE 2u
#define RESULT_HEAD 8u
#define RETRANSMITS_LIMIT 15u

static uint32_t now(const struct t3_dongle *dongle)
{
    return dongle->port->time_us(dongle->port->context);
}

static void reply(struct t3_dongle *dongle, const uint8_t *frame, uint8_t size)
{
    uint8_t wire[T3_WIRE_LIMIT];
    const uint8_t length = t3_to_wire(frame, size, wire);
    dongle->port->reply(dongle->port->context, wire, length);
}

static void refuse(struct t3_dongle *dongle, uint8_t code, uint8_t argument)
{
    const uint8_t frame[] = {T3_ERR, code, argument};
    reply(dongle, frame, sizeof frame);
}

static void configure(struct t3_dongle *dongle)
{
    dongle->chip_ok = dongle->port->configure(dongle->port->context, &dongle->radio);
}

// -- transaction ---------------------------------------------------------------------------------

static void send(struct t3_dongle *dongle, enum t3_dongle_phase phase, const uint8_t *payload,
                 uint8_t size)
{
    // Before the call of the radio, which may already end the exchange.
    dongle->phase = phase;
    dongle->phase_us = now(dongle);
    dongle->port->send(dongle->port->context, payload, size);
}

static void report(struct t3_dongle *dongle)
{
    uint8_t frame[RESULT_HEAD + T3_RADIO_LIMIT];
    dongle->phase = T3_IDLE;
    uint8_t *to = t3_put8(frame, T3_RESULT);
    to = t3_put8(to, dongle->id);
    to = t3_put8(to, dongle->status[0]);
    to = t3_put8(to, dongle->status[1]);
    to = t3_put32(to, now(dongle));
    memcpy(to, dongle->answer, dongle->answer_size);
    reply(dongle, frame, (uint8_t)(RESULT_HEAD + dongle->answer_size));
}

void t3_dongle_exchange(struct t3_dongle *dongle, bool acknowledged, uint8_t retransmits,
                        const uint8_t *answer, uint8_t size)
{
    if (dongle->phase != T3_FIRST && dongle->phase != T3_SECOND)
        return;  // no transaction in progress
    const bool first = dongle->phase == T3_FIRST;
    if (retransmits > RETRANSMITS_LIMIT)
        retransmits = RETRANSMITS_LIMIT;
    uint8_t status = (uint8_t)(retransmits << 4);
    status = (uint8_t)(status | (acknowledged ? T3_EXCHANGE_ACK : T3_EXCHANGE_MAX_RT));
    // A width beyond the FIFO is invalid: drop the payload.
    if (acknowledged && size && size <= T3_RADIO_LIMIT) {
        status |= T3_EXCHANGE_PAYLOAD;
        memcpy(dongle->answer, answer, size);
        dongle->answer_size = size;
    }
    dongle->status[first ? 0 : 1] = status;
    if (first && acknowledged && dongle->second_size) {
        dongle->phase = T3_GAP;
        dongle->phase_us = now(dongle);
        return;
    }
    if (first)
        dongle->status[1] = T3_EXCHANGE_SKIPPED;
    report(dongle);
}

static void take_tx(struct t3_dongle *dongle, const uint8_t *frame, uint8_t size)
{
    if (size < TX_HEAD || frame[3] < 1 || frame[3] > T3_RADIO_LIMIT ||
        size < TX_HEAD + frame[3] || size > TX_HEAD + frame[3] + T3_RADIO_LIMIT) {
        refuse(dongle, T3_ERR_MALFORMED, T3_TX);
        return;
    }
    if (dongle->phase != T3_IDLE) {
        refuse(dongle, T3_ERR_BUSY, frame[1]);
        return;
    }
    const uint8_t first_size = frame[3];
    dongle->id = frame[1];
    dongle->gap = frame[2];
    dongle->second_size = (uint8_t)(size - TX_HEAD - first_size);
    memcpy(dongle->second, frame + TX_HEAD + first_size, dongle->second_size);
    dongle->answer_size = 0;
    send(dongle, T3_FIRST, frame + TX_HEAD, first_size);
}

// -- the other frames ----------------------------------------------------------------------------

static bool read_settings(const uint8_t *frame, struct t3_radio_settings *settings)
{
    settings->channel = frame[2];
    settings->rate = frame[3];
    settings->power = frame[4];
    settings->retry_delay = frame[5];
    settings->retries = frame[6];
    memcpy(settings->address, frame + 7, sizeof settings->address);
    return settings->channel <= 125 && settings->rate <= 2 && settings->power <= 3 &&
           settings->retry_delay <= 15 && settings->retries <= 15;
}

static void send_configuration(struct t3_dongle *dongle, uint8_t id)
{
    const struct t3_radio_settings *radio = &dongle->radio;
    uint8_t frame[CFG_SIZE + 1] = {T3_CFG_IS,    id,           radio->channel,     radio->rate,
                                   radio->power, radio->retry_delay, radio->retries};
    memcpy(frame + 7, radio->address, sizeof radio->address);
    frame[CFG_SIZE] = dongle->chip_ok;
    reply(dongle, frame, sizeof frame);
}

static void take_cfg(struct t3_dongle *dongle, const uint8_t *frame, uint8_t size)
{
    struct t3_radio_settings wanted = dongle->radio;
    if (size != CFG_READ_SIZE && (size != CFG_SIZE || !read_settings(frame, &wanted))) {
        refuse(dongle, T3_ERR_MALFORMED, T3_CFG);
        return;
    }
    if (size == CFG_SIZE) {
        if (dongle->phase != T3_IDLE) {
            refuse(dongle, T3_ERR_BUSY, frame[1]);
            return;
        }
        dongle->radio = wanted;
        configure(dongle);
    }
    send_configuration(dongle, frame[1]);
}

static void take_ping(struct t3_dongle *dongle, const uint8_t *frame, uint8_t size)
{
    if (size != T3_PING_SIZE) {
        refuse(dongle, T3_ERR_MALFORMED, T3_PING);
        return;
    }
    const struct t3_pong pong = {
        .time_us = now(dongle),
        .chip_ok = dongle->chip_ok,
        .crc_errors = dongle->splitter.crc_errors,
        .frame_errors = dongle->splitter.frame_errors,
        .overruns = dongle->overruns,
        .reset_cause = dongle->reset_cause,
        .channel = dongle->radio.channel,
        .address = dongle->radio.address,
    };
    uint8_t answer[T3_PONG_SIZE];
    reply(dongle, answer, t3_encode_pong(frame, &pong, answer));
}

void t3_dongle_byte(struct t3_dongle *dongle, uint8_t byte)
{
    const uint8_t size = t3_splitter_byte(&dongle->splitter, byte);
    const uint8_t *frame = dongle->splitter.frame;
    if (!size)
        return;
    switch (frame[0]) {
    case T3_TX:
        take_tx(dongle, frame, size);
        return;
    case T3_CFG:
        take_cfg(dongle, frame, size);
        return;
    case T3_PING:
        take_ping(dongle, frame, size);
        return;
    default:
        refuse(dongle, T3_ERR_UNKNOWN, frame[0]);
    }
}

void t3_dongle_overrun(struct t3_dongle *dongle)
{
    dongle->overruns++;
}

void t3_dongle_tick(struct t3_dongle *dongle)
{
    const uint32_t elapsed = now(dongle) - dongle->phase_us;
    if (dongle->phase == T3_GAP) {
        if (elapsed >= (uint32_t)dongle->gap * T3_GAP_UNIT_US)
            send(dongle, T3_SECOND, dongle->second, dongle->second_size);
    } else if (dongle->phase != T3_IDLE && elapsed >= T3_EXCHANGE_LIMIT_US) {
        configure(dongle);  // it may come back
        t3_dongle_exchange(dongle, false, 0, NULL, 0);
    }
}

void t3_dongle_boot(struct t3_dongle *dongle, const struct t3_dongle_port *port,
                    uint8_t reset_cause)
{
    static const struct t3_radio_settings defaults = T3_RADIO_DEFAULTS;
    memset(dongle, 0, sizeof *dongle);
    dongle->port = port;
    dongle->reset_cause = reset_cause;
    dongle->radio = defaults;
    t3_splitter_start(&dongle->splitter);
    configure(dongle);
}
