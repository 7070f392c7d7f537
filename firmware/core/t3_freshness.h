// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
// Finds commands that were held up on their way, from the robot's clock and the host's stamps.
//
// The delay of the fastest command within the last 5 to 10 s counts as the ordinary one; whatever
// takes more than the TTL (and the drift of two clocks) longer is stale. What it cannot see is a
// delay that grows once and stays: after 10 s that is the ordinary one.
#ifndef T3_FRESHNESS_H
#define T3_FRESHNESS_H

#include <stdbool.h>
#include <stdint.h>

#define T3_FRESHNESS_WINDOW_US UINT32_C(5000000)
// Two clocks of 0.5 % drift apart by so much within two windows.
#define T3_FRESHNESS_SLACK_US UINT32_C(50000)

struct t3_freshness {
    bool begun;
    uint32_t since, before_since;  // robot time the current and the previous window began
    uint32_t least, before_least;  // smallest robot time minus host time in each
};

void t3_freshness_start(struct t3_freshness *freshness);

// Take the stamps of a message; return whether it is stale.
bool t3_freshness_stale(struct t3_freshness *freshness, uint32_t received_us, uint32_t host_us,
                        uint32_t ttl_us);

#endif
