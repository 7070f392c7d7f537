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

#include "t3_console.h"
#include "t3_host.h"
#include "t3_robot.h"
#include "t3_store.h"

#define CHANNELS 9u
#define NEVER 0xFFFFFFFFu
#define USB_ROOM 4096u
#define MICROSTEP 4294967296.0  // phase of the pulse generator

struct t3_host_robot {
    struct t3_robot robot;
    struct t3_port port;
    uint32_t time_us, since_tick_us, noise, first_noise;
    // The copy that the core reads and writes, and the cells that follow it one by one.
    uint8_t eeprom[T3_STORE_END], cells[T3_STORE_END];
    bool worn[T3_STORE_END];  // cells that keep what they hold
    bool unsettled;  // cells may still be to be written
    uint32_t eeprom_writes, cell_us, since_cell_us;
    struct t3_console console;
    struct t3_console_port usb;
    bool chip_ok;
    uint8_t usb_output[USB_ROOM];
    uint32_t usb_output_size;
    uint8_t levels;  // of LED and buzzer
    uint8_t ack[T3_RADIO_LIMIT], ack_size;
    uint32_t loads, setups;
    bool powered, pressed, imu_answers;
    struct t3_imu imu;
    uint16_t adc[CHANNELS];
    bool nonce_forced;
    uint8_t nonce[T3_NONCE_SIZE];
    // At the pins of the drivers.
    uint8_t pins;
    int32_t pulses[T3_WHEELS];
    int64_t moved[T3_WHEELS];  // 2**32 per microstep
    uint32_t ticks, last_pulse[T3_WHEELS], closest, unpowered, hasty;
    int locked;
};

static uint32_t time_us(void *context)
{
    const struct t3_host_robot *host = context;
    return host->time_us;
}

static void load_ack(void *context, const uint8_t *payload, uint8_t size)
{
    struct t3_host_robot *host = context;
    if (!size || size > T3_RADIO_LIMIT)
        abort();
    memcpy(host->ack, payload, size);
    host->ack_size = size;
    host->loads++;
}

static void drivers(void *context, bool on)
{
    struct t3_host_robot *host = context;
    host->powered = on;
}

static bool estop_pressed(void *context)
{
    const struct t3_host_robot *host = context;
    return host->pressed;
}

static bool imu(void *context, struct t3_imu *sample)
{
    const struct t3_host_robot *host = context;
    *sample = host->imu;
    return host->imu_answers;
}

static uint16_t adc(void *context, uint8_t channel)
{
    const struct t3_host_robot *host = context;
    if (channel >= CHANNELS)
        abort();
    return host->adc[channel];
}

// Return the first cell that is still to be written.
static uint16_t unwritten(const struct t3_host_robot *host)
{
    uint16_t i = 0;
    while (i < T3_STORE_END && (host->worn[i] || host->eeprom[i] == host->cells[i]))
        i++;
    return i;
}

static void work_eeprom(struct t3_host_robot *host, uint32_t passed_us)
{
    if (!host->unsettled)
        return;
    uint16_t next = unwritten(host);
    host->unsettled = next < T3_STORE_END;
    host->since_cell_us = next < T3_STORE_END ? host->since_cell_us + passed_us : 0;
    for (; next < T3_STORE_END && host->since_cell_us >= host->cell_us; next = unwritten(host)) {
        host->since_cell_us -= host->cell_us;
        host->cells[next] = host->eeprom[next];
    }
}

static void eeprom_read(void *context, uint16_t address, uint8_t *data, uint8_t size)
{
    const struct t3_host_robot *host = context;
    if (address + size > (int)sizeof host->eeprom)
        abort();
    memcpy(data, host->eeprom + address, size);
}

static void eeprom_write(void *context, uint16_t address, const uint8_t *data, uint8_t size)
{
    struct t3_host_robot *host = context;
    if (address + size > (int)sizeof host->eeprom)
        abort();
    memcpy(host->eeprom + address, data, size);
    host->unsettled = true;
    host->eeprom_writes++;
    if (!host->cell_us)
        work_eeprom(host, 0);
}

