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

// The robot: t3_robot.c between the radio chip, two stepper drivers and the sensors; t3_console.c
// on its USB.
#include <avr/interrupt.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <string.h>
#include <util/atomic.h>
#include <util/delay.h>

#include "analog.h"
#include "board.h"
#include "imu.h"
#include "memory.h"
#include "nrf24.h"
#include "reset.h"
#include "serial.h"
#include "stepping.h"
#include "t3_console.h"
#include "t3_robot.h"

// Silence after which the configuration of the chip is checked.
#define RADIO_CHECK_US UINT32_C(500000)
// Period at which the RX FIFO is checked. Full, with its flag clear, it raises no interrupt any more,
// and the chip acknowledges nothing.
#define FIFO_CHECK_US UINT32_C(5000)

// The answer is sampled at once; then it waits for a quiet moment of the radio.
#define SETTLE_US 0u
#define COPIES 4u
#define WAIT_US 200u  // for this long the main loop stands still rather than miss the moment
#define FLUSH_US 110u // what the flush takes, with the interrupts that may come meanwhile

static struct t3_radio_settings radio = T3_RADIO_DEFAULTS;  // what may differ: of the settings
static uint16_t ack_us;  // of the rate; see air_us
static volatile bool radio_interrupt;  // set by the interrupt of the radio
static volatile uint32_t arrived_us;
static uint32_t checked_us, fifo_checked_us;
static bool waking;
static uint8_t packet_size;  // of the last packet, and when it came
static uint32_t packet_us;
static uint8_t answer[T3_RADIO_LIMIT], answer_size;  // waits for its moment
static bool chip_held;  // whether the radio chip held its settings at the last check
static struct t3_console console;

// Of the bytes from USB no more are looked at in one round, and none for a while after a frame, whose
// reply takes time. The line can bring more: of a flood most is lost, and nothing else is late.
#define SERIAL_SHARE 8u
#define FRAME_PAUSE_US UINT32_C(2000)

ISR(RADIO_IRQ_VECTOR)
{
    if (!radio_interrupt)
        arrived_us = stepping_time_us();
    radio_interrupt = true;
}

// -- the core's port -----------------------------------------------------------------------------

static uint32_t time_us(void *context)
{
    (void)context;
    return stepping_time_us();
}

static void load_answer(void);

static void load_ack(void *context, const uint8_t *payload, uint8_t size)
{
    (void)context;
    memcpy(answer, payload, size);
    answer_size = size;
    load_answer();  // the rest of the tick may take longer than the window that is open now
}

static void drivers(void *context, bool on)
{
    (void)context;
    stepping_power(on);
}

static bool estop_pressed(void *context)
{
    (void)context;
    return ESTOP_PRESSED;
}

static bool imu(void *context, struct t3_imu *sample)
{
    (void)context;
    return imu_sample(sample);
}

static uint16_t adc(void *context, uint8_t channel)
{
    (void)context;
    return analog_count(channel);
}

static void eeprom_read(void *context, uint16_t address, uint8_t *data, uint8_t size)
{
    (void)context;
    memory_read(address, data, size);
}

static void eeprom_write(void *context, uint16_t address, const uint8_t *data, uint8_t size)
{
    (void)context;
    memory_write(address, data, size);
}

static uint32_t noise(void *context)
{
    (void)context;
    return analog_noise();
}

static void lock(void *context)
{
    (void)context;
    stepping_lock();
}

static void unlock(void *context)
{
    (void)context;
    stepping_unlock();
}

// -- the console's port --------------------------------------------------------------------------

static void reply(void *context, const uint8_t *wire, uint8_t size)
{
    (void)context;
    serial_write(wire, size);
}

static bool chip_ok(void *context)
{
    (void)context;
    return chip_held;
}

static bool eeprom_settled(void *context)
{
    (void)context;
    return memory_settled();
}

static void eeprom_cells(void *context, uint16_t address, uint8_t *data, uint8_t size)
{
    (void)context;
    memory_cells(address, data, size);
}

