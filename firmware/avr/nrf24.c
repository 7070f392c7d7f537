// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
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
#define FLAGS (NRF24_RECEIVED | NRF24_SENT | NRF24_GAVE_UP)

// Inline: the call would take longer than the byte.
static inline __attribute__((always_inline)) uint8_t swap(uint8_t byte)
{
    SPDR = byte;
    while (!(SPSR & _BV(SPIF)))
        ;
    return SPDR;
}

static void select(void)
{
    SPI_PORT &= (uint8_t)~_BV(RADIO_CSN);
}

static void release(void)
{
    SPI_PORT |= _BV(RADIO_CSN);
}

static void enable(bool on)
{
    if (on)
        SPI_PORT |= _BV(RADIO_CE);
    else
        SPI_PORT &= (uint8_t)~_BV(RADIO_CE);
}

// Return the status register.
static uint8_t command(uint8_t code)
{
    select();
    const uint8_t status = swap(code);
    release();
    return status;
}

static uint8_t ask(uint8_t code)
{
    select();
    swap(code);
    const uint8_t value = swap(NOP);
    release();
    return value;
}

static void write_command(uint8_t code, const uint8_t *data, uint8_t size)
{
    select();
    swap(code);
    while (size--)
        swap(*data++);
    release();
}

static void set(uint8_t reg, uint8_t value)
{
    write_command((uint8_t)(W_REGISTER | reg), &value, 1);
}

static uint8_t get(uint8_t reg)
{
    return ask((uint8_t)(R_REGISTER | reg));
}

static uint8_t config_of(enum nrf24_role role)
{
    // The robot's IRQ means one thing: a packet came.
    return role == NRF24_HOST ? EN_CRC | CRCO | PWR_UP
                              : MASK_TX_DS | MASK_MAX_RT | EN_CRC | CRCO | PWR_UP | PRIM_RX;
}

static uint8_t setup_of(const struct t3_radio_settings *settings)
{
    static const uint8_t RATES[] = {0x20, 0x00, 0x08};
    return (uint8_t)(RATES[settings->rate] | settings->power << 1);
}

static uint8_t retries_of(const struct t3_radio_settings *settings)
{
    return (uint8_t)(settings->retry_delay << 4 | settings->retries);
}

void nrf24_start(void)
{
    release();
    enable(false);
    SPI_DDR |= _BV(SPI_SCK) | _BV(SPI_MOSI) | _BV(RADIO_CSN) | _BV(RADIO_CE);
    // 8 MHz; the chip takes 10. Mode 0, highest bit first.
    SPCR = _BV(SPE) | _BV(MSTR);
    SPSR = _BV(SPI2X);
    RADIO_IRQ_SETUP();
}

static void allow_features(void)
{
    const uint8_t wanted = EN_DPL | EN_ACK_PAY;
    set(FEATURE, wanted);
    if (get(FEATURE) == wanted)
        return;
    // On the chip without plus they are hidden until ACTIVATE; a second ACTIVATE hides them again.
    const uint8_t key = 0x73;
    write_command(ACTIVATE, &key, 1);
    set(FEATURE, wanted);
}

static bool holds_address(const uint8_t *address)
{
    bool same = true;
    select();
    swap(R_REGISTER | TX_ADDR);
    for (uint8_t i = 0; i < 5; i++)
        same = swap(NOP) == address[i] && same;
    release();
    return same;
}

bool nrf24_configure(const struct t3_radio_settings *settings, enum nrf24_role role, bool *waking)
{
    enable(false);
    *waking = !(get(CONFIG) & PWR_UP);
    set(CONFIG, config_of(role));
    set(EN_AA, PIPE_0);
    set(EN_RXADDR, PIPE_0);
    set(SETUP_AW, FIVE_BYTES);
    set(SETUP_RETR, retries_of(settings));
    set(RF_CH, settings->channel);
    set(RF_SETUP, setup_of(settings));
    write_command(W_REGISTER | RX_ADDR_P0, settings->address, 5);
    write_command(W_REGISTER | TX_ADDR, settings->address, 5);
    allow_features();
    set(DYNPD, PIPE_0);
    command(FLUSH_TX);
    command(FLUSH_RX);
    set(STATUS, FLAGS);
    return nrf24_holds(settings, role);
}

bool nrf24_holds(const struct t3_radio_settings *settings, enum nrf24_role role)
{
    return get(CONFIG) == config_of(role) && get(EN_AA) == PIPE_0 &&
           get(SETUP_RETR) == retries_of(settings) && get(RF_CH) == settings->channel &&
           get(RF_SETUP) == setup_of(settings) && get(FEATURE) == (EN_DPL | EN_ACK_PAY) &&
           get(DYNPD) == PIPE_0 && holds_address(settings->address);
}

void nrf24_listen(void)
{
    enable(true);
}

uint8_t nrf24_flags(void)
{
    return command(NOP) & FLAGS;
}

uint8_t nrf24_take_flags(void)
{
    const uint8_t raised = nrf24_flags();
    if (raised)
        set(STATUS, raised);
    return raised;
}

bool nrf24_waits(void)
{
    return !(get(FIFO_STATUS) & RX_EMPTY);
}

uint8_t nrf24_read(uint8_t payload[T3_RADIO_LIMIT])
{
    if (!nrf24_waits())
        return 0;
    const uint8_t width = ask(R_RX_PL_WID);
    if (!width || width > T3_RADIO_LIMIT) {
        command(FLUSH_RX);
        return width;
    }
    select();
    swap(R_RX_PAYLOAD);
    for (uint8_t i = 0; i < width; i++)
        payload[i] = swap(NOP);
    release();
    return width;
}

void nrf24_send(const uint8_t *payload, uint8_t size)
{
    write_command(W_TX_PAYLOAD, payload, size);
    enable(true);  // until the exchange is over: 10 us would do
}

uint8_t nrf24_finish(void)
{
    const uint8_t retransmits = get(OBSERVE_TX) & 0x0F;
    enable(false);
    command(FLUSH_TX);
    command(FLUSH_RX);
    // Last: a chip that gave up begins anew when its flag is gone and a packet still waits.
    set(STATUS, FLAGS);
    return retransmits;
}

void nrf24_answer(const uint8_t *payload, uint8_t size)
{
    // The chip keeps a payload that was sent until a new packet confirms it, so without the flush
    // a second one queues up, and telemetry is late by one exchange for ever.
    command(FLUSH_TX);
    write_command(W_ACK_PAYLOAD, payload, size);
}
