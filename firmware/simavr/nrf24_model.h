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

// Register-level model of the nRF24L01+: Product Specification 1.0 (Nordic, September 2008). Times are
// in cycles of 16 MHz, one clock for everything.
#ifndef NRF24_MODEL_H
#define NRF24_MODEL_H

#include <stdbool.h>
#include <stdint.h>

#define CYCLES_PER_US 16u
#define NRF24_WIDTH 32u
#define NRF24_DEPTH 3u

struct nrf24_packet {
    uint8_t width;  // as read by R_RX_PL_WID
    uint8_t data[NRF24_WIDTH];
};

struct nrf24_fifo {
    struct nrf24_packet packets[NRF24_DEPTH];
    uint8_t count;
};

enum nrf24_phase { NRF24_QUIET, NRF24_SETTLING, NRF24_ON_AIR, NRF24_ACK_COMES, NRF24_NO_ACK };

// Counters of violations of the data sheet, and of operations that firmware should avoid.
struct nrf24_faults {
    uint32_t early_spi;     // within 100 ms of power
    uint32_t early_ce;      // within 4.5 ms of PWR_UP
    uint32_t ack_damaged;   // flushed while an acknowledgement was sent from there
    uint32_t overfull;      // payload written to a full FIFO
    uint32_t queued_acks;   // a second acknowledgement payload queued behind another
    uint32_t unknown;       // unknown commands
    uint32_t rx_overflows;       // packets dropped because the RX FIFO was full
};

struct nrf24 {
    uint8_t registers[0x20];
    uint8_t address[3][5];  // pipe 0, pipe 1, transmit
    struct nrf24_fifo rx, tx;
    bool powered;           // supply on
    bool csn, ce, irq;      // levels
    uint64_t powered_at, awake_at, listening_at;
    uint8_t code, at, buffer[NRF24_WIDTH];  // of the command in progress
    // Transmitter.
    enum nrf24_phase phase;
    uint64_t next_at, sent_at;
    uint8_t pid, repeats;
    struct nrf24_packet ack;
    // Receiver.
    bool received_any;
    uint8_t last_pid;
    struct nrf24_packet last_packet;
    bool ack_unconfirmed, ack_damaged;
    uint64_t ack_until;
    uint32_t sent, received, duplicates, attempts;
    struct nrf24_faults faults;
};

// Radio channel between two transceivers.
struct radio_channel {
    struct nrf24 *radios[2];
    double loss[2];  // probability per packet: to and from the receiver
    bool jammed;
    uint64_t random;
};

void nrf24_power(struct nrf24 *radio, bool on, uint64_t now);
void nrf24_select(struct nrf24 *radio, bool csn, uint64_t now);
void nrf24_enable(struct nrf24 *radio, bool ce, uint64_t now);
uint8_t nrf24_swap(struct nrf24 *radio, uint8_t byte, uint64_t now);
// Deliver a packet to the receiver, as from another transmitter.
bool nrf24_inject(struct nrf24 *radio, const uint8_t *data, uint8_t size, uint8_t width);
// Fill the RX FIFO with copies of a payload, and clear RX_DR.
void nrf24_deafen(struct nrf24 *radio, const uint8_t *data, uint8_t size);

// Advance the channel to `now`.
void radio_channel_run(struct radio_channel *channel, uint64_t now);

#endif
