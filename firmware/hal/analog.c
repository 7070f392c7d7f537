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
#include "analog.h"

#include <avr/io.h>

#include "t3_port.h"

#define CHANNELS (T3_ADC_BATTERY + 1u)

static uint16_t counts[CHANNELS];
static uint8_t channel;
static uint32_t mixture;

static void begin(void)
{
    // Against the supply of 5 V, which the sensors hang on too. Channel 8 needs a bit elsewhere.
    ADMUX = (uint8_t)(_BV(REFS0) | (channel & 7u));
    ADCSRB = channel & 8u ? _BV(MUX5) : 0;
    ADCSRA |= _BV(ADSC);
}

void analog_start(void)
{
    for (uint8_t i = 0; i < CHANNELS; i++)
        counts[i] = T3_ADC_NOT_MEASURED;
    // No digital inputs on pins that carry half a supply.
    DIDR0 = 0xFF;
    DIDR2 = _BV(ADC8D);
    // 125 kHz: a conversion takes 104 us.
    ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0);
    begin();
}

void analog_work(void)
{
    if (ADCSRA & _BV(ADSC))
        return;
    const uint16_t count = ADC;
    counts[channel] = count;
    mixture = (mixture << 1 | mixture >> 31) ^ count ^ (uint32_t)TCNT0 << 16;
    // A remainder is a loop of 200 cycles on the AVR, and this is called in each pass.
    if (++channel == CHANNELS)
        channel = 0;
    begin();
}

uint16_t analog_count(uint8_t which)
{
    return counts[which];
}

uint32_t analog_noise(void)
{
    return mixture;
}
