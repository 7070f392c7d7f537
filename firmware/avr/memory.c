// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "memory.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>

#include "t3_store.h"

static uint8_t copy[T3_STORE_END], stored[T3_STORE_END];
static uint8_t next;

void memory_start(void)
{
    eeprom_read_block(stored, 0, sizeof stored);
    memcpy(copy, stored, sizeof copy);
}

void memory_read(uint8_t address, uint8_t *data, uint8_t size)
{
    memcpy(data, copy + address, size);
}

void memory_write(uint8_t address, const uint8_t *data, uint8_t size)
{
    memcpy(copy + address, data, size);
}

bool memory_settled(void)
{
    return !(EECR & _BV(EEPE)) && !memcmp(copy, stored, sizeof copy);
}

void memory_cells(uint8_t address, uint8_t *data, uint8_t size)
{
    eeprom_read_block(stored + address, (const uint8_t *)(uint16_t)address, size);
    memcpy(data, stored + address, size);
}

void memory_work(void)
{
    if (EECR & _BV(EEPE))
        return;
    next = (uint8_t)(next + 1u) < sizeof copy ? (uint8_t)(next + 1u) : 0;
    if (copy[next] == stored[next])
        return;
    eeprom_write_byte((uint8_t *)(uint16_t)next, copy[next]);  // begins it: the EEPROM is ready
    stored[next] = copy[next];
}
