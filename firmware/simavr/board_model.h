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

// A board: one AVR of simavr with its radio chip, with corrections from outside where simavr 1.6
// differs from the data sheets.
#ifndef BOARD_MODEL_H
#define BOARD_MODEL_H

#include <sim_avr.h>
#include <avr_adc.h>
#include <avr_spi.h>
#include <avr_twi.h>
#include <avr_uart.h>

#include "nrf24_model.h"

#define LOCK_STEP_CYCLES (10u * CYCLES_PER_US)
#define BYTE_CYCLES (20u * CYCLES_PER_US)  // 10 bits at 500000 baud
#define LINE_ROOM 65536u

struct pin {
    char port;
    uint8_t bit;
};

struct board_layout {
    const char *chip;
    struct pin csn, ce, irq;
};

// Bytes on a wire, each with the time its last bit is through.
struct line {
    uint8_t bytes[LINE_ROOM];
    uint64_t at[LINE_ROOM];
    uint32_t head, tail;
};

// A UART at register level: receiver of two bytes, transmitter of one and the one on its way.
struct uart_model {
    avr_uart_t *uart;
    struct line in, out;
    uint8_t received[2], unread, held;
    bool holds, sends;
    uint64_t sent_at;
    uint32_t overruns;
};

struct imu_model {
    bool present;
    uint8_t registers[0x80], pointer;
    bool addressed, pointed;
    uint32_t reads;
};

struct board {
    avr_t *avr;
    struct board_layout layout;
    struct nrf24 radio;
    bool irq_shown;
    avr_spi_t *spi;
    uint8_t spi_byte;
    avr_twi_t *twi;
    avr_adc_t *adc;
    struct uart_model serial;
    struct imu_model imu;
    uint64_t slept;
    avr_io_t watcher;  // of resets
    bool was_reset;
    uint32_t resets;
    // Called after the AVR has been reset by whomever: levels of its inputs are lost.
    void (*restored)(struct board *board);
};

bool board_open(struct board *board, const struct board_layout *layout, const char *elf);
void board_close(struct board *board);
void board_reset(struct board *board);
void board_run(struct board *board, uint64_t until);
void board_show(struct board *board, struct pin pin, bool level);
avr_irq_t *board_pin(struct board *board, struct pin pin);
avr_io_t *board_part(struct board *board, const char *kind);
void board_attach_uart(struct board *board);
void board_attach_twi(struct board *board);
// Bring the UART to `now`.
void board_run_uart(struct board *board, uint64_t now);

#endif
