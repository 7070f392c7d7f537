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
#include "memory.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <string.h>

#include "t3_store.h"

static uint8_t copy[T3_STORE_END], stored[T3_STORE_END];
// Only these cells may differ from what the core has written.
static uint16_t first, end;
#define CELLS_PER_PASS 16u

void memory_start(void)
{
    eeprom_read_block(stored, 0, sizeof stored);
    memcpy(copy, stored, sizeof copy);
}

void memory_read(uint16_t address, uint8_t *data, uint8_t size)
{
    memcpy(data, copy + address, size);
}

void memory_write(uint16_t address, const uint8_t *data, uint8_t size)
{
    memcpy(copy + address, data, size);
    if (first == end) {
        first = address;
        end = address;
    }
    if (address < first)
        first = address;
    if ((uint16_t)(address + size) > end)
        end = (uint16_t)(address + size);
}

bool memory_settled(void)
{
    return !(EECR & _BV(EEPE)) && first == end;
}

void memory_cells(uint16_t address, uint8_t *data, uint8_t size)
{
    eeprom_read_block(stored + address, (const uint8_t *)address, size);
    memcpy(data, stored + address, size);
}

void memory_work(void)
{
    if (EECR & _BV(EEPE))
        return;
    for (uint8_t i = 0; i < CELLS_PER_PASS && first != end; i++) {
        const uint16_t cell = first++;
        if (copy[cell] == stored[cell])
            continue;
        eeprom_write_byte((uint8_t *)cell, copy[cell]);  // begins it: the EEPROM is ready
        stored[cell] = copy[cell];
        return;
    }
}
