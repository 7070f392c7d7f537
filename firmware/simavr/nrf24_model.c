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
#include "nrf24_inside.h"

#include <string.h>

void nrf24_drop(struct nrf24_fifo *fifo)
{
    if (!fifo->count)
        return;
    fifo->count--;
    memmove(fifo->packets, fifo->packets + 1, fifo->count * sizeof fifo->packets[0]);
}

static void update_irq(struct nrf24 *radio)
{
    radio->irq = !(radio->powered && radio->registers[STATUS] & FLAGS & ~radio->registers[CONFIG]);
}

void nrf24_flag(struct nrf24 *radio, uint8_t flags)
{
    radio->registers[STATUS] |= flags;
    update_irq(radio);
}

static uint8_t status(const struct nrf24 *radio)
{
    const uint8_t pipe = radio->rx.count ? 0 : 7;  // everything here comes through pipe 0
    return (uint8_t)((radio->registers[STATUS] & FLAGS) | pipe << 1 |
                     (radio->tx.count == NRF24_DEPTH));
}

static uint8_t fifo_status(const struct nrf24 *radio)
{
    return (uint8_t)((radio->tx.count == NRF24_DEPTH) << 5 | !radio->tx.count << 4 |
                     (radio->rx.count == NRF24_DEPTH) << 1 | !radio->rx.count);
}

void nrf24_power(struct nrf24 *radio, bool on, uint64_t now)
{
    const struct nrf24 was = *radio;
    memset(radio, 0, sizeof *radio);
    radio->csn = was.csn;
    radio->ce = was.ce;
    radio->sent = was.sent;
    radio->received = was.received;
    radio->duplicates = was.duplicates;
    radio->attempts = was.attempts;
    radio->faults = was.faults;
    radio->powered = on;
    radio->powered_at = now;
    radio->registers[CONFIG] = 0x08;
    radio->registers[EN_AA] = 0x3F;
    radio->registers[EN_RXADDR] = 0x03;
    radio->registers[SETUP_AW] = 0x03;
    radio->registers[SETUP_RETR] = 0x03;
    radio->registers[RF_CH] = 0x02;
    radio->registers[RF_SETUP] = 0x0E;
    memset(radio->address[0], 0xE7, 5);
    memset(radio->address[1], 0xC2, 5);
    memset(radio->address[2], 0xE7, 5);
    update_irq(radio);
}

bool nrf24_awake(const struct nrf24 *radio, uint64_t now)
{
    return radio->powered && radio->registers[CONFIG] & PWR_UP && now >= radio->awake_at;
}

void nrf24_begin(struct nrf24 *radio, uint64_t now)
{
    if (radio->phase != NRF24_QUIET || !radio->ce || !radio->tx.count || !nrf24_awake(radio, now) ||
        radio->registers[CONFIG] & PRIM_RX || radio->registers[STATUS] & MAX_RT)
        return;
    radio->phase = NRF24_SETTLING;
    radio->next_at = now + SETTLE_CYCLES;
    radio->repeats = 0;
    radio->pid = (radio->pid + 1) & 3;
    radio->registers[OBSERVE_TX] &= 0xF0;
}

void nrf24_enable(struct nrf24 *radio, bool ce, uint64_t now)
{
    if (ce == radio->ce)
        return;
    radio->ce = ce;
    if (!ce)
        return;
    if (!nrf24_awake(radio, now))
        radio->faults.early_ce++;
    radio->listening_at = now + SETTLE_CYCLES;
    nrf24_begin(radio, now);
}

// -- commands ------------------------------------------------------------------------------------

static uint8_t *address_of(struct nrf24 *radio, uint8_t which)
{
    switch (which) {
    case RX_ADDR_P0:
        return radio->address[0];
    case RX_ADDR_P1:
        return radio->address[1];
    case TX_ADDR:
        return radio->address[2];
    default:
        return NULL;
    }
}

static uint8_t read_register(struct nrf24 *radio, uint8_t which, uint8_t at)
{
    const uint8_t *address = address_of(radio, which);
    if (address)
        return at < 5 ? address[at] : 0;
    if (which == STATUS)
        return status(radio);
    if (which == FIFO_STATUS)
        return fifo_status(radio);
    return radio->registers[which];
}

