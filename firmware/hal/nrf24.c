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
#include "nrf24.h"

#include "board.h"

// Commands.
#define R_REGISTER 0x00u
#define W_REGISTER 0x20u
#define ACTIVATE 0x50u
#define R_RX_PL_WID 0x60u
#define R_RX_PAYLOAD 0x61u
#define W_TX_PAYLOAD 0xA0u
#define W_ACK_PAYLOAD 0xA8u  // of pipe 0
#define FLUSH_TX 0xE1u
#define FLUSH_RX 0xE2u
#define NOP 0xFFu

// Registers.
#define CONFIG 0x00u
#define EN_AA 0x01u
#define EN_RXADDR 0x02u
#define SETUP_AW 0x03u
#define SETUP_RETR 0x04u
#define RF_CH 0x05u
#define RF_SETUP 0x06u
#define STATUS 0x07u
#define OBSERVE_TX 0x08u
#define RX_ADDR_P0 0x0Au
#define TX_ADDR 0x10u
#define FIFO_STATUS 0x17u
#define DYNPD 0x1Cu
#define FEATURE 0x1Du

#define MASK_TX_DS 0x20u
#define MASK_MAX_RT 0x10u
#define EN_CRC 0x08u
#define CRCO 0x04u
#define PWR_UP 0x02u
#define PRIM_RX 0x01u
#define RX_EMPTY 0x01u
#define EN_DPL 0x04u
#define EN_ACK_PAY 0x02u
#define PIPE_0 0x01u
#define FIVE_BYTES 0x03u
#define FLAGS (NRF24_RX_DR | NRF24_TX_DS | NRF24_MAX_RT)

// Inline: the call would take longer than the byte.
static inline __attribute__((always_inline)) uint8_t spi_transfer(uint8_t byte)
{
    SPDR = byte;
    while (!(SPSR & _BV(SPIF)))
        ;
    return SPDR;
}

static void spi_select(void)
{
    SPI_PORT &= (uint8_t)~_BV(RADIO_CSN);
}

static void spi_deselect(void)
{
    SPI_PORT |= _BV(RADIO_CSN);
}

static void set_ce(bool on)
{
    if (on)
        SPI_PORT |= _BV(RADIO_CE);
    else
        SPI_PORT &= (uint8_t)~_BV(RADIO_CE);
}

// Return the status register.
static uint8_t send_command(uint8_t code)
{
    spi_select();
    const uint8_t status = spi_transfer(code);
    spi_deselect();
    return status;
}

static uint8_t send_query(uint8_t code)
{
    spi_select();
    spi_transfer(code);
    const uint8_t value = spi_transfer(NOP);
    spi_deselect();
    return value;
}

static void write_command(uint8_t code, const uint8_t *data, uint8_t size)
{
    spi_select();
    spi_transfer(code);
    while (size--)
        spi_transfer(*data++);
    spi_deselect();
}

static void write_register(uint8_t reg, uint8_t value)
{
    write_command((uint8_t)(W_REGISTER | reg), &value, 1);
}

static uint8_t read_register(uint8_t reg)
{
    return send_query((uint8_t)(R_REGISTER | reg));
}

static uint8_t config_for(enum nrf24_role role)
{
    // The robot's IRQ means one thing: a packet came.
    return role == NRF24_PTX ? EN_CRC | CRCO | PWR_UP
                              : MASK_TX_DS | MASK_MAX_RT | EN_CRC | CRCO | PWR_UP | PRIM_RX;
}

static uint8_t rf_setup_for(const struct t3_radio_settings *settings)
{
    static const uint8_t RATES[] = {0x20, 0x00, 0x08};
    return (uint8_t)(RATES[settings->rate] | settings->power << 1);
}

static uint8_t setup_retr_for(const struct t3_radio_settings *settings)
{
    return (uint8_t)(settings->retry_delay << 4 | settings->retries);
}

void nrf24_start(void)
{
    spi_deselect();
    set_ce(false);
    SPI_DDR |= _BV(SPI_SCK) | _BV(SPI_MOSI) | _BV(RADIO_CSN) | _BV(RADIO_CE);
    // 8 MHz; the chip takes 10. Mode 0, highest bit first.
    SPCR = _BV(SPE) | _BV(MSTR);
    SPSR = _BV(SPI2X);
    RADIO_IRQ_SETUP();
}