static void reply(void *context, const uint8_t *wire, uint8_t size)
{
    struct t3_host_robot *host = context;
    if (host->usb_output_size + size > USB_ROOM)
        return;  // buffer full: lost, as on a serial line
    memcpy(host->usb_output + host->usb_output_size, wire, size);
    host->usb_output_size += size;
}

static bool chip_ok(void *context)
{
    const struct t3_host_robot *host = context;
    return host->chip_ok;
}

static bool eeprom_settled(void *context)
{
    const struct t3_host_robot *host = context;
    return !host->unsettled || unwritten(host) == T3_STORE_END;
}

static void eeprom_cells(void *context, uint16_t address, uint8_t *data, uint8_t size)
{
    const struct t3_host_robot *host = context;
    if (address + size > (int)sizeof host->cells)
        abort();
    memcpy(data, host->cells + address, size);
}

static uint32_t noise(void *context)
{
    struct t3_host_robot *host = context;
    host->noise = host->noise * 1664525u + 1013904223u;
    return host->noise;
}

// Locks may not nest: the second unlock would let the interrupt in too early.
static void lock(void *context)
{
    struct t3_host_robot *host = context;
    if (host->locked++)
        abort();
}

static void unlock(void *context)
{
    struct t3_host_robot *host = context;
    if (--host->locked)
        abort();
}

struct t3_host_robot *t3_host_robot_new(void)
{
    struct t3_host_robot *host = calloc(1, sizeof *host);
    if (!host)
        return NULL;
    const struct t3_port port = {
        host, time_us, load_ack, drivers, estop_pressed, imu, adc, eeprom_read, eeprom_write,
        noise, lock, unlock,
    };
    const struct t3_console_port usb = {host, reply, chip_ok, eeprom_settled, eeprom_cells};
    host->port = port;
    host->usb = usb;
    host->chip_ok = true;
    memset(host->eeprom, 0xFF, sizeof host->eeprom);
    memset(host->cells, 0xFF, sizeof host->cells);
    for (uint8_t i = 0; i < CHANNELS; i++)
        host->adc[i] = T3_ADC_NOT_MEASURED;
    host->imu_answers = true;
    host->closest = NEVER;
    const struct t3_radio_settings radio = T3_RADIO_DEFAULTS;
    t3_host_robot_store_settings(host, radio.channel, T3_DEFAULT_MICROSTEPS, radio.address);
    return host;
}

void t3_host_robot_free(struct t3_host_robot *host)
{
    free(host);
}

void t3_host_robot_store_key(struct t3_host_robot *host, const uint8_t *key)
{
    t3_session_store_key(&host->port, key);
    memcpy(host->cells, host->eeprom, sizeof host->cells);
}

static void store_setup(struct t3_host_robot *host, const struct t3_setup *setup)
{
    uint8_t body[T3_SETUP_BODY];
    t3_setup_encode(setup, body);
    struct t3_settings settings;
    const uint32_t cell_us = host->cell_us;
    host->cell_us = 0;  // at once
    t3_settings_boot(&settings, &host->port);
    t3_settings_write(&settings, &host->port, body);
    while (t3_settings_tick(&settings, &host->port, &host->usb) == T3_PROGRESS_NONE)
        ;
    host->cell_us = cell_us;
    host->eeprom_writes = 0;
}

void t3_host_robot_store_settings(struct t3_host_robot *host, uint8_t channel,
                                  uint16_t microsteps, const uint8_t *address)
{
    struct t3_setup setup = T3_SETUP_DEFAULTS;
    setup.channel = channel;
    setup.microsteps = microsteps;
    memcpy(setup.address, address, sizeof setup.address);
    store_setup(host, &setup);
}

void t3_host_robot_store_rate(struct t3_host_robot *host, uint8_t rate)
{
    struct t3_settings settings;
    t3_settings_boot(&settings, &host->port);
    settings.now.rate = rate;
    store_setup(host, &settings.now);
}

void t3_host_robot_erase(struct t3_host_robot *host)
{
    memset(host->eeprom, 0xFF, sizeof host->eeprom);
    memset(host->cells, 0xFF, sizeof host->cells);
}

static void follow_rate(struct t3_host_robot *host)
{
    const bool slow = !host->robot.settings.now.rate;
    host->robot.settle_us = slow ? T3_SETTLE_SLOW_US : T3_SETTLE_US;
}

