# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Finds commands that were held up on their way, from the robot's clock and the host's stamps."""

from t3mpc_ros.radio.clock import move

WINDOW_US = 5_000_000
SLACK_US = 50_000
"""Two clocks of 0.5 % drift apart by so much within two windows."""
_WRAP = 1 << 32


class Freshness:
    """Decides whether a message is stale.

    The delay of the fastest message within the last 5 to 10 s counts as the ordinary one; what
    takes longer than that by the TTL and the slack is stale. Windows change only when a message
    comes: after a silence the old minimum still finds what was held all the while.
    """

    def __init__(self, received_us: int, host_us: int) -> None:
        self._since = self._before_since = received_us
        self._least = self._before_least = (received_us - host_us) % _WRAP

    def is_stale(self, received_us: int, host_us: int, ttl_us: int) -> bool:
        """Take the stamps of a message (us) and decide."""
        delay = (received_us - host_us) % _WRAP
        if received_us - self._since >= WINDOW_US:
            self._before_since, self._before_least = self._since, self._least
            self._since, self._least = received_us, delay
        elif move(delay, self._least) > 0:
            self._least = delay
        least = self._before_least
        if move(self._least, least) > 0:
            least = self._least
        # After a silence the clocks have drifted further: 0.5 % of it, as in the slack.
        silence = max(received_us - self._before_since - 2 * WINDOW_US, 0)
        return move(least, delay) > ttl_us + SLACK_US + silence // 200