static void write_register(struct nrf24 *radio, uint8_t which, uint8_t at, uint8_t value,
                           uint64_t now)
{
    uint8_t *address = address_of(radio, which);
    if (address) {
        if (at < 5)
            address[at] = value;
        return;
    }
    if (at)
        return;
    switch (which) {
    case STATUS:
        radio->registers[STATUS] &= (uint8_t)~(value & FLAGS);
        update_irq(radio);
        nrf24_begin(radio, now);
        return;
    case OBSERVE_TX:
    case FIFO_STATUS:
        return;
    case CONFIG:
        if (value & ~radio->registers[CONFIG] & PWR_UP)
            radio->awake_at = now + WAKE_CYCLES;
        radio->registers[CONFIG] = value & 0x7F;
        update_irq(radio);
        return;
    case RF_CH:
        radio->registers[OBSERVE_TX] = 0;
        break;
    case RF_SETUP:
        value &= 0xBE;
        break;
    default:
        break;
    }
    radio->registers[which] = value;
}

// An acknowledgement that is being sent loses its bytes; one without any has none to lose.
static void flush_tx(struct nrf24 *radio, uint64_t now)
{
    if (now < radio->ack_until && radio->ack_unconfirmed && !radio->ack_damaged) {
        radio->ack_damaged = true;
        radio->faults.ack_damaged++;
    }
    radio->tx.count = 0;
    radio->ack_unconfirmed = false;
}

static void push(struct nrf24 *radio, uint64_t now)
{
    if (radio->tx.count == NRF24_DEPTH) {
        radio->faults.overfull++;
        return;
    }
    struct nrf24_packet *packet = &radio->tx.packets[radio->tx.count++];
    packet->width = (uint8_t)(radio->at - 1);
    memcpy(packet->data, radio->buffer, packet->width);
    if (radio->registers[CONFIG] & PRIM_RX) {
        radio->faults.queued_acks += radio->tx.count > 1;
    } else {
        nrf24_begin(radio, now);
    }
}

// A command takes effect when CSN rises; bytes of registers do at once.
static void conclude(struct nrf24 *radio, uint64_t now)
{
    const uint8_t code = radio->code;
    if (code == 0x61 && radio->at > 1) {
        nrf24_drop(&radio->rx);
    } else if (code == 0xE1) {
        flush_tx(radio, now);
    } else if (code == 0xE2) {
        radio->rx.count = 0;
    } else if ((code == 0xA0 || (code & 0xF8) == 0xA8) && radio->at > 1) {
        push(radio, now);
    } else if (code >= 0x40 && code != 0x50 && code != 0x60 && code != 0x61 && code != 0xFF) {
        radio->faults.unknown++;
    }
}

void nrf24_select(struct nrf24 *radio, bool csn, uint64_t now)
{
    if (csn == radio->csn)
        return;
    radio->csn = csn;
    if (csn && radio->at && radio->powered)
        conclude(radio, now);
    radio->at = 0;
}

static uint8_t answer_byte(struct nrf24 *radio, uint8_t byte, uint64_t now)
{
    const uint8_t code = radio->code, at = (uint8_t)(radio->at - 1);
    if (code < 0x20)
        return read_register(radio, code, at);
    if (code < 0x40)
        write_register(radio, code & 0x1F, at, byte, now);
    else if (code == 0x60)
        return radio->rx.count ? radio->rx.packets[0].width : 0;
    else if (code == 0x61)
        return radio->rx.count && at < NRF24_WIDTH ? radio->rx.packets[0].data[at] : 0;
    else if (at < NRF24_WIDTH)
        radio->buffer[at] = byte;
    return 0;
}

uint8_t nrf24_swap(struct nrf24 *radio, uint8_t byte, uint64_t now)
{
    if (radio->csn || !radio->powered)
        return 0;
    if (now - radio->powered_at < POWER_ON_CYCLES)
        radio->faults.early_spi++;
    uint8_t answer;
    if (radio->at == 0) {
        answer = status(radio);
        radio->code = byte;
    } else {
        answer = answer_byte(radio, byte, now);
    }
    if (radio->at <= NRF24_WIDTH)
        radio->at++;
    return answer;
}

bool nrf24_inject(struct nrf24 *radio, const uint8_t *data, uint8_t size, uint8_t width)
{
    if (radio->rx.count == NRF24_DEPTH || size > NRF24_WIDTH)
        return false;
    struct nrf24_packet *packet = &radio->rx.packets[radio->rx.count++];
    packet->width = width;
    memcpy(packet->data, data, size);
    nrf24_flag(radio, RX_DR);
    return true;
}

void nrf24_deafen(struct nrf24 *radio, const uint8_t *data, uint8_t size)
{
    while (nrf24_inject(radio, data, size, size))
        ;
    radio->registers[STATUS] &= (uint8_t)~RX_DR;
    update_irq(radio);
}
