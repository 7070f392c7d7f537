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

// The dongle: t3_dongle.c between a serial line and the radio chip.
#include <avr/interrupt.h>
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "board.h"
#include "clock.h"
#include "nrf24.h"
#include "reset.h"
#include "serial.h"
#include "t3_dongle.h"

static struct t3_dongle dongle;

// Bytes from USB per pass. A full line brings more while these are processed: without a bound neither
// the radio nor the watchdog would get their turn.
#define SERIAL_SHARE 32u

// A chip that had lost its supply wakes slowly; what is to be sent meanwhile waits here.
static bool waking;
static uint32_t waking_us;
static const uint8_t *delayed;
static uint8_t delayed_size;

EMPTY_INTERRUPT(RADIO_IRQ_VECTOR)  // it only wakes the main loop, which looks at the pin

static uint32_t time_us(void *context)
{
    (void)context;
    return clock_us();
}

static void reply(void *context, const uint8_t *wire, uint8_t size)
{
    (void)context;
    serial_write(wire, size);
}

static void send(void *context, const uint8_t *payload, uint8_t size)
{
    (void)context;
    if (!waking) {
        nrf24_send(payload, size);
        return;
    }
    static uint8_t copy[T3_RADIO_LIMIT];
    for (uint8_t i = 0; i < size; i++)
        copy[i] = payload[i];
    delayed = copy;
    delayed_size = size;
}

static bool configure(void *context, const struct t3_radio_settings *settings)
{
    (void)context;
    delayed = 0;
    const bool ok = nrf24_configure(settings, NRF24_PTX, &waking);
    waking_us = clock_us();
    return ok;
}

static void wait_for_the_radio(void)
{
    if (!waking || clock_us() - waking_us < NRF24_WAKE_US)
        return;
    waking = false;
    if (delayed)
        nrf24_send(delayed, delayed_size);
    delayed = 0;
}

static void finish_exchange(void)
{
    uint8_t answer[T3_RADIO_LIMIT];
    uint8_t size = 0;
    const uint8_t raised = nrf24_status();
    if (!(raised & (NRF24_TX_DS | NRF24_MAX_RT)))
        return;
    if (raised & NRF24_TX_DS)
        size = nrf24_read(answer);
    const uint8_t retransmits = nrf24_finish();
    t3_dongle_exchange(&dongle, raised & NRF24_TX_DS, retransmits, answer, size);
}

static void sleep_if_idle(void)
{
    cli();
    if (!serial_waits() && RADIO_IRQ_HIGH && !waking && dongle.phase != T3_GAP) {
        sleep_enable();
        sei();  // the next instruction is executed before any interrupt: none is slept through
        sleep_cpu();
        sleep_disable();
    }
    sei();
}

int main(void)
{
    static const struct t3_dongle_port port = {0, time_us, reply, send, configure};
    wdt_enable(WDTO_120MS);
    clock_start();
    serial_start();
    nrf24_start();
    sei();
    // Bytes that come meanwhile wait in their ring.
    while (clock_us() < NRF24_POWER_ON_MS * UINT32_C(1000))
        wdt_reset();
    t3_dongle_boot(&dongle, &port, reset_cause);
    for (;;) {
        wdt_reset();
        uint8_t byte;
        for (uint8_t i = 0; i < SERIAL_SHARE && serial_take(&byte); i++)
            t3_dongle_byte(&dongle, byte);
        for (uint8_t count = serial_lost(); count; count--)
            t3_dongle_overrun(&dongle);
        wait_for_the_radio();
        if (!RADIO_IRQ_HIGH)
            finish_exchange();
        t3_dongle_tick(&dongle);
        sleep_if_idle();
    }
}
