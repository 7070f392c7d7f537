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
#include "clock.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

// Timer 1 counts half microseconds and overflows every 32.768 ms; 17 bits of overflows make the
// 32 bits of microseconds, so they need more than 16 bits of room.
static volatile uint32_t overflows;

ISR(TIMER1_OVF_vect)
{
    overflows++;
}

void clock_start(void)
{
    TCCR1B = _BV(CS11);
    TIMSK1 = _BV(TOIE1);
}

uint32_t clock_us(void)
{
    uint32_t high = 0;
    uint16_t low = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        high = overflows;
        low = TCNT1;
        // An overflow that waits, and was not just after the timer was read.
        if ((TIFR1 & _BV(TOV1)) && low < 0x8000u)
            high++;
    }
    return (high << 15) + (low >> 1);
}
