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

// One long story through the whole core, and a checksum of everything it did. Built for the host
// and for the AVR it must print the same: an int of 16 bits shows nowhere. On the AVR it also
// prints how many cycles the costly parts take.

#include <stdbool.h>
#include <string.h>

#include "t3_bytes.h"
#include "t3_console.h"
#include "t3_dongle.h"
#include "t3_robot.h"
#include "t3_sensors.h"
#include "t3_store.h"

#define PACKETS 750u
#define SESSION 0x5Au

// -- where it runs -------------------------------------------------------------------------------

#ifdef __AVR__

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>

static void put(char character)
{
    while (!(UCSR0A & (1 << UDRE0)))
        ;
    UDR0 = (uint8_t)character;
}

static void begin(void)
{
    UCSR0B = 1 << TXEN0;
    TCCR1B = 1 << CS11;  // counts eight cycles each
}

static void end(void)
{
    cli();
    sleep_enable();
    for (;;)
        sleep_cpu();  // which ends the simulation
}

static void start_clock(void)
{
    TCNT1 = 0;
}

static uint32_t cycles(void)
{
    return (uint32_t)TCNT1 * 8;
}

#else

#include <stdio.h>

static void put(char character)
{
    putchar(character);
}

static void begin(void)
{
}

static void end(void)
{
}

static void start_clock(void)
{
}

static uint32_t cycles(void)
{
    return 0;
}

#endif

static void say(const char *text, uint32_t number)
{
    char digits[11];
    uint8_t at = sizeof digits;
    while (*text)
        put(*text++);
    put(' ');
    digits[--at] = 0;
    do
        digits[--at] = (char)('0' + number % 10);
    while (number /= 10);
    for (const char *digit = digits + at; *digit; digit++)
        put(*digit);
    put('\n');
}

// -- inputs and outputs --------------------------------------------------------------------------

static uint32_t now_us = 0xFFF00000u;  // wraps within the story
static uint32_t drawn = 1;
static uint32_t checksum;
static bool measuring;  // what stands in for hardware then costs next to nothing
static uint8_t eeprom[T3_STORE_END];

static uint32_t draw(void)
{
    drawn = drawn * UINT32_C(1664525) + UINT32_C(1013904223);
    return drawn >> 8;
}

static void note(uint32_t number)
{
    if (measuring)
        return;
    checksum = (checksum << 5 | checksum >> 27) ^ number;
    checksum *= UINT32_C(0x9E3779B1);
}

static void note_bytes(const uint8_t *data, uint16_t size)
{
    note(size);
    while (size--)
        note(*data++);
}

static uint32_t time_us(void *context)
{
    (void)context;
    return now_us;
}

static void load_ack(void *context, const uint8_t *payload, uint8_t size)
{
    (void)context;
    note_bytes(payload, size);
}

static void drivers(void *context, bool on)
{
    (void)context;
    note(on);
}

static bool estop_pressed(void *context)
{
    (void)context;
    return false;
}

static bool imu(void *context, struct t3_imu *sample)
{
    (void)context;
    sample->gyro_z = t3_signed16((uint16_t)now_us);
    sample->accel_x = -1;
    sample->accel_y = INT16_MIN;
    sample->temperature = INT16_MAX;
    return measuring || now_us % 7 != 0;
}

static uint16_t adc(void *context, uint8_t channel)
{
    (void)context;
    if (measuring)
        return 300;
    if (channel == T3_ADC_BATTERY)
        return (uint16_t)(700 + now_us / 16 % 300);  // low at times, never below the cut-off
    return (uint16_t)((now_us / 16 + channel * 111u) % 1030u);
}

static void eeprom_read(void *context, uint16_t address, uint8_t *data, uint8_t size)
{
    (void)context;
    memcpy(data, eeprom + address, size);
}

static void eeprom_write(void *context, uint16_t address, const uint8_t *data, uint8_t size)
{
    (void)context;
    memcpy(eeprom + address, data, size);
}

static uint32_t noise(void *context)
{
    (void)context;
    return draw();
}

static void ignore(void *context)
{
    (void)context;
}

static const struct t3_port PORT = {
    NULL, time_us, load_ack, drivers, estop_pressed, imu, adc, eeprom_read, eeprom_write,
    noise, ignore, ignore,
};

static void reply(void *context, const uint8_t *wire, uint8_t size)
{
    (void)context;
    note_bytes(wire, size);
}

static void send(void *context, const uint8_t *payload, uint8_t size)
{
    (void)context;
    note_bytes(payload, size);
}

static bool configure(void *context, const struct t3_radio_settings *settings)
{
    (void)context;
    note(settings->channel);
    return true;
}

static bool chip_ok(void *context)
{
    (void)context;
    return true;
}

static bool eeprom_settled(void *context)
{
    (void)context;
    return draw() % 3 == 0;
}

static const struct t3_console_port CONSOLE_PORT = {NULL, reply, chip_ok, eeprom_settled,
                                                    eeprom_read};
static const struct t3_dongle_port DONGLE_PORT = {NULL, time_us, reply, send, configure};

