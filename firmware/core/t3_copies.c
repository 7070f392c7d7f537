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
#include "t3_copies.h"

#include <string.h>

#include "t3_bytes.h"

#define INVALID 0xFFu

static uint8_t body_size(const struct t3_copies_kind *kind)
{
    return (uint8_t)(kind->size - T3_CRC_SIZE);
}

static enum t3_record read_copy(const struct t3_copies_kind *kind, const struct t3_port *port,
                                uint16_t address, uint8_t *body)
{
    const enum t3_record found = t3_store_read(port, address, body, body_size(kind));
    if (found != T3_RECORD_GOOD)
        return found;
    return body[0] == kind->format && kind->valid(body) ? T3_RECORD_GOOD : T3_RECORD_DAMAGED;
}

static void begin_copy(struct t3_copies *copies, const struct t3_port *port, uint16_t address)
{
    static const uint8_t invalid = INVALID;
    copies->at = address;
    copies->step = T3_COPIES_OPENED;
    port->eeprom_write(port->context, address, &invalid, 1);
}

static void seal(struct t3_copies *copies)
{
    const uint8_t size = body_size(copies->kind);
    t3_put16(copies->record + size, t3_crc16(copies->record, size));
}

bool t3_copies_boot(struct t3_copies *copies, const struct t3_copies_kind *kind,
                    const struct t3_port *port)
{
    memset(copies, 0, sizeof *copies);
    copies->kind = kind;
    uint8_t other[T3_STORE_RECORD_LIMIT];
    const enum t3_record one = read_copy(kind, port, kind->first, copies->record);
    const enum t3_record two = read_copy(kind, port, kind->second, other);
    if (one != T3_RECORD_GOOD && two != T3_RECORD_GOOD) {
        const bool blank = one == T3_RECORD_BLANK && two == T3_RECORD_BLANK;
        copies->state = blank ? T3_SETTINGS_MISSING : T3_SETTINGS_DAMAGED;
        return false;
    }
    if (one != T3_RECORD_GOOD)
        memcpy(copies->record, other, body_size(kind));
    seal(copies);
    copies->state = T3_SETTINGS_GOOD;
    const uint16_t repaired = one == T3_RECORD_GOOD ? kind->second : kind->first;
    port->eeprom_read(port->context, repaired, other, kind->size);
    if (memcmp(other, copies->record, kind->size) != 0) {
        copies->state = T3_SETTINGS_ONE_COPY;
        copies->left = 1;
        begin_copy(copies, port, repaired);
    }
    return true;
}

void t3_copies_write(struct t3_copies *copies, const struct t3_port *port, const uint8_t *body)
{
    const struct t3_copies_kind *kind = copies->kind;
    const bool one = read_copy(kind, port, kind->first, copies->record) == T3_RECORD_GOOD;
    const bool two = read_copy(kind, port, kind->second, copies->record) == T3_RECORD_GOOD;
    copies->state = T3_SETTINGS_DAMAGED;
    copies->left = 2;
    memcpy(copies->record, body, body_size(kind));
    seal(copies);
    // The only valid copy is the last to change. Of two, the first is the one that counts at boot.
    begin_copy(copies, port, one && !two ? kind->second : kind->first);
}

static enum t3_progress finish(struct t3_copies *copies, enum t3_progress how)
{
    copies->step = T3_COPIES_IDLE;
    if (how == T3_PROGRESS_DONE)
        copies->state = T3_SETTINGS_GOOD;
    return how;
}

enum t3_progress t3_copies_tick(struct t3_copies *copies, const struct t3_port *port,
                                const struct t3_console_port *console)
{
    const struct t3_copies_kind *kind = copies->kind;
    if (copies->step == T3_COPIES_IDLE || !console->eeprom_settled(console->context))
        return T3_PROGRESS_NONE;
    if (!t3_store_verify(port, console, copies->at, kind->size))
        return finish(copies, T3_PROGRESS_FAILED);
    switch (copies->step) {
    case T3_COPIES_OPENED:
        copies->step = T3_COPIES_FILLED;
        port->eeprom_write(port->context, (uint16_t)(copies->at + 1u), copies->record + 1,
                           (uint8_t)(kind->size - 1u));
        return T3_PROGRESS_NONE;
    case T3_COPIES_FILLED:
        copies->step = T3_COPIES_CLOSED;
        port->eeprom_write(port->context, copies->at, copies->record, 1);
        return T3_PROGRESS_NONE;
    default:
        break;
    }
    if (!--copies->left)
        return finish(copies, T3_PROGRESS_DONE);
    begin_copy(copies, port, copies->at == kind->first ? kind->second : kind->first);
    return T3_PROGRESS_NONE;
}
