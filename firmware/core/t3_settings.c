// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "t3_settings.h"

#include <string.h>

#include "t3_bytes.h"
#include "t3_protocol.h"

#define FORMAT 1u
#define INVALID 0xFFu
#define BODY_SIZE (T3_STORE_SETTINGS_SIZE - T3_CRC_SIZE)
#define MICROSTEPS_LIMIT 256u
#define CHANNEL_LIMIT 125u

bool t3_setup_valid(const struct t3_setup *setup)
{
    bool differ = false;
    for (uint8_t i = 1; i < sizeof setup->address; i++)
        differ = differ || setup->address[i] != setup->address[0];
    const uint16_t microsteps = setup->microsteps;
    return differ && setup->channel <= CHANNEL_LIMIT && microsteps &&
           microsteps <= MICROSTEPS_LIMIT && !(microsteps & (uint16_t)(microsteps - 1u));
}

static void encode(const struct t3_setup *setup, uint8_t record[T3_STORE_SETTINGS_SIZE])
{
    uint8_t *to = t3_put8(record, FORMAT);
    to = t3_put8(to, setup->channel);
    to = t3_put16(to, setup->microsteps);
    memcpy(to, setup->address, sizeof setup->address);
    t3_put16(record + BODY_SIZE, t3_crc16(record, BODY_SIZE));
}

static enum t3_record read_copy(const struct t3_port *port, uint8_t address,
                                struct t3_setup *setup)
{
    uint8_t body[BODY_SIZE];
    const enum t3_record found = t3_store_read(port, address, body, sizeof body);
    if (found != T3_RECORD_GOOD)
        return found;
    setup->channel = body[1];
    setup->microsteps = t3_get16(body + 2);
    memcpy(setup->address, body + 4, sizeof setup->address);
    return body[0] == FORMAT && t3_setup_valid(setup) ? T3_RECORD_GOOD : T3_RECORD_DAMAGED;
}

static void begin_copy(struct t3_settings *settings, const struct t3_port *port, uint8_t address)
{
    static const uint8_t invalid = INVALID;
    settings->at = address;
    settings->step = T3_SETTINGS_OPENED;
    port->eeprom_write(port->context, address, &invalid, 1);
}

void t3_settings_boot(struct t3_settings *settings, const struct t3_port *port)
{
    static const struct t3_radio_settings radio = T3_RADIO_DEFAULTS;
    memset(settings, 0, sizeof *settings);
    struct t3_setup first, second;
    const enum t3_record one = read_copy(port, T3_STORE_SETTINGS, &first);
    const enum t3_record two = read_copy(port, T3_STORE_SETTINGS_COPY, &second);
    if (one != T3_RECORD_GOOD && two != T3_RECORD_GOOD) {
        const bool blank = one == T3_RECORD_BLANK && two == T3_RECORD_BLANK;
        settings->state = blank ? T3_SETTINGS_MISSING : T3_SETTINGS_DAMAGED;
        settings->now.channel = radio.channel;
        settings->now.microsteps = T3_DEFAULT_MICROSTEPS;
        memcpy(settings->now.address, radio.address, sizeof radio.address);
        return;
    }
    settings->now = one == T3_RECORD_GOOD ? first : second;
    settings->state = T3_SETTINGS_GOOD;
    uint8_t other[T3_STORE_SETTINGS_SIZE];
    encode(&settings->now, settings->record);
    const uint8_t repaired = one == T3_RECORD_GOOD ? T3_STORE_SETTINGS_COPY : T3_STORE_SETTINGS;
    port->eeprom_read(port->context, repaired, other, sizeof other);
    if (!memcmp(other, settings->record, sizeof other))
        return;
    settings->state = T3_SETTINGS_ONE_COPY;
    settings->copies = 1;
    begin_copy(settings, port, repaired);
}

bool t3_settings_usable(const struct t3_settings *settings)
{
    return settings->state <= T3_SETTINGS_ONE_COPY;
}

void t3_settings_write(struct t3_settings *settings, const struct t3_port *port,
                       const struct t3_setup *setup)
{
    struct t3_setup stored;
    const bool one = read_copy(port, T3_STORE_SETTINGS, &stored) == T3_RECORD_GOOD;
    const bool two = read_copy(port, T3_STORE_SETTINGS_COPY, &stored) == T3_RECORD_GOOD;
    settings->state = T3_SETTINGS_DAMAGED;
    settings->copies = 2;
    encode(setup, settings->record);
    // The only valid copy is the last to change. Of two, the first is the one that counts at boot.
    begin_copy(settings, port, one && !two ? T3_STORE_SETTINGS_COPY : T3_STORE_SETTINGS);
}

static enum t3_progress finish(struct t3_settings *settings, enum t3_progress how)
{
    settings->step = T3_SETTINGS_IDLE;
    if (how == T3_PROGRESS_DONE) {
        const uint8_t *from = settings->record;
        settings->state = T3_SETTINGS_GOOD;
        settings->now.channel = from[1];
        settings->now.microsteps = t3_get16(from + 2);
        memcpy(settings->now.address, from + 4, sizeof settings->now.address);
    }
    return how;
}

enum t3_progress t3_settings_tick(struct t3_settings *settings, const struct t3_port *port,
                                  const struct t3_console_port *console)
{
    if (settings->step == T3_SETTINGS_IDLE || !console->eeprom_settled(console->context))
        return T3_PROGRESS_NONE;
    if (!t3_store_verify(port, console, settings->at, T3_STORE_SETTINGS_SIZE))
        return finish(settings, T3_PROGRESS_FAILED);
    switch (settings->step) {
    case T3_SETTINGS_OPENED:
        settings->step = T3_SETTINGS_FILLED;
        port->eeprom_write(port->context, (uint8_t)(settings->at + 1u), settings->record + 1,
                           T3_STORE_SETTINGS_SIZE - 1u);
        return T3_PROGRESS_NONE;
    case T3_SETTINGS_FILLED:
        settings->step = T3_SETTINGS_CLOSED;
        port->eeprom_write(port->context, settings->at, settings->record, 1);
        return T3_PROGRESS_NONE;
    default:
        break;
    }
    if (!--settings->copies)
        return finish(settings, T3_PROGRESS_DONE);
    begin_copy(settings, port,
               settings->at == T3_STORE_SETTINGS ? T3_STORE_SETTINGS_COPY : T3_STORE_SETTINGS);
    return T3_PROGRESS_NONE;
}
