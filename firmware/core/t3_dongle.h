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

// Dongle: one TX frame over USB is one radio transaction is one RESULT frame. It never repeats a
// command by itself: a dead host is silence, and silence stops the robot.
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
// Longer than the longest exchange (15 retries at 250 kbit/s): the radio chip has failed.
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

// Process a byte from USB.
void t3_dongle_byte(struct t3_dongle *dongle, uint8_t byte);

// Count a byte lost to an overrun.
void t3_dongle_overrun(struct t3_dongle *dongle);

// End of an exchange: acknowledged (with `size` bytes of reply, or none), or failed after the maximum
// number of retransmissions.
void t3_dongle_exchange(struct t3_dongle *dongle, bool acknowledged, uint8_t retransmits,
                        const uint8_t *answer, uint8_t size);

// Call in each pass of the main loop.
void t3_dongle_tick(struct t3_dongle *dongle);

#endif