// -- the story -----------------------------------------------------------------------------------

static struct t3_robot robot;
static struct t3_dongle dongle;
static uint8_t seq;
static uint32_t epoch, signed_us;

#define HEADER (T3_VERSION << 4)

static uint8_t sign(uint8_t *data, uint8_t size)
{
    uint8_t text[T3_RADIO_LIMIT + 4];
    if (!robot.session.keyed)
        return size;
    memcpy(text, data, size);
    t3_put32(text + size, epoch);
    t3_siphash(robot.session.session_key, text, (uint8_t)(size + 4), data + size);
    return (uint8_t)(size + T3_TAG_SIZE);
}

static uint8_t hello(uint8_t *data)
{
    data[0] = HEADER | T3_HELLO;
    data[1] = SESSION;
    data[2] = ++seq;
    data[3] = robot.session.keyed;
    epoch = 0;
    signed_us = now_us;
    if (!robot.session.keyed)
        return 4;
    t3_put32(data + 4, now_us);
    t3_put32(data + 8, draw());
    t3_put32(data + 12, draw());
    uint8_t text[17];
    text[0] = 1;  // this use of the key: a HELLO
    memcpy(text + 1, data, 16);
    t3_siphash(robot.session.key, text, sizeof text, data + 16);
    return 24;
}

static uint8_t command(uint8_t *data)
{
    data[0] = HEADER | T3_CMD;
    data[1] = SESSION;
    data[2] = ++seq;
    data[3] = robot.estop ? T3_FLAG_ESTOP_CLEAR : T3_FLAG_ENABLE;
    data[4] = (uint8_t)(draw() % 30);
    data[5] = 0;
    t3_put16(data + 6, robot.estop ? 0 : (uint16_t)draw());
    t3_put16(data + 8, robot.estop ? 0 : (uint16_t)draw());
    t3_put32(data + 10, now_us - draw() % 300000);
    epoch += now_us < signed_us;
    signed_us = now_us;
    t3_put32(data + T3_CMD_SIZE, now_us);
    return sign(data, robot.session.keyed ? T3_CMD_SIZE + 4 : T3_CMD_SIZE);
}

static uint8_t request(uint8_t *data)
{
    static const uint8_t KINDS[] = {T3_PARAM_GET, T3_PARAM_SET, T3_POLL, T3_ACTION};
    static const uint8_t SIZES[] = {4, 8, 4, 6};
    const uint8_t which = (uint8_t)(draw() % 4);
    memset(data, 0, T3_RADIO_LIMIT);
    data[0] = (uint8_t)(HEADER | KINDS[which]);
    data[1] = SESSION;
    data[2] = ++seq;
    data[3] = (uint8_t)(draw() % (which == 2 ? 3 : 11));
    if (which == 1)
        t3_put32(data + 4, draw() % 40000);
    return SIZES[which];
}

static uint8_t nonsense(uint8_t *data)
{
    for (uint8_t i = 0; i < T3_RADIO_LIMIT; i++)
        data[i] = (uint8_t)draw();
    data[0] = (uint8_t)(HEADER | (data[0] & 7));
    return (uint8_t)(draw() % 33);
}

static uint8_t next(uint8_t *data)
{
    const uint8_t kind = (uint8_t)(draw() % 16);
    if (!robot.session.id || kind == 15)
        return hello(data);
    return kind < 12 ? command(data) : kind < 14 ? request(data) : nonsense(data);
}

static void pass(uint32_t us)
{
    for (uint32_t passed = 0; passed < us; passed += T3_TICK_US) {
        now_us += T3_TICK_US;
        note(t3_steps_tick(&robot.steps));
        if (passed % 1000 == 0)
            t3_robot_tick(&robot);
    }
    note((uint32_t)robot.ramp.speed[T3_LEFT]);
    note((uint32_t)robot.ramp.speed[T3_RIGHT]);
    note((uint32_t)robot.steps.wheels[T3_LEFT].increment);
}

static void store_settings(void)
{
    static const struct t3_setup setup = T3_SETUP_DEFAULTS;
    uint8_t body[T3_SETUP_BODY];
    t3_setup_encode(&setup, body);
    struct t3_settings settings;
    t3_settings_boot(&settings, &PORT);
    t3_settings_write(&settings, &PORT, body);
    while (t3_settings_tick(&settings, &PORT, &CONSOLE_PORT) == T3_PROGRESS_NONE)
        ;
    note_bytes(eeprom, sizeof eeprom);
}

static void live(bool keyed)
{
    uint8_t data[T3_RADIO_LIMIT + T3_TAG_SIZE];
    uint8_t key[T3_KEY_SIZE];
    memset(key, 0x3C, sizeof key);
    memset(eeprom, 0xFF, sizeof eeprom);
    store_settings();
    if (keyed)
        t3_session_store_key(&PORT, key);
    t3_robot_boot(&robot, &PORT, 1, T3_SETTLE_US);
    uint16_t moved = 0;
    for (uint16_t i = 0; i < PACKETS; i++) {
        t3_robot_packet(&robot, data, next(data), now_us);
        pass(draw() % 4 * 1000);
        moved = (uint16_t)(moved + t3_ramp_moving(&robot.ramp));
    }
    say(keyed ? "moving, keyed" : "moving, open", moved);
}

