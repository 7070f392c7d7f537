// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "reset.h"

#include <avr/io.h>
#include <avr/wdt.h>

uint8_t reset_cause __attribute__((section(".noinit")));

void read_reset_cause(void) __attribute__((naked, used, section(".init3")));

void read_reset_cause(void)
{
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
}