static void allow_features(void)
{
    const uint8_t wanted = EN_DPL | EN_ACK_PAY;
    write_register(FEATURE, wanted);
    if (read_register(FEATURE) == wanted)
        return;
    // On the chip without plus they are hidden until ACTIVATE; a second ACTIVATE hides them again.
    const uint8_t key = 0x73;
    write_command(ACTIVATE, &key, 1);
    write_register(FEATURE, wanted);
}

static bool holds_address(const uint8_t *address)
{
    bool same = true;
    spi_select();
    spi_transfer(R_REGISTER | TX_ADDR);
    for (uint8_t i = 0; i < 5; i++)
        same = spi_transfer(NOP) == address[i] && same;
    spi_deselect();
    return same;
}

bool nrf24_configure(const struct t3_radio_settings *settings, enum nrf24_role role, bool *waking)
{
    set_ce(false);
    *waking = !(read_register(CONFIG) & PWR_UP);
    write_register(CONFIG, config_for(role));
    write_register(EN_AA, PIPE_0);
    write_register(EN_RXADDR, PIPE_0);
    write_register(SETUP_AW, FIVE_BYTES);
    write_register(SETUP_RETR, setup_retr_for(settings));
    write_register(RF_CH, settings->channel);
    write_register(RF_SETUP, rf_setup_for(settings));
    write_command(W_REGISTER | RX_ADDR_P0, settings->address, 5);
    write_command(W_REGISTER | TX_ADDR, settings->address, 5);
    allow_features();
    write_register(DYNPD, PIPE_0);
    send_command(FLUSH_TX);
    send_command(FLUSH_RX);
    write_register(STATUS, FLAGS);
    return nrf24_holds(settings, role);
}

bool nrf24_holds(const struct t3_radio_settings *settings, enum nrf24_role role)
{
    return read_register(CONFIG) == config_for(role) && read_register(EN_AA) == PIPE_0 &&
           read_register(SETUP_RETR) == setup_retr_for(settings) && read_register(RF_CH) == settings->channel &&
           read_register(RF_SETUP) == rf_setup_for(settings) && read_register(FEATURE) == (EN_DPL | EN_ACK_PAY) &&
           read_register(DYNPD) == PIPE_0 && holds_address(settings->address);
}

void nrf24_listen(void)
{
    set_ce(true);
}

uint8_t nrf24_status(void)
{
    return send_command(NOP) & FLAGS;
}

uint8_t nrf24_clear_status(void)
{
    const uint8_t raised = nrf24_status();
    if (raised)
        write_register(STATUS, raised);
    return raised;
}

bool nrf24_rx_waiting(void)
{
    return !(read_register(FIFO_STATUS) & RX_EMPTY);
}

uint8_t nrf24_read(uint8_t payload[T3_RADIO_LIMIT])
{
    if (!nrf24_rx_waiting())
        return 0;
    const uint8_t width = send_query(R_RX_PL_WID);
    if (!width || width > T3_RADIO_LIMIT) {
        send_command(FLUSH_RX);
        return width;
    }
    spi_select();
    spi_transfer(R_RX_PAYLOAD);
    for (uint8_t i = 0; i < width; i++)
        payload[i] = spi_transfer(NOP);
    spi_deselect();
    return width;
}

void nrf24_send(const uint8_t *payload, uint8_t size)
{
    write_command(W_TX_PAYLOAD, payload, size);
    set_ce(true);  // until the exchange is over: 10 us would do
}

uint8_t nrf24_finish(void)
{
    const uint8_t retransmits = read_register(OBSERVE_TX) & 0x0F;
    set_ce(false);
    send_command(FLUSH_TX);
    send_command(FLUSH_RX);
    // Last: a chip that gave up begins anew when its flag is gone and a packet still waits.
    write_register(STATUS, FLAGS);
    return retransmits;
}

void nrf24_load_ack(const uint8_t *payload, uint8_t size)
{
    // The chip keeps a payload that was sent until a new packet confirms it, so without the flush
    // a second one queues up, and telemetry is late by one exchange for ever.
    send_command(FLUSH_TX);
    write_command(W_ACK_PAYLOAD, payload, size);
}
