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

// What the chip and the air between two chips know of each other.
#ifndef NRF24_INSIDE_H
#define NRF24_INSIDE_H

#include "nrf24_model.h"

enum { CONFIG, EN_AA, EN_RXADDR, SETUP_AW, SETUP_RETR, RF_CH, RF_SETUP, STATUS, OBSERVE_TX };
enum { RX_ADDR_P0 = 0x0A, RX_ADDR_P1, TX_ADDR = 0x10, FIFO_STATUS = 0x17, DYNPD = 0x1C, FEATURE };

#define RX_DR 0x40u
#define TX_DS 0x20u
#define MAX_RT 0x10u
#define FLAGS (RX_DR | TX_DS | MAX_RT)
#define PWR_UP 0x02u
#define PRIM_RX 0x01u

#define POWER_ON_CYCLES (100000u * CYCLES_PER_US)
#define WAKE_CYCLES (4500u * CYCLES_PER_US)
#define SETTLE_CYCLES (130u * CYCLES_PER_US)

// Take the oldest packet off a FIFO.
void nrf24_drop(struct nrf24_fifo *fifo);

// Raise flags of the status register, and with them the interrupt.
void nrf24_flag(struct nrf24 *radio, uint8_t flags);

bool nrf24_awake(const struct nrf24 *radio, uint64_t now);

// Begin to transmit if everything is as it must be.
void nrf24_begin(struct nrf24 *radio, uint64_t now);

#endif
