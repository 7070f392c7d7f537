// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Detects commands held up on their way, from the clock of the robot and the stamps of the host.
//
// The reference is the smallest delay of the last 5 to 10 s; a command is stale if its delay exceeds
// the reference by more than the TTL and the slack. A constant additional delay becomes the new
// reference after 10 s.
#ifndef T3_STALE_FILTER_H
#define T3_STALE_FILTER_H

#include <stdbool.h>
#include <stdint.h>

#define T3_STALE_WINDOW_US UINT32_C(5000000)
// Drift of two clocks that differ by 0.5 % within two windows.
#define T3_STALE_SLACK_US UINT32_C(50000)

struct t3_stale_filter {
    bool started;
    // Of the current and the previous window: robot time of its start, smallest robot - host time.
    uint32_t window_start, previous_start;
    uint32_t minimum, previous_minimum;
};

void t3_stale_filter_start(struct t3_stale_filter *filter);

// Return whether a command is stale, and update the reference.
bool t3_stale_filter_check(struct t3_stale_filter *filter, uint32_t received_us, uint32_t host_us,
                           uint32_t ttl_us);

#endif
