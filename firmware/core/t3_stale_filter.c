// Copyright 2026 The t3mpc_ros developers
// SPDX-License-Identifier: Apache-2.0
#include "t3_stale_filter.h"

#include <string.h>

#include "t3_bytes.h"

void t3_stale_filter_start(struct t3_stale_filter *filter)
{
    memset(filter, 0, sizeof *filter);
}

// Windows change only on reception: after a silence, commands held during all of it are compared with
// the reference before it.
static void update(struct t3_stale_filter *filter, uint32_t received_us, uint32_t delay)
{
    if (!filter->started) {
        filter->started = true;
        filter->window_start = filter->previous_start = received_us;
        filter->minimum = filter->previous_minimum = delay;
    } else if (received_us - filter->window_start >= T3_STALE_WINDOW_US) {
        filter->previous_start = filter->window_start;
        filter->previous_minimum = filter->minimum;
        filter->window_start = received_us;
        filter->minimum = delay;
    } else if (t3_later_by(filter->minimum, delay) > 0) {
        filter->minimum = delay;
    }
}

bool t3_stale_filter_check(struct t3_stale_filter *filter, uint32_t received_us, uint32_t host_us,
                           uint32_t ttl_us)
{
    const uint32_t delay = received_us - host_us;
    update(filter, received_us, delay);
    uint32_t reference = filter->previous_minimum;
    if (t3_later_by(reference, filter->minimum) > 0)
        reference = filter->minimum;
    uint32_t allowed = ttl_us + T3_STALE_SLACK_US;
    // During a silence the clocks drift further, by 0.5 % of its duration as in the slack.
    const uint32_t age = received_us - filter->previous_start;
    if (age > 2 * T3_STALE_WINDOW_US)
        allowed += (age - 2 * T3_STALE_WINDOW_US) / 200;
    return t3_later_by(delay, reference) > (int32_t)allowed;
}
