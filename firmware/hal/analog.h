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

// Eight distance sensors and the battery, one conversion after the other.
#ifndef ANALOG_H
#define ANALOG_H

#include <stdint.h>

void analog_start(void);

// Take what is ready and begin the next conversion. Never waits.
void analog_work(void);

// Return the newest 10-bit count of a channel, T3_ADC_NOT_MEASURED before the first.
uint16_t analog_count(uint8_t channel);

// Return what the lowest bits of all conversions so far have mixed up.
uint32_t analog_noise(void);

#endif