void t3_host_robot_boot(struct t3_host_robot *host, uint8_t reset_cause, uint32_t start_us)
{
    host->time_us = start_us;
    host->since_tick_us = 0;
    host->moved[T3_LEFT] = host->moved[T3_RIGHT] = 0;
    host->ack_size = 0;
    host->noise = host->first_noise;  // 0 if not set: what hangs on it must still hold
    host->powered = true;  // pins float until the firmware drives them
    memcpy(host->eeprom, host->cells, sizeof host->eeprom);
    host->since_cell_us = 0;
    t3_robot_boot(&host->robot, &host->port, reset_cause, T3_SETTLE_US);
    follow_rate(host);
    t3_console_boot(&host->console, &host->usb, &host->robot);
    host->robot.steps.time_us = start_us;
}

// Return how many payloads were refused, modulo 2**32.
static uint32_t refused(const struct t3_host_robot *host)
{
    const struct t3_counters *counters = &host->robot.counters;
    return (uint32_t)counters->bad_version + counters->malformed + counters->duplicates +
           counters->stale + counters->bad_session;
}

bool t3_host_robot_packet(struct t3_host_robot *host, const uint8_t *data, uint8_t size)
{
    const uint32_t greetings = host->robot.session.greetings, before = refused(host);
    t3_robot_packet(&host->robot, data, size, host->time_us);
    if (host->nonce_forced && host->robot.session.greetings != greetings) {
        memcpy(host->robot.session.robot_nonce, host->nonce, T3_NONCE_SIZE);
        t3_session_derive_key(&host->robot.session);
        host->nonce_forced = false;
    }
    const bool command = size && data[0] == (T3_VERSION << 4 | T3_CMD);
    return command && refused(host) == before && host->robot.ttl_runs;
}

static void watch_wheel(struct t3_host_robot *host, uint8_t wheel, uint8_t pins, uint8_t step,
                        uint8_t back)
{
    if (!(pins & step))
        return;
    // A level that stays high is no second pulse.
    if (host->pins & step)
        return;
    host->hasty += (pins ^ host->pins) & back ? 1 : 0;
    host->unpowered += host->powered ? 0 : 1;
    host->pulses[wheel] += pins & back ? -1 : 1;
    const uint32_t since = (host->ticks - host->last_pulse[wheel]) * T3_TICK_US;
    if (host->last_pulse[wheel] && since < host->closest)
        host->closest = since;
    host->last_pulse[wheel] = host->ticks;
}

static void tick(struct t3_host_robot *host)
{
    struct t3_steps *steps = &host->robot.steps;
    const uint32_t before[] = {steps->wheels[T3_LEFT].phase, steps->wheels[T3_RIGHT].phase};
    const uint8_t pins = t3_steps_tick(steps);
    host->ticks++;
    for (uint8_t i = 0; i < T3_WHEELS; i++) {
        const int32_t turned = (int32_t)(steps->wheels[i].phase - before[i]);
        host->moved[i] += steps->inverted >> i & 1 ? -(int64_t)turned : turned;
    }
    watch_wheel(host, T3_LEFT, pins, T3_PIN_STEP_LEFT, T3_PIN_BACK_LEFT);
    watch_wheel(host, T3_RIGHT, pins, T3_PIN_STEP_RIGHT, T3_PIN_BACK_RIGHT);
    host->pins = pins;
}

static void come_round(struct t3_host_robot *host)
{
    const bool sets = host->console.sets;
    t3_robot_tick(&host->robot);
    t3_console_tick(&host->console);
    host->levels = t3_console_watch(&host->console);
    if (!sets || host->console.sets)
        return;
    host->setups++;
    follow_rate(host);
}

// Whether the main loop has changed what moves the motors since `before` and `powered` were noted.
static bool moves_otherwise(const struct t3_host_robot *host, const int32_t *before, bool powered)
{
    const struct t3_wheel *wheels = host->robot.steps.wheels;
    return powered != host->powered || before[T3_LEFT] != wheels[T3_LEFT].increment ||
           before[T3_RIGHT] != wheels[T3_RIGHT].increment;
}

