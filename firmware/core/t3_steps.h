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

// Step pulses of both wheels by direct digital synthesis, in an interrupt at 20 kHz: a 32-bit phase
// per wheel, one step per overflow. Zero crossings are smooth; the resolution is 5e-6 steps/s.
#ifndef T3_STEPS_H
#define T3_STEPS_H

#include <stdbool.h>
#include <stdint.h>

#define T3_TICK_US 50u
// At half the tick rate a pulse is high for one tick and low for at least one.
#define T3_STEP_RATE_LIMIT UINT32_C(10000)

enum { T3_LEFT, T3_RIGHT, T3_WHEELS };

// Levels of the pins. A port writes the directions first, and lowers STEP no later than the next
// tick, which returns it low: longer than the minimum pulse of every driver.
#define T3_PIN_STEP_LEFT 1u
#define T3_PIN_STEP_RIGHT 2u
#define T3_PIN_BACK_LEFT 4u
#define T3_PIN_BACK_RIGHT 8u

struct t3_wheel {
    uint32_t phase;     // 2**32 per microstep
    int32_t increment;  // of the phase per tick
    int32_t count;      // microsteps issued, signed, modulo 2**32
    bool back;          // current direction of the driver
};

// Shared with the interrupt: access elsewhere only between lock and unlock of the port.
struct t3_steps {
    struct t3_wheel wheels[T3_WHEELS];
    uint32_t time_us;     // time of the last tick, modulo 2**32
    uint8_t inverted;     // bit 0 left, bit 1 right: the motor is reversed
    uint32_t top_speed;   // urad/s at the limit of the step rate
    uint32_t gain;        // phase per tick and urad/s, times 2**(32 - gain_shift)
    uint8_t gain_shift;
};

// Reset to zero at rest, for a number of microsteps per revolution of the wheel.
void t3_steps_start(struct t3_steps *steps, uint32_t microsteps_per_rev);

// Change the microsteps per revolution at rest; counters and time continue.
void t3_steps_scale(struct t3_steps *steps, uint32_t microsteps_per_rev);

// Return the increment of a speed in urad/s, limited by the step rate.
int32_t t3_steps_increment(const struct t3_steps *steps, int32_t speed);

// Return whether the wheel steps in this tick. Its direction may have changed.
static inline bool t3_wheel_tick(struct t3_wheel *wheel)
{
    const int32_t increment = wheel->increment;
    if (!increment)
        return false;  // the usual case: at rest a tick takes 128 cycles, not 186
    if ((increment < 0) != wheel->back) {
        // The driver requires a stable direction before a step (DRV8825: 650 ns): step from the
        // next tick on.
        wheel->back = increment < 0;
        return false;
    }
    const uint32_t before = wheel->phase;
    const uint32_t phase = before + (uint32_t)increment;
    wheel->phase = phase;
    if (increment < 0) {
        if (phase <= before)
            return false;
        wheel->count = (int32_t)((uint32_t)wheel->count - 1u);
        return true;
    }
    if (phase >= before)
        return false;
    wheel->count = (int32_t)((uint32_t)wheel->count + 1u);
    return true;
}

// One tick of the interrupt: return the levels of the pins.
static inline uint8_t t3_steps_tick(struct t3_steps *steps)
{
    uint8_t pins = 0;
    steps->time_us += T3_TICK_US;
    if (t3_wheel_tick(&steps->wheels[T3_LEFT]))
        pins |= T3_PIN_STEP_LEFT;
    if (t3_wheel_tick(&steps->wheels[T3_RIGHT]))
        pins |= T3_PIN_STEP_RIGHT;
    if (steps->wheels[T3_LEFT].back)
        pins |= T3_PIN_BACK_LEFT;
    if (steps->wheels[T3_RIGHT].back)
        pins |= T3_PIN_BACK_RIGHT;
    return (uint8_t)(pins ^ (uint8_t)(steps->inverted << 2));
}

// Return the time from values read with interrupts disabled: the time of the last tick, the timer
// since then (us), and whether the next tick is pending. A tick that is pending while the timer is in
// its second half became due after the timer was read.
static inline uint32_t t3_time_us(uint32_t last_tick_us, uint8_t timer_us, bool tick_waits)
{
    const uint32_t now = last_tick_us + timer_us;
    return tick_waits && timer_us < T3_TICK_US / 2 ? now + T3_TICK_US : now;
}

#endif
