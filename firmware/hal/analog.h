// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
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