// Return the time passed: `us`, or less if it ends with the first change of the motion.
static uint32_t pass(struct t3_host_robot *host, uint32_t us, bool stalled, bool to_change)
{
    const struct t3_wheel *wheels = host->robot.steps.wheels;
    uint32_t passed = 0;
    while (passed < us) {
        // On to the next tick, 50 us after the last, whatever the clock reads.
        const uint32_t to_tick = T3_TICK_US - host->since_tick_us;
        const uint32_t step = us - passed < to_tick ? us - passed : to_tick;
        passed += step;
        host->time_us += step;
        host->since_tick_us = (host->since_tick_us + step) % T3_TICK_US;
        if (host->since_tick_us)
            continue;
        tick(host);
        work_eeprom(host, T3_TICK_US);
        if (stalled || host->ticks % (T3_HOST_LOOP_US / T3_TICK_US))
            continue;
        const int32_t before[] = {wheels[T3_LEFT].increment, wheels[T3_RIGHT].increment};
        const bool powered = host->powered;
        come_round(host);
        if (to_change && moves_otherwise(host, before, powered))
            break;
    }
    return passed;
}

void t3_host_robot_run(struct t3_host_robot *host, uint32_t us)
{
    pass(host, us, false, false);
}

void t3_host_robot_stall(struct t3_host_robot *host, uint32_t us)
{
    pass(host, us, true, false);
}

uint32_t t3_host_robot_advance(struct t3_host_robot *host, uint32_t us,
                               struct t3_host_motion *motion)
{
    const uint32_t passed = pass(host, us, false, true);
    const struct t3_wheel *wheels = host->robot.steps.wheels;
    motion->left = (double)host->moved[T3_LEFT] / MICROSTEP;
    motion->right = (double)host->moved[T3_RIGHT] / MICROSTEP;
    host->moved[T3_LEFT] = host->moved[T3_RIGHT] = 0;
    motion->loads = host->loads;
    motion->setups = host->setups;
    motion->usb_size = host->usb_output_size;
    motion->powered = host->powered;
    motion->turning = wheels[T3_LEFT].increment || wheels[T3_RIGHT].increment;
    return passed;
}

void t3_host_robot_poke_time(struct t3_host_robot *host, uint32_t to_us)
{
    struct t3_robot *robot = &host->robot;
    const uint32_t by = to_us - host->time_us;
    host->time_us = to_us;
    robot->steps.time_us += by;
    robot->period_us += by;
    robot->tick_us += by;
    host->console.log.second_us += by;
    host->console.signal.boot_us += by;
    host->console.signal.step_us += by;
    robot->rest_us += by;
    robot->ttl_from_us += by;
    robot->command_us += by;
    robot->last_frame_us += by;
    robot->answer_from_us += by;
    robot->loaded_us += by;
    robot->button_us += by;
    robot->battery_us += by;
}

uint32_t t3_host_robot_time(const struct t3_host_robot *host)
{
    return host->time_us;
}

uint8_t t3_host_robot_ack(const struct t3_host_robot *host, uint8_t *to)
{
    memcpy(to, host->ack, host->ack_size);
    return host->ack_size;
}

uint32_t t3_host_robot_loads(const struct t3_host_robot *host)
{
    return host->loads;
}

uint8_t t3_host_robot_status(const struct t3_host_robot *host)
{
    return t3_robot_status(&host->robot);
}

uint8_t t3_host_robot_session(const struct t3_host_robot *host)
{
    return host->robot.session.id;
}

uint16_t t3_host_robot_stale(const struct t3_host_robot *host)
{
    return host->robot.counters.stale;
}

uint16_t t3_host_robot_microsteps(const struct t3_host_robot *host)
{
    return host->robot.microsteps;
}

uint8_t t3_host_robot_channel(const struct t3_host_robot *host)
{
    return host->robot.settings.now.channel;
}

uint8_t t3_host_robot_rate(const struct t3_host_robot *host)
{
    return host->robot.settings.now.rate;
}

void t3_host_robot_address(const struct t3_host_robot *host, uint8_t *five)
{
    memcpy(five, host->robot.settings.now.address, sizeof host->robot.settings.now.address);
}

bool t3_host_robot_powered(const struct t3_host_robot *host)
{
    return host->powered;
}