static void serve_console(void)
{
    static uint32_t frame_us;
    const uint32_t now_us = stepping_time_us();
    const bool pauses = now_us - frame_us < FRAME_PAUSE_US;
    uint8_t byte;
    for (uint8_t i = 0; !pauses && i < SERIAL_SHARE && serial_take(&byte); i++) {
        if (t3_console_byte(&console, byte)) {
            frame_us = now_us;
            break;
        }
    }
    for (uint8_t count = serial_lost(); count; count--)
        t3_console_overrun(&console);
    t3_console_tick(&console);
}

// Every 6 ms: an eye sees 0.1 s, and a pass has 0.4 ms.
static void show_signal(void)
{
    static uint8_t passes;
    if (++passes % 16u)
        return;
    const uint8_t levels = t3_console_watch(&console);
    if (levels & T3_SIGNAL_LED)
        SIGNAL_PORT |= _BV(SIGNAL_LED);
    else
        SIGNAL_PORT &= (uint8_t)~_BV(SIGNAL_LED);
    if (levels & T3_SIGNAL_BUZZER)
        SIGNAL_PORT |= _BV(SIGNAL_BUZZER);
    else
        SIGNAL_PORT &= (uint8_t)~_BV(SIGNAL_BUZZER);
}

// -- radio ---------------------------------------------------------------------------------------

// Return what n bytes take in the air: preamble 1, address 5, CRC 2, control 9 bit.
static uint16_t air_us(uint8_t bytes)
{
    return (uint16_t)((8u * (8u + bytes) + 9u) * 4u >> (radio.rate ? 1u + radio.rate : 0u));
}

// Return how far apart the ends of two copies of a packet lie. When an acknowledgement was lost, the
// dongle sends the packet again one retry delay after it, and so on; the robot receives only the first.
static uint16_t copies_us(uint8_t bytes)
{
    return (uint16_t)(250u * (T3_RETRY_DELAY_AT(radio.rate) + 1u) + air_us(bytes));
}

static bool settings_differ(void)
{
    const struct t3_setup *now = &robot.settings.now;
    return radio.channel != now->channel || radio.rate != now->rate ||
           radio.power != now->power || memcmp(radio.address, now->address, 5);
}

static void configure_radio(uint32_t now_us)
{
    const struct t3_setup *now = &robot.settings.now;
    radio.channel = now->channel;
    radio.rate = now->rate;
    radio.power = now->power;
    memcpy(radio.address, now->address, 5);
    // An acknowledgement of 32 bytes is over so long after its packet (settling 130 us, and 3 for the
    // clocks).
    ack_us = (uint16_t)(130u + air_us(T3_RADIO_LIMIT) + 3u);
    chip_held = nrf24_configure(&radio, NRF24_PRX, &waking);
    if (!waking)
        nrf24_listen();
    checked_us = now_us;
}

static void receive(void)
{
    uint32_t at_us = stepping_time_us();
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (radio_interrupt)
            at_us = arrived_us;
        radio_interrupt = false;
    }
    // Flags first: a packet that comes while the FIFO is read raises them again.
    nrf24_clear_status();
    uint8_t payload[T3_RADIO_LIMIT];
    for (uint8_t i = 0; i < NRF24_DEPTH; i++) {
        const uint8_t size = nrf24_read(payload);
        if (!size)
            return;
        answer_size = 0;  // the packet asks for a newer one
        packet_size = size;
        packet_us = checked_us = at_us;
        t3_robot_packet(&robot, payload, size, at_us);
    }
}

// Return how long the last packet, or the copy of it that may have come since, is past.
static uint16_t since_copy_us(uint16_t copy_us)
{
    uint32_t since_us = stepping_time_us() - packet_us;
    for (uint8_t i = 0; i < COPIES && since_us > copy_us; i++)
        since_us -= copy_us;
    return since_us < UINT16_MAX ? (uint16_t)since_us : UINT16_MAX;
}

