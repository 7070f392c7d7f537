// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Everything the portable core asks of the hardware. A host test fills in these callbacks; on a
// board they are a few lines over registers. The core never waits: each callback returns at once.
#ifndef T3_PORT_H
#define T3_PORT_H

#include <stdbool.h>
#include <stdint.h>

// What the MPU6050 last measured, as its registers hold it.
struct t3_imu {
    int16_t accel_x, accel_y, accel_z;
    int16_t temperature;
    int16_t gyro_x, gyro_y, gyro_z;
};

// Channels of `adc`: 0 to 7 are the distance sensors (front L, R, left F, B, rear L, R,
// right F, B).
#define T3_ADC_BATTERY 8u
// A count of the converter is at most 1023; these are none.
#define T3_ADC_NOT_MEASURED 0xFFFFu
#define T3_ADC_FAULT 0xFFFEu

// The robot's hardware. Step and direction pins are not here: t3_steps_tick returns their levels.
struct t3_port {
    void *context;  // handed to every callback
    // Microseconds since boot, modulo 2**32 (t3_steps.h has what a timer needs for that).
    uint32_t (*time_us)(void *context);
    // FLUSH_TX, then exactly one W_ACK_PAYLOAD: two queued payloads make telemetry late for ever.
    void (*load_ack)(void *context, const uint8_t *payload, uint8_t size);
    // Power of both stepper drivers.
    void (*drivers)(void *context, bool on);
    bool (*estop_pressed)(void *context);
    // The newest sample, false while the sensor does not answer.
    bool (*imu)(void *context, struct t3_imu *sample);
    // The newest 10-bit count of a channel.
    uint16_t (*adc)(void *context, uint8_t channel);
    void (*eeprom_read)(void *context, uint8_t address, uint8_t *data, uint8_t size);
    void (*eeprom_write)(void *context, uint8_t address, const uint8_t *data, uint8_t size);
    // Anything hard to foresee (converter noise, timer jitter); only nonces are made with it.
    uint32_t (*noise)(void *context);
    // Keep the stepping interrupt out (and let it in again) while counters are read or written.
    void (*lock)(void *context);
    void (*unlock)(void *context);
};

// The robot's own USB. Of the EEPROM it sees what t3_port's eeprom_write has asked for become true,
// a cell at a time.
struct t3_console_port {
    void *context;
    // Bytes for the USB side, a whole frame at a time.
    void (*reply)(void *context, const uint8_t *wire, uint8_t size);
    // Whether the radio chip holds what was set.
    bool (*chip_ok)(void *context);
    // Whether all that was to be written has been.
    bool (*eeprom_settled)(void *context);
    // Read the cells themselves, not what they ought to hold.
    void (*eeprom_cells)(void *context, uint8_t address, uint8_t *data, uint8_t size);
};

// Configuration of the radio chip, as in a CFG frame.
struct t3_radio_settings {
    uint8_t channel;      // 2400 MHz + this
    uint8_t rate;         // 0: 250 kbit/s, 1: 1 Mbit/s, 2: 2 Mbit/s
    uint8_t power;        // 0: -18 dBm, 1: -12, 2: -6, 3: 0
    uint8_t retry_delay;  // (this + 1) 250 us
    uint8_t retries;
    uint8_t address[5];  // lowest first
};

// Channel and rate may be others at build time (make avr RADIO_CHANNEL=100 RADIO_RATE=0): a robot
// keeps them for good.
#ifndef T3_RADIO_CHANNEL
#define T3_RADIO_CHANNEL 82
#endif
#ifndef T3_RADIO_RATE
#define T3_RADIO_RATE 1
#endif
// Shorter at 250 kbit/s, acknowledgements of 32 bytes would be cut off (data sheet 7.4.2).
#define T3_RETRY_DELAY (T3_RADIO_RATE == 0 ? 5 : 1)
// Both ends start with these; the host's CFG may change the dongle's.
#define T3_RADIO_DEFAULTS                                                                         \
    {T3_RADIO_CHANNEL, T3_RADIO_RATE, 3, T3_RETRY_DELAY, 4, {'T', '3', 'M', 'P', 'C'}}

// The dongle's hardware. A radio answers each `send` by one call of t3_dongle_exchange.
struct t3_dongle_port {
    void *context;
    uint32_t (*time_us)(void *context);
    // Bytes for the USB side, a whole frame at a time.
    void (*reply)(void *context, const uint8_t *wire, uint8_t size);
    void (*send)(void *context, const uint8_t *payload, uint8_t size);
    // Set the chip; false if it does not hold what was written.
    bool (*configure)(void *context, const struct t3_radio_settings *settings);
};

#endif