static void relay(void)
{
    t3_dongle_boot(&dongle, &DONGLE_PORT, 1);
    for (uint16_t i = 0; i < PACKETS; i++) {
        uint8_t frame[T3_FRAME_LIMIT], wire[T3_WIRE_LIMIT];
        const uint8_t size = (uint8_t)(1 + draw() % T3_FRAME_LIMIT);
        for (uint8_t j = 0; j < size; j++)
            frame[j] = (uint8_t)draw();
        frame[0] = (uint8_t)(draw() % 4);
        frame[3] = (uint8_t)(draw() % 33);
        const uint8_t length = t3_to_wire(frame, size, wire);
        if (draw() % 5 == 0)
            wire[draw() % length] ^= (uint8_t)(1u << draw() % 8);
        for (uint8_t j = 0; j < length; j++)
            t3_dongle_byte(&dongle, wire[j]);
        const uint8_t answered = (uint8_t)(draw() % 34);
        t3_dongle_exchange(&dongle, draw() % 3 != 0, (uint8_t)draw(), wire, answered);
        now_us += draw() % 70000;
        t3_dongle_tick(&dongle);
    }
    say("good frames", dongle.splitter.frames);
}

// Pings, questions, keys, settings and nonsense over the robot's own USB.
static void wire_up(void)
{
    static struct t3_console console;
    memset(eeprom, 0xFF, sizeof eeprom);
    t3_robot_boot(&robot, &PORT, 1, T3_SETTLE_US);
    t3_console_boot(&console, &CONSOLE_PORT, &robot);
    for (uint16_t i = 0; i < PACKETS; i++) {
        static const uint8_t SIZES[] = {6, 2, 18, 5, 10};
        uint8_t frame[T3_FRAME_LIMIT], wire[T3_WIRE_LIMIT];
        for (uint8_t j = 0; j < sizeof frame; j++)
            frame[j] = (uint8_t)draw();
        frame[0] = (uint8_t)(3 + draw() % 3);
        if (draw() % 2)
            t3_put16(frame + 3, (uint16_t)(1u << draw() % 9));  // possible microsteps
        const uint8_t length = t3_to_wire(frame, SIZES[draw() % 5], wire);
        for (uint8_t j = 0; j < length; j++)
            t3_console_byte(&console, wire[j]);
        now_us += 200;
        t3_robot_tick(&robot);
        t3_console_tick(&console);
        note_bytes(eeprom, sizeof eeprom);
    }
    say("frames over USB", console.splitter.frames);
}

// Zeros on the host: it counts no cycles.
static void measure(void)
{
    uint8_t data[T3_RADIO_LIMIT + T3_TAG_SIZE], tag[T3_TAG_SIZE];
    uint32_t signing, taking, idling, moving, loading, stepping, standing;
    drawn = 1;
    live(true);
    t3_robot_packet(&robot, data, hello(data), now_us);
    pass(200000);
    measuring = true;
    start_clock();
    t3_siphash(robot.session.key, data, T3_CMD_SIZE + 8, tag);
    signing = cycles();
    const uint8_t size = command(data);
    start_clock();
    t3_robot_packet(&robot, data, size, now_us);
    taking = cycles();
    t3_robot_tick(&robot);
    robot.period_us = now_us;
    now_us += 200;
    start_clock();
    t3_robot_tick(&robot);
    idling = cycles();
    robot.ramp.target[T3_LEFT] = 9000000;
    robot.ramp.target[T3_RIGHT] = -7000001;
    robot.period_us = now_us - 1000;
    start_clock();
    t3_robot_tick(&robot);
    moving = cycles();
    now_us += 400;
    start_clock();
    t3_robot_tick(&robot);
    loading = cycles();
    start_clock();
    for (uint8_t i = 0; i < 100; i++)
        t3_steps_tick(&robot.steps);
    stepping = cycles() / 100;
    robot.steps.wheels[T3_LEFT].increment = robot.steps.wheels[T3_RIGHT].increment = 0;
    start_clock();
    for (uint8_t i = 0; i < 100; i++)
        t3_steps_tick(&robot.steps);
    standing = cycles() / 100;
    say("cycles of a tag", signing);
    say("cycles of a signed CMD", taking);
    say("cycles of an idle round", idling);
    say("cycles of a round with ramp", moving);
    say("cycles of a round with STATE", loading);
    say("cycles of a stepping tick", stepping);
    say("cycles of a tick at rest", standing);
}

int main(void)
{
    begin();
    live(false);
    live(true);
    relay();
    wire_up();
    for (uint16_t count = 0; count < 1030; count++)
        note(t3_range_code(count) + t3_battery_mv(count));
    say("checksum", checksum);
    measure();
    end();
    return 0;
}
