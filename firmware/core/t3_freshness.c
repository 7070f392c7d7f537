// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "t3_freshness.h"

#include <string.h>

#include "t3_bytes.h"

void t3_freshness_start(struct t3_freshness *freshness)
{
    memset(freshness, 0, sizeof *freshness);
}

// Windows change only when a message comes: after a silence, the old minimum is still there to
// find what was held all the while.
static void take(struct t3_freshness *freshness, uint32_t received_us, uint32_t delay)
{
    if (!freshness->begun) {
        freshness->begun = true;
        freshness->since = freshness->before_since = received_us;
        freshness->least = freshness->before_least = delay;
    } else if (received_us - freshness->since >= T3_FRESHNESS_WINDOW_US) {
        freshness->before_since = freshness->since;
        freshness->before_least = freshness->least;
        freshness->since = received_us;
        freshness->least = delay;
    } else if (t3_later_by(freshness->least, delay) > 0) {
        freshness->least = delay;
    }
}

bool t3_freshness_stale(struct t3_freshness *freshness, uint32_t received_us, uint32_t host_us,
                        uint32_t ttl_us)
{
    const uint32_t delay = received_us - host_us;
    take(freshness, received_us, delay);
    uint32_t least = freshness->before_least;
    if (t3_later_by(least, freshness->least) > 0)
        least = freshness->least;
    uint32_t allowed = ttl_us + T3_FRESHNESS_SLACK_US;
    // After a silence the clocks have drifted further; 0.5 % of it, as in the slack.
    const uint32_t age = received_us - freshness->before_since;
    if (age > 2 * T3_FRESHNESS_WINDOW_US)
        allowed += (age - 2 * T3_FRESHNESS_WINDOW_US) / 200;
    return t3_later_by(delay, least) > (int32_t)allowed;
}
