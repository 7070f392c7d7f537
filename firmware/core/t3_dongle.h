// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// The dongle: one TX frame over USB is one radio transaction is one RESULT frame back. It never
// repeats a command by itself, so a host that died is silence, and silence stops the robot.
#ifndef T3_DONGLE_H
#define T3_DONGLE_H

#include "t3_port.h"
#include "t3_protocol.h"

// Status bits of an exchange in RESULT; the upper four bits count retransmits.
#define T3_EXCHANGE_ACK 1u
#define T3_EXCHANGE_PAYLOAD 2u
#define T3_EXCHANGE_MAX_RT 4u
#define T3_EXCHANGE_SKIPPED 8u

#define T3_GAP_UNIT_US 250u
// Longer than any exchange the chip can be set to (15 retries at 250 kbit/s): it has died.
#define T3_EXCHANGE_LIMIT_US UINT32_C(150000)

enum t3_dongle_phase { T3_IDLE, T3_FIRST, T3_GAP, T3_SECOND };

struct t3_dongle {
    const struct t3_dongle_port *port;
    struct t3_splitter splitter;
    struct t3_radio_settings radio;
    bool chip_ok;
    uint8_t reset_cause;
    uint16_t overruns;

    enum t3_dongle_phase phase;
    uint32_t phase_us;  // when the phase began
    uint8_t id, gap;
    uint8_t second[T3_RADIO_LIMIT], second_size;
    uint8_t status[2];
    uint8_t answer[T3_RADIO_LIMIT], answer_size;
};

void t3_dongle_boot(struct t3_dongle *dongle, const struct t3_dongle_port *port,
                    uint8_t reset_cause);

// Take a byte from USB.
void t3_dongle_byte(struct t3_dongle *dongle, uint8_t byte);

// Count a byte that was lost because it was not read in time.
void t3_dongle_overrun(struct t3_dongle *dongle);

// The radio has finished an exchange: acknowledged (with `size` bytes of answer, or none), or given
// up after as many retransmits as it may make.
void t3_dongle_exchange(struct t3_dongle *dongle, bool acknowledged, uint8_t retransmits,
                        const uint8_t *answer, uint8_t size);

// Call as often as the main loop runs.
void t3_dongle_tick(struct t3_dongle *dongle);

#endif