int32_t t3_host_robot_pulses(const struct t3_host_robot *host, uint8_t wheel)
{
    return host->pulses[wheel];
}

int32_t t3_host_robot_steps(const struct t3_host_robot *host, uint8_t wheel)
{
    return host->robot.steps.wheels[wheel].count;
}

void t3_host_robot_poke_steps(struct t3_host_robot *host, uint8_t wheel, int32_t count)
{
    host->robot.steps.wheels[wheel].count = count;
}

int32_t t3_host_robot_speed(const struct t3_host_robot *host, uint8_t wheel)
{
    return host->robot.ramp.speed[wheel];
}

uint32_t t3_host_robot_closest_pulses(const struct t3_host_robot *host)
{
    return host->closest;
}

uint32_t t3_host_robot_unpowered_pulses(const struct t3_host_robot *host)
{
    return host->unpowered;
}

uint32_t t3_host_robot_hasty_pulses(const struct t3_host_robot *host)
{
    return host->hasty;
}

uint32_t t3_host_robot_eeprom_writes(const struct t3_host_robot *host)
{
    return host->eeprom_writes;
}

void t3_host_robot_poke_eeprom(struct t3_host_robot *host, uint16_t address, uint8_t value)
{
    if (address < sizeof host->eeprom)
        host->eeprom[address] = host->cells[address] = value;
}

uint8_t t3_host_robot_cell(const struct t3_host_robot *host, uint16_t address)
{
    return address < sizeof host->cells ? host->cells[address] : 0;
}

void t3_host_robot_set_cell_us(struct t3_host_robot *host, uint32_t us)
{
    host->cell_us = us;
}

void t3_host_robot_wear(struct t3_host_robot *host, uint16_t address, bool worn)
{
    if (address < sizeof host->worn)
        host->worn[address] = worn;
}

void t3_host_robot_usb(struct t3_host_robot *host, const uint8_t *data, uint32_t size)
{
    for (uint32_t i = 0; i < size; i++)
        t3_console_byte(&host->console, data[i]);
}

uint32_t t3_host_robot_usb_take(struct t3_host_robot *host, uint8_t *to, uint32_t room)
{
    const uint32_t size = host->usb_output_size < room ? host->usb_output_size : room;
    memcpy(to, host->usb_output, size);
    host->usb_output_size -= size;
    memmove(host->usb_output, host->usb_output + size, host->usb_output_size);
    return size;
}

bool t3_host_robot_changing(const struct t3_host_robot *host)
{
    return host->console.step != T3_KEY_RESTS || host->console.sets ||
           host->console.tx != T3_TX_RESTS;
}

bool t3_host_robot_writing(const struct t3_host_robot *host)
{
    return t3_console_writes(&host->console);
}

void t3_host_robot_usb_overrun(struct t3_host_robot *host)
{
    t3_console_overrun(&host->console);
}

uint8_t t3_host_robot_levels(const struct t3_host_robot *host)
{
    return host->levels;
}

void t3_host_robot_set_chip(struct t3_host_robot *host, bool ok)
{
    host->chip_ok = ok;
}

void t3_host_robot_press(struct t3_host_robot *host, bool pressed)
{
    host->pressed = pressed;
}

void t3_host_robot_set_imu(struct t3_host_robot *host, bool answers, const int16_t *seven)
{
    const struct t3_imu sample = {seven[0], seven[1], seven[2], seven[3],
                                  seven[4], seven[5], seven[6]};
    host->imu_answers = answers;
    host->imu = sample;
}

void t3_host_robot_set_adc(struct t3_host_robot *host, uint8_t channel, uint16_t count)
{
    if (channel < CHANNELS)
        host->adc[channel] = count;
}

int16_t *t3_host_robot_imu(struct t3_host_robot *host)
{
    return &host->imu.accel_x;  // the first of seven of one type
}

uint16_t *t3_host_robot_adcs(struct t3_host_robot *host)
{
    return host->adc;
}

void t3_host_robot_set_noise(struct t3_host_robot *host, uint32_t noise)
{
    host->first_noise = noise;
}

void t3_host_robot_force_nonce(struct t3_host_robot *host, const uint8_t *nonce)
{
    memcpy(host->nonce, nonce, T3_NONCE_SIZE);
    host->nonce_forced = true;
}
