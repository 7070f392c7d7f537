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
#include "imu.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/delay.h>

#include "board.h"

#define ADDRESS 0x68u
#define FIRST_REGISTER 0x3Bu
#define SAMPLE_SIZE 14u
#define POWER_REGISTER 0x6Bu
#define AWAKE 0x01u  // clocked by the gyro's PLL

#define PERIOD_US 2000u
#define PATIENCE_US 3000u  // a transfer takes 0.4 ms
#define RETRY_US 20000u

// Status codes of the TWI.
#define STARTED 0x08u
#define STARTED_AGAIN 0x10u
#define WRITE_ACKED 0x18u
#define BYTE_ACKED 0x28u
#define READ_ACKED 0x40u
#define BYTE_CAME 0x50u
#define LAST_BYTE_CAME 0x58u

#define GO (_BV(TWINT) | _BV(TWEN) | _BV(TWIE))

static const uint8_t SETTINGS[][2] = {
    {POWER_REGISTER, AWAKE},
    {0x19, 0x04},  // 200 Hz
    {0x1A, 0x03},  // 44 Hz low pass
    {0x1B, 0x08},  // +-500 deg/s
    {0x1C, 0x00},  // +-2 g
};
#define SETTINGS_COUNT ((uint8_t)(sizeof SETTINGS / sizeof SETTINGS[0]))

static volatile enum { IDLE, BUSY, DONE, FAILED } transfer;
static volatile uint8_t at;  // in the transfer
static uint8_t reg, value;   // of it
static uint8_t to_read;      // bytes; 0: a write
static volatile uint8_t bytes[SAMPLE_SIZE];

static uint8_t settled;  // how many of SETTINGS are written
static bool sampled;     // a sample waits for its check
static bool answers;
static struct t3_imu newest, unchecked;
static uint32_t begun_us, wait_us;

static void stop(uint8_t how)
{
    TWCR = _BV(TWINT) | _BV(TWEN) | _BV(TWSTO);
    transfer = how;
}

static void send(uint8_t byte)
{
    TWDR = byte;
    TWCR = GO;
}

static void receive(void)
{
    // The last byte is not acknowledged.
    TWCR = at + 1u < to_read ? GO | _BV(TWEA) : GO;
}

ISR(TWI_vect)
{
    switch (TWSR & 0xF8u) {
    case STARTED:
        send(ADDRESS << 1);
        break;
    case WRITE_ACKED:
        send(reg);
        break;
    case BYTE_ACKED:
        if (to_read)
            TWCR = GO | _BV(TWSTA);
        else if (at++ == 0)
            send(value);
        else
            stop(DONE);
        break;
    case STARTED_AGAIN:
        send(ADDRESS << 1 | 1u);
        break;
    case READ_ACKED:
        receive();
        break;
    case BYTE_CAME:
        bytes[at] = TWDR;
        at++;
        receive();
        break;
    case LAST_BYTE_CAME:
        bytes[at] = TWDR;
        stop(DONE);
        break;
    default:
        stop(FAILED);
    }
}

static void begin(uint32_t now_us)
{
    if (settled < SETTINGS_COUNT) {
        to_read = 0;
        reg = SETTINGS[settled][0];
        value = SETTINGS[settled][1];
    } else {
        to_read = sampled ? 1 : SAMPLE_SIZE;
        reg = sampled ? POWER_REGISTER : FIRST_REGISTER;
    }
    at = 0;
    begun_us = now_us;
    transfer = BUSY;
    TWCR = GO | _BV(TWSTA);
}

static int16_t number(uint8_t index)
{
    return (int16_t)((uint16_t)bytes[index] << 8 | bytes[index + 1u]);
}

static void take_sample(void)
{
    const struct t3_imu sample = {number(0), number(2), number(4), number(6),
                                  number(8), number(10), number(12)};
    unchecked = sample;
}

// A sensor that lost count in the middle of a byte holds the data line until it gets its clocks.
static void free_the_bus(void)
{
    TWCR = 0;
    for (uint8_t i = 0; i < 9 && !TWI_SDA_HIGH; i++) {
        TWI_DDR |= _BV(TWI_SCL);
        _delay_us(5);
        TWI_DDR &= (uint8_t)~_BV(TWI_SCL);
        _delay_us(5);
    }
}

static void give_up(void)
{
    free_the_bus();
    transfer = IDLE;
    answers = false;
    sampled = false;
    settled = 0;  // a sensor that responds again has lost its configuration
    wait_us = RETRY_US;
}

static void finish(void)
{
    transfer = IDLE;
    wait_us = PERIOD_US;
    if (!to_read) {
        settled++;
    } else if (!sampled) {
        take_sample();
        sampled = true;
        wait_us = 0;
    } else if (bytes[0] != AWAKE) {
        // It has reset itself: it sleeps, and the sample is of zeros.
        give_up();
    } else {
        sampled = false;
        newest = unchecked;
        answers = true;
    }
}

void imu_start(void)
{
    TWSR = 0;
    TWBR = 12;  // 400 kHz
    // The sensor's own pull-ups go to its 3.3 V, so the pins' stay off.
}

void imu_work(uint32_t now_us)
{
    const uint32_t elapsed_us = now_us - begun_us;
    switch (transfer) {
    case IDLE:
        if (elapsed_us >= wait_us)
            begin(now_us);
        return;
    case BUSY:
        if (elapsed_us >= PATIENCE_US)
            give_up();
        return;
    case FAILED:
        give_up();
        return;
    case DONE:
        finish();
    }
}

bool imu_sample(struct t3_imu *sample)
{
    *sample = newest;
    return answers;
}
