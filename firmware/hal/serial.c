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
#include "serial.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "board.h"

// Rings of 256 bytes: their indices wrap by themselves.
static volatile uint8_t in[256], out[256];
static volatile uint8_t in_head, in_tail, out_head, out_tail;
static volatile uint8_t lost;

ISR(SERIAL_RX_VECTOR)
{
    const bool overrun = UCSR0A & _BV(DOR0);  // before the data: reading them clears it
    const uint8_t byte = UDR0;
    const uint8_t next = (uint8_t)(in_head + 1);
    if (overrun && lost < UINT8_MAX)
        lost++;
    in[in_head] = byte;
    in_head = next;
    // The buffer is full: further bytes are lost, and cost no time.
    if ((uint8_t)(next - in_tail) >= SERIAL_ROOM)
        UCSR0B &= (uint8_t)~_BV(RXCIE0);
}

ISR(SERIAL_EMPTY_VECTOR)
{
    if (out_head == out_tail) {
        UCSR0B &= (uint8_t)~_BV(UDRIE0);
        return;
    }
    UDR0 = out[out_tail];
    out_tail = (uint8_t)(out_tail + 1);
}

void serial_start(void)
{
    UBRR0 = 3;
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);
}

bool serial_waits(void)
{
    return in_head != in_tail;
}

bool serial_take(uint8_t *byte)
{
    if (!serial_waits())
        return false;
    *byte = in[in_tail];
    in_tail = (uint8_t)(in_tail + 1);
    if (!(UCSR0B & _BV(RXCIE0))) {
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
        {
            UCSR0B |= _BV(RXCIE0);
        }
    }
    return true;
}

void serial_write(const uint8_t *data, uint8_t size)
{
    // Half a frame would only cost the host time.
    if (size > (uint8_t)(out_tail - out_head - 1))
        return;
    uint8_t head = out_head;
    while (size--)
        out[head++] = *data++;
    out_head = head;  // only now: the interrupt must not see a byte before it is there
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        UCSR0B |= _BV(UDRIE0);
    }
}

uint8_t serial_lost(void)
{
    uint8_t count = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        count = lost;
        lost = 0;
    }
    return count;
}
