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
#include "t3_store.h"

#include <string.h>

#include "t3_bytes.h"
#include "t3_protocol.h"

#define ROOM T3_STORE_RECORD_LIMIT

static bool blank(const uint8_t *data, uint8_t size)
{
    while (size--)
        if (*data++ != 0xFF)
            return false;
    return true;
}

enum t3_record t3_store_read(const struct t3_port *port, uint16_t address, uint8_t *data,
                             uint8_t size)
{
    uint8_t record[ROOM];
    port->eeprom_read(port->context, address, record, (uint8_t)(size + T3_CRC_SIZE));
    if (blank(record, (uint8_t)(size + T3_CRC_SIZE)))
        return T3_RECORD_BLANK;
    if (t3_crc16(record, size) != t3_get16(record + size))
        return T3_RECORD_DAMAGED;
    memcpy(data, record, size);
    return T3_RECORD_GOOD;
}

void t3_store_write(const struct t3_port *port, uint16_t address, const uint8_t *data,
                    uint8_t size)
{
    uint8_t record[ROOM];
    memcpy(record, data, size);
    t3_put16(record + size, t3_crc16(data, size));
    port->eeprom_write(port->context, address, record, (uint8_t)(size + T3_CRC_SIZE));
}

void t3_store_erase(const struct t3_port *port, uint16_t address, uint8_t size)
{
    uint8_t record[ROOM];
    memset(record, 0xFF, sizeof record);
    port->eeprom_write(port->context, address, record, (uint8_t)(size + T3_CRC_SIZE));
}

bool t3_store_verify(const struct t3_port *port, const struct t3_console_port *console,
                     uint16_t address, uint8_t size)
{
    uint8_t wanted[ROOM], found[ROOM];
    port->eeprom_read(port->context, address, wanted, size);
    console->eeprom_cells(console->context, address, found, size);
    if (!memcmp(wanted, found, size))
        return true;
    port->eeprom_write(port->context, address, found, size);
    return false;
}
