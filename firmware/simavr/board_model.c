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
#include "board_model.h"

#include <sim_elf.h>
#include <avr_ioport.h>
#include <stdio.h>
#include <string.h>

#define SPI_BYTE_CYCLES 18u  // 16 at half the clock, and the begin

avr_io_t *board_part(struct board *board, const char *kind)
{
    avr_io_t *part = board->avr->io_port;
    while (part && strcmp(part->kind, kind))
        part = part->next;
    return part;
}

avr_irq_t *board_pin(struct board *board, struct pin pin)
{
    return avr_io_getirq(board->avr, AVR_IOCTL_IOPORT_GETIRQ(pin.port), pin.bit);
}

void board_show(struct board *board, struct pin pin, bool level)
{
    avr_raise_irq(board_pin(board, pin), level);
}

// -- radio ---------------------------------------------------------------------------------------

static void show_irq(struct board *board)
{
    if (board->radio.irq != board->irq_shown)
        board_show(board, board->layout.irq, board->radio.irq);
    board->irq_shown = board->radio.irq;
}

static avr_cycle_count_t end_of_spi_byte(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)when;
    struct board *board = param;
    board->spi->input_data_register = nrf24_swap(&board->radio, board->spi_byte, avr->cycle);
    show_irq(board);
    avr_raise_interrupt(avr, &board->spi->spi);
    return 0;
}

// simavr takes 100 us for every byte; this stands in front of it.
static void write_spdr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)address;
    struct board *board = param;
    avr_regbit_clear(avr, board->spi->spi.raised);
    board->spi_byte = value;
    avr_cycle_timer_register(avr, SPI_BYTE_CYCLES, end_of_spi_byte, board);
}

static void csn_changed(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    struct board *board = param;
    nrf24_select(&board->radio, value & 1, board->avr->cycle);
    show_irq(board);
}

static void ce_changed(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    struct board *board = param;
    nrf24_enable(&board->radio, value & 1, board->avr->cycle);
}

// -- processor -----------------------------------------------------------------------------------

static void count_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    (void)avr;
    struct board *board = avr->custom.data;
    board->slept += cycles + 1;
}

// A sleeping core jumps to its next timer: this one keeps the jump short.
static avr_cycle_count_t keep_step(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr, (void)param;
    return when + LOCK_STEP_CYCLES;
}

static void note_reset(avr_io_t *io)
{
    struct board *board = io->avr->custom.data;
    board->was_reset = true;
    board->resets++;
}

static void restore(struct board *board)
{
    board->was_reset = false;
    board->avr->run_cycle_limit = LOCK_STEP_CYCLES;
    avr_cycle_timer_register(board->avr, LOCK_STEP_CYCLES, keep_step, board);
    // simavr forgets the levels of inputs, and hides that they are equal: toggle.
    board_show(board, board->layout.irq, !board->radio.irq);
    board_show(board, board->layout.irq, board->radio.irq);
    board->irq_shown = board->radio.irq;
    board->serial.unread = 0;
    board->serial.holds = board->serial.sends = false;
    if (board->restored)
        board->restored(board);
}

static void quiet(avr_t *avr, const int level, const char *format, va_list ap)
{
    (void)avr;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, ap);
}

bool board_open(struct board *board, const struct board_layout *layout, const char *elf)
{
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    avr_global_logger_set(quiet);
    if (elf_read_firmware(elf, &firmware))
        return false;
    board->layout = *layout;
    board->avr = avr_make_mcu_by_name(layout->chip);
    if (!board->avr)
        return false;
    board->avr->custom.data = board;
    avr_init(board->avr);
    firmware.frequency = CYCLES_PER_US * 1000000u;
    firmware.vcc = firmware.avcc = firmware.aref = 5000;
    avr_load_firmware(board->avr, &firmware);
    board->avr->sleep = count_sleep;
    board->watcher.kind = "watcher";
    board->watcher.reset = note_reset;
    avr_register_io(board->avr, &board->watcher);
    board->was_reset = true;  // it begins like after one
    board->spi = (avr_spi_t *)board_part(board, "spi");
    const avr_io_addr_t spdr = AVR_DATA_TO_IO(board->spi->r_spdr);
    board->avr->io[spdr].w.c = write_spdr;
    board->avr->io[spdr].w.param = board;
    nrf24_power(&board->radio, true, 0);
    avr_irq_register_notify(board_pin(board, layout->csn), csn_changed, board);
    avr_irq_register_notify(board_pin(board, layout->ce), ce_changed, board);
    return true;
}

void board_close(struct board *board)
{
    if (board->avr)
        avr_terminate(board->avr);
    board->avr = NULL;
}

void board_reset(struct board *board)
{
    avr_reset(board->avr);
    avr_regbit_set(board->avr, board->avr->reset_flags.extrf);
}

void board_run(struct board *board, uint64_t until)
{
    show_irq(board);
    while (board->avr->cycle < until) {
        // A reset, by us or by the watchdog, has taken all timers with it.
        if (board->was_reset)
            restore(board);
        const avr_cycle_count_t slice = board->avr->cycle + LOCK_STEP_CYCLES;
        while (board->avr->cycle < slice && board->avr->cycle < until) {
            const int state = avr_run(board->avr);
            if (board->was_reset)
                break;
            if (state == cpu_Done || state == cpu_Crashed) {
                board->avr->cycle = until;
                return;
            }
        }
    }
}

// -- UART ----------------------------------------------------------------------------------------