// Return whether no acknowledgement that uses the loaded payload is being sent.
static bool is_quiet(void)
{
    const uint16_t copy_us = copies_us(packet_size);
    uint16_t since_us = since_copy_us(copy_us);
    while (since_us >= ack_us - WAIT_US && since_us < ack_us)
        since_us = since_copy_us(copy_us);
    return since_us > copy_us || (since_us >= ack_us && since_us + FLUSH_US <= copy_us);
}

static void load_answer(void)
{
    // A packet that came since the last look at the radio is being acknowledged with what is loaded.
    if (!answer_size || !is_quiet() || radio_interrupt)
        return;
    nrf24_load_ack(answer, answer_size);
    answer_size = 0;
}

static void watch_radio(void)
{
    const uint32_t now_us = stepping_time_us();
    bool waits = radio_interrupt || !RADIO_IRQ_HIGH;  // the pin too: an edge may be missed
    if (!waits && now_us - fifo_checked_us >= FIFO_CHECK_US) {
        fifo_checked_us = now_us;
        waits = nrf24_rx_waiting();
    }
    if (waits)
        receive();
    const uint32_t since_us = now_us - checked_us;
    if (waking && since_us >= NRF24_WAKE_US) {
        waking = false;
        nrf24_listen();
    } else if (settings_differ()) {
        configure_radio(now_us);
    } else if (since_us >= RADIO_CHECK_US) {
        checked_us = now_us;
        chip_held = nrf24_holds(&radio, NRF24_PRX);
        if (!chip_held)
            configure_radio(now_us);
    }
}

// -- main ----------------------------------------------------------------------------------------

// Any interrupt is reason enough to go round while an answer has to be made or loaded in time.
static bool hurries(void)
{
    return robot.answer_waits || answer_size;
}

static uint8_t postponed;  // passes in a row without sensors, EEPROM and USB
#define POSTPONED_LIMIT 6u

// Return whether a pass of the main loop is due.
static bool sleep_until_due(void)
{
    for (bool slept = false;; slept = true) {
        cli();
        const bool due = stepping_due();
        if (due || radio_interrupt || (slept && hurries())) {
            sei();
            return due;
        }
        sleep_enable();
        sei();  // the next instruction is executed before any interrupt: none is slept through
        sleep_cpu();
        sleep_disable();
    }
}

int main(void)
{
    static const struct t3_port port = {
        0,   time_us,     load_ack,     drivers, estop_pressed, imu,
        adc, eeprom_read, eeprom_write, noise,   lock,          unlock,
    };
    static const struct t3_console_port usb = {0, reply, chip_ok, eeprom_settled, eeprom_cells};
    stepping_pins();
    wdt_enable(WDTO_120MS);
    memory_start();
    nrf24_start();
    SIGNAL_DDR |= _BV(SIGNAL_LED) | _BV(SIGNAL_BUZZER);
    analog_start();
    imu_start();
    // The radio needs this after power; the converter gathers its first counts, and noise.
    for (uint16_t waits = 0; waits < NRF24_POWER_ON_MS * 10u; waits++) {
        wdt_reset();
        analog_work();
        _delay_us(100);
    }
    t3_robot_boot(&robot, &port, reset_cause, SETTLE_US);
    t3_console_boot(&console, &usb, &robot);
    serial_start();
    stepping_start();
    sei();
    configure_radio(stepping_time_us());
    for (;;) {
        const bool due = sleep_until_due();
        watch_radio();
        load_answer();
        if (due || robot.answer_waits)
            t3_robot_tick(&robot);
        if (!due)
            continue;
        wdt_reset();
        // An answer has windows of 0.2 ms to be loaded in: the rest waits, but not for ever if packets
        // keep coming.
        if (hurries() && ++postponed < POSTPONED_LIMIT)
            continue;
        postponed = 0;
        analog_work();
        memory_work();
        imu_work(stepping_time_us());
        show_signal();
        if (!hurries() && (serial_waits() || t3_console_waits(&console)))
            serve_console();
    }
}
