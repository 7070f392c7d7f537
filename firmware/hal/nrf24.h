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

// nRF24L01+ over SPI, register by register. Only the main loop may call these.
#ifndef NRF24_H
#define NRF24_H

#include <stdbool.h>
#include <stdint.h>

#include "t3_port.h"
#include "t3_protocol.h"

// Flags of the status register.
#define NRF24_RX_DR 0x40u
#define NRF24_TX_DS 0x20u
#define NRF24_MAX_RT 0x10u

#define NRF24_DEPTH 3u          // packets in a FIFO
#define NRF24_POWER_ON_MS 100u  // from supply to the first register
#define NRF24_WAKE_US 5000u     // from PWR_UP to CE, with the slowest crystal

enum nrf24_role { NRF24_PTX, NRF24_PRX };

// Pins, SPI and the interrupt of the chip's IRQ.
void nrf24_start(void);

// Write all registers, CE low; return whether the chip holds them. `waking`: the chip was
// powered down, so that CE has to stay low for NRF24_WAKE_US.
bool nrf24_configure(const struct t3_radio_settings *settings, enum nrf24_role role,
                     bool *waking);

// Return whether the chip still holds its configuration, which is lost with its supply.
bool nrf24_holds(const struct t3_radio_settings *settings, enum nrf24_role role);

void nrf24_listen(void);

// Return the raised flags and take them back.
uint8_t nrf24_clear_status(void);

// Return whether a payload waits in the RX FIFO.
bool nrf24_rx_waiting(void);

// Read the next payload; return its width, 0 if there is none. A width over 32 is what the chip
// claims of a packet that was meant to break it: nothing of it is read, the FIFO is emptied.
uint8_t nrf24_read(uint8_t payload[T3_RADIO_LIMIT]);

// Send a payload: flags SENT or GAVE_UP follow.
void nrf24_send(const uint8_t *payload, uint8_t size);

// Return the raised flags and leave them.
uint8_t nrf24_status(void);

// CE low, both FIFOs empty, no flags; return how often the last packet was repeated.
uint8_t nrf24_finish(void);

// What the next packet fetches: exactly one payload waits.
void nrf24_load_ack(const uint8_t *payload, uint8_t size);

#endif