static void move_on(struct board *board, uint64_t now)
{
    struct uart_model *serial = &board->serial;
    avr_t *avr = board->avr;
    while (serial->sends && serial->sent_at <= now) {
        serial->sends = serial->holds;
        if (serial->holds) {
            struct line *out = &serial->out;
            serial->sent_at += BYTE_CYCLES;
            out->bytes[out->head % LINE_ROOM] = serial->held;
            out->at[out->head++ % LINE_ROOM] = serial->sent_at;
            serial->holds = false;
            avr_raise_interrupt(avr, &serial->uart->udrc);
        }
    }
}

static void write_udr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)address;
    struct board *board = param;
    struct uart_model *serial = &board->serial;
    move_on(board, avr->cycle);
    if (serial->sends) {
        serial->held = value;
        serial->holds = true;
        avr_regbit_clear(avr, serial->uart->udrc.raised);
        return;
    }
    struct line *out = &serial->out;
    serial->sends = true;
    serial->sent_at = avr->cycle + BYTE_CYCLES;
    out->bytes[out->head % LINE_ROOM] = value;
    out->at[out->head++ % LINE_ROOM] = serial->sent_at;
    // The data register is empty at once: its interrupt comes again.
    avr_raise_interrupt(avr, &serial->uart->udrc);
}

static uint8_t read_udr(avr_t *avr, avr_io_addr_t address, void *param)
{
    (void)address;
    struct board *board = param;
    struct uart_model *serial = &board->serial;
    const uint8_t value = serial->received[0];
    if (serial->unread)
        serial->unread--;
    serial->received[0] = serial->received[1];
    avr_regbit_clear(avr, serial->uart->dor);
    if (serial->unread)
        avr_raise_interrupt(avr, &serial->uart->rxc);
    else
        avr_clear_interrupt(avr, &serial->uart->rxc);
    return value;
}

// Return UART 0: the larger chip has four.
static avr_uart_t *first_uart(struct board *board)
{
    for (avr_io_t *part = board->avr->io_port; part; part = part->next)
        if (!strcmp(part->kind, "uart") && ((avr_uart_t *)part)->name == '0')
            return (avr_uart_t *)part;
    return NULL;
}

void board_attach_uart(struct board *board)
{
    avr_t *avr = board->avr;
    avr_uart_t *uart = first_uart(board);
    board->serial.uart = uart;
    const avr_io_addr_t udr = AVR_DATA_TO_IO(uart->r_udr);
    avr->io[udr].w.c = write_udr;
    avr->io[udr].w.param = board;
    avr->io[udr].r.c = read_udr;
    avr->io[udr].r.param = board;
    uart->flags = 0;
}

void board_run_uart(struct board *board, uint64_t now)
{
    struct uart_model *serial = &board->serial;
    struct line *in = &serial->in;
    move_on(board, now);
    while (in->tail != in->head && in->at[in->tail % LINE_ROOM] <= now) {
        const uint8_t byte = in->bytes[in->tail++ % LINE_ROOM];
        if (!avr_regbit_get(board->avr, serial->uart->rxen))
            continue;
        if (serial->unread == 2) {
            avr_regbit_set(board->avr, serial->uart->dor);
            serial->overruns++;
            continue;
        }
        serial->received[serial->unread++] = byte;
    }
    // The flag is a level: an interrupt allowed later finds what came before.
    if (serial->unread)
        avr_raise_interrupt(board->avr, &serial->uart->rxc);
}

// -- TWI and MPU6050 -----------------------------------------------------------------------------

static void twi_message(avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    struct board *board = param;
    struct imu_model *imu = &board->imu;
    const avr_twi_msg_irq_t message = {.u.v = value};
    const uint8_t what = message.u.twi.msg;
    avr_irq_t *input = avr_io_getirq(board->avr, AVR_IOCTL_TWI_GETIRQ(board->twi->name),
                                     TWI_IRQ_INPUT);
    if (what & TWI_COND_STOP)
        imu->addressed = false;
    if (what & TWI_COND_START) {
        // simavr would take the address for a data byte that has been sent already.
        board->twi->state &= (uint8_t)~TWI_COND_WRITE;
        imu->addressed = imu->present && message.u.twi.addr >> 1 == 0x68;
        imu->pointed = message.u.twi.addr & 1;
        if (imu->addressed)
            avr_raise_irq(input, avr_twi_irq_msg(TWI_COND_ACK, message.u.twi.addr, 1));
    }
    if (!imu->addressed || what & (TWI_COND_START | TWI_COND_STOP))
        return;
    if (what & TWI_COND_WRITE) {
        if (imu->pointed)
            imu->registers[imu->pointer++ & 0x7F] = message.u.twi.data;
        else
            imu->pointer = message.u.twi.data;
        imu->pointed = true;
        avr_raise_irq(input, avr_twi_irq_msg(TWI_COND_ACK, message.u.twi.addr, 1));
    }
    if (what & TWI_COND_READ) {
        const bool sleeps = imu->registers[0x6B] & 0x40;
        const uint8_t at = imu->pointer++ & 0x7F;
        const uint8_t byte = sleeps && at >= 0x3B && at <= 0x48 ? 0 : imu->registers[at];
        imu->reads++;
        avr_raise_irq(input, avr_twi_irq_msg(TWI_COND_READ, message.u.twi.addr, byte));
    }
}

void board_attach_twi(struct board *board)
{
    board->twi = (avr_twi_t *)board_part(board, "twi");
    board->adc = (avr_adc_t *)board_part(board, "adc");
    board->imu.registers[0x6B] = 0x40;
    avr_irq_register_notify(
        avr_io_getirq(board->avr, AVR_IOCTL_TWI_GETIRQ(board->twi->name), TWI_IRQ_OUTPUT),
        twi_message, board);
}
