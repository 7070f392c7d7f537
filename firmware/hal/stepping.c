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
#include "stepping.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "board.h"

#define PINS (T3_PIN_STEP_LEFT | T3_PIN_STEP_RIGHT | T3_PIN_BACK_LEFT | T3_PIN_BACK_RIGHT)
#define LOOP_TICKS 8u

struct t3_robot robot;

static volatile bool due;

ISR(TIMER0_COMPA_vect)
{
    // A direction changes a whole tick before the first step that needs it, so one write will do.
    const uint8_t pins = t3_steps_tick(&robot.steps);
    STEPPER_PORT = (uint8_t)((STEPPER_PORT & ~PINS) | pins);
    static uint8_t ticks;
    if (++ticks == LOOP_TICKS) {
        ticks = 0;
        due = true;
    }
}

void stepping_pins(void)
{
    STEPPER_PORT = _BV(STEPPER_OFF);
    STEPPER_DDR = PINS | _BV(STEPPER_OFF);
    ESTOP_PORT |= _BV(ESTOP_PULL_UP);
}

void stepping_start(void)
{
    // 2 MHz, cleared every 50 us.
    OCR0A = T3_TICK_US * 2u - 1u;
    TCCR0A = _BV(WGM01);
    TCNT0 = 0;
    TIFR0 = _BV(OCF0A);
    TIMSK0 = _BV(OCIE0A);
    TCCR0B = _BV(CS01);
}

void stepping_power(bool on)
{
    if (on)
        STEPPER_PORT &= (uint8_t)~_BV(STEPPER_OFF);
    else
        STEPPER_PORT |= _BV(STEPPER_OFF);
}

uint32_t stepping_time_us(void)
{
    uint32_t tick_us = 0;
    uint8_t timer = 0;
    bool waits = false;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        tick_us = robot.steps.time_us;
        timer = TCNT0;
        waits = TIFR0 & _BV(OCF0A);
    }
    return t3_time_us(tick_us, timer / 2u, waits);
}

void stepping_lock(void)
{
    cli();
}

void stepping_unlock(void)
{
    sei();
}

bool stepping_due(void)
{
    const bool was = due;
    due = false;
    return was;
}
