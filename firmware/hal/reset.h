// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Why the chip started. Read before main: after a watchdog reset the watchdog still runs, at its
// shortest time.
#ifndef RESET_H
#define RESET_H

#include <stdint.h>

// MCUSR as it was. A boot loader that clears it leaves 0.
extern uint8_t reset_cause;

#endif
