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
#include "t3_settings.h"

#include <string.h>

#include "t3_bytes.h"

#define FORMAT 2u
#define MICROSTEPS_LIMIT 256u
#define CHANNEL_LIMIT 125u
#define RATE_LIMIT 2u
#define POWER_LIMIT 3u
#define STEPS_LEAST 20u
#define STEPS_LIMIT 10000u
#define INVERTED 3u
#define WIRED_BIT 2u
// Full scale of 65.5 V: voltages are 16 bits of mV.
#define DIVIDER_LEAST 1000u
#define DIVIDER_LIMIT 13000u

#define OLD_FORMAT 1u
#define OLD_SIZE 9u  // without its CRC
#define OLD_COPY (T3_STORE_SETTINGS + 16u)

static bool sensors_valid(const uint8_t *sensors)
{
    for (uint8_t i = 0; i < T3_RANGES; i++)
        if (sensors[i] >= T3_SENSORS)
            return false;
    return true;
}

static bool setup_valid(const struct t3_setup *setup)
{
    // The receiver takes noise for an address of equal bytes.
    bool differ = false;
    for (uint8_t i = 1; i < sizeof setup->address; i++)
        differ = differ || setup->address[i] != setup->address[0];
    const uint16_t microsteps = setup->microsteps;
    return differ && setup->channel <= CHANNEL_LIMIT && microsteps &&
           microsteps <= MICROSTEPS_LIMIT && !(microsteps & (uint16_t)(microsteps - 1u)) &&
           setup->rate <= RATE_LIMIT && setup->power <= POWER_LIMIT &&
           setup->steps_per_turn >= STEPS_LEAST && setup->steps_per_turn <= STEPS_LIMIT &&
           setup->inverted <= INVERTED && setup->wired <= 1u && setup->divider >= DIVIDER_LEAST &&
           setup->divider <= DIVIDER_LIMIT && sensors_valid(setup->sensors);
}

bool t3_setup_valid(const uint8_t *body)
{
    struct t3_setup setup;
    t3_setup_decode(body, &setup);
    return body[0] == FORMAT && setup_valid(&setup);
}

static const struct t3_copies_kind KIND = {T3_STORE_SETTINGS, T3_STORE_SETTINGS_COPY,
                                           T3_STORE_SETTINGS_SIZE, FORMAT, t3_setup_valid};

void t3_setup_encode(const struct t3_setup *setup, uint8_t *body)
{
    uint8_t *to = t3_put8(body, FORMAT);
    to = t3_put8(to, setup->channel);
    to = t3_put16(to, setup->microsteps);
    memcpy(to, setup->address, sizeof setup->address);
    to = t3_put8(to + sizeof setup->address, setup->rate);
    to = t3_put8(to, setup->power);
    to = t3_put16(to, setup->steps_per_turn);
    to = t3_put8(to, (uint8_t)(setup->inverted | setup->wired << WIRED_BIT));
    to = t3_put16(to, setup->divider);
    memcpy(to, setup->sensors, sizeof setup->sensors);
}

void t3_setup_decode(const uint8_t *body, struct t3_setup *setup)
{
    setup->channel = body[1];
    setup->microsteps = t3_get16(body + 2);
    memcpy(setup->address, body + 4, sizeof setup->address);
    setup->rate = body[9];
    setup->power = body[10];
    setup->steps_per_turn = t3_get16(body + 11);
    setup->inverted = body[13] & INVERTED;
    setup->wired = body[13] >> WIRED_BIT;
    setup->divider = t3_get16(body + 14);
    memcpy(setup->sensors, body + 16, sizeof setup->sensors);
}

static bool is_old(const struct t3_port *port, uint16_t address)
{
    uint8_t body[OLD_SIZE];
    return t3_store_read(port, address, body, sizeof body) == T3_RECORD_GOOD &&
           body[0] == OLD_FORMAT;
}

void t3_settings_boot(struct t3_settings *settings, const struct t3_port *port)
{
    static const struct t3_setup defaults = T3_SETUP_DEFAULTS;
    settings->now = defaults;
    if (t3_copies_boot(&settings->copies, &KIND, port))
        t3_setup_decode(settings->copies.record, &settings->now);
    else if (is_old(port, T3_STORE_SETTINGS) || is_old(port, OLD_COPY))
        settings->copies.state = T3_SETTINGS_OLD;
}

bool t3_settings_usable(const struct t3_settings *settings)
{
    return settings->copies.state <= T3_SETTINGS_ONE_COPY;
}

void t3_settings_write(struct t3_settings *settings, const struct t3_port *port,
                       const uint8_t *body)
{
    t3_copies_write(&settings->copies, port, body);
}

enum t3_progress t3_settings_tick(struct t3_settings *settings, const struct t3_port *port,
                                  const struct t3_console_port *console)
{
    const enum t3_progress progress = t3_copies_tick(&settings->copies, port, console);
    if (progress == T3_PROGRESS_DONE)
        t3_setup_decode(settings->copies.record, &settings->now);
    return progress;
}
