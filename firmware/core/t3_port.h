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

// Hardware interface of the portable core. Host tests and boards implement these callbacks. The core
// never blocks: each callback returns at once.
#ifndef T3_PORT_H
#define T3_PORT_H

#include <stdbool.h>
#include <stdint.h>

// Newest sample of the MPU6050, as raw register values.
struct t3_imu {
    int16_t accel_x, accel_y, accel_z;
    int16_t temperature;
    int16_t gyro_x, gyro_y, gyro_z;
};

// Channels of `adc`: 0 to 7 are the range sensors (front L, R, left F, B, rear L, R,
// right F, B).
#define T3_ADC_BATTERY 8u
// Not counts of the converter, which are at most 1023.
#define T3_ADC_NOT_MEASURED 0xFFFFu
#define T3_ADC_FAULT 0xFFFEu

// Hardware of the robot. Step and direction pins are not here: t3_steps_tick returns their levels.
struct t3_port {
    void *context;  // passed to every callback
    // Microseconds since boot, modulo 2**32 (t3_steps.h has what a timer needs for that).
    uint32_t (*time_us)(void *context);
    // FLUSH_TX, then exactly one W_ACK_PAYLOAD: with two queued payloads all later telemetry is late.
    void (*load_ack)(void *context, const uint8_t *payload, uint8_t size);
    // Power of both stepper drivers.
    void (*drivers)(void *context, bool on);
    bool (*estop_pressed)(void *context);
    // Newest sample; false while the sensor does not respond.
    bool (*imu)(void *context, struct t3_imu *sample);
    // Newest 10-bit count of a channel.
    uint16_t (*adc)(void *context, uint8_t channel);
    void (*eeprom_read)(void *context, uint16_t address, uint8_t *data, uint8_t size);
    void (*eeprom_write)(void *context, uint16_t address, const uint8_t *data, uint8_t size);
    // Unpredictable bits (converter noise, timer jitter); used for nonces only.
    uint32_t (*noise)(void *context);
    // Disable and enable the step interrupt around accesses to the counters.
    void (*lock)(void *context);
    void (*unlock)(void *context);
};

// USB console of the robot. The cells requested by eeprom_write of t3_port become visible one at a
// time.
struct t3_console_port {
    void *context;
    // Bytes for the USB side, a whole frame at a time.
    void (*reply)(void *context, const uint8_t *wire, uint8_t size);
    // Whether the radio chip holds its configuration.
    bool (*chip_ok)(void *context);
    // Whether all EEPROM writes are complete.
    bool (*eeprom_settled)(void *context);
    // Read the cells themselves, not the requested values.
    void (*eeprom_cells)(void *context, uint16_t address, uint8_t *data, uint8_t size);
};

// Configuration of the radio chip, with the fields of a CFG frame.
struct t3_radio_settings {
    uint8_t channel;      // 2400 MHz + this
    uint8_t rate;         // 0: 250 kbit/s, 1: 1 Mbit/s, 2: 2 Mbit/s
    uint8_t power;        // 0: -18 dBm, 1: -12, 2: -6, 3: 0
    uint8_t retry_delay;  // (this + 1) 250 us
    uint8_t retries;
    uint8_t address[5];  // lowest first
};

// Of a dongle before CFG, and of a robot without settings (t3_settings.h); build options of both
// boards (make avr RADIO_RATE=0 RADIO_CHANNEL=100).
#ifndef T3_RADIO_CHANNEL
#define T3_RADIO_CHANNEL 82
#endif
#ifndef T3_RADIO_RATE
#define T3_RADIO_RATE 1
#endif
#if T3_RADIO_CHANNEL < 0 || T3_RADIO_CHANNEL > 125 || T3_RADIO_RATE < 0 || T3_RADIO_RATE > 2
#error "RADIO_CHANNEL is 0 to 125, RADIO_RATE 0 (250 kbit/s), 1 or 2 (Mbit/s)"
#endif
// A shorter delay cuts off acknowledgements of 32 bytes at 250 kbit/s (data sheet 7.4.2).
#define T3_RETRY_DELAY_AT(rate) ((rate) == 0 ? 5u : 1u)
#define T3_RETRY_DELAY T3_RETRY_DELAY_AT(T3_RADIO_RATE)
// Defaults of both ends: CFG changes those of the dongle, settings those of the robot.
#define T3_RADIO_DEFAULTS                                                                         \
    {T3_RADIO_CHANNEL, T3_RADIO_RATE, 3, T3_RETRY_DELAY, 4, {'T', '3', 'M', 'P', 'C'}}
#define T3_DEFAULT_MICROSTEPS 16u

// Hardware of the dongle. The radio ends each `send` with one call of t3_dongle_exchange.
struct t3_dongle_port {
    void *context;
    uint32_t (*time_us)(void *context);
    // Bytes for the USB side, a whole frame at a time.
    void (*reply)(void *context, const uint8_t *wire, uint8_t size);
    void (*send)(void *context, const uint8_t *payload, uint8_t size);
    // Configure the chip; false if it does not hold the written values.
    bool (*configure)(void *context, const struct t3_radio_settings *settings);
};

#endif
