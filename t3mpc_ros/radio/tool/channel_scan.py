# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Channel scan: which radio channels answer, how well, and which one to take."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_exchange_status, encode
from t3mpc_ros.radio.tool import procedure
from t3mpc_ros.radio.tool.link_test import REPLY_TIMEOUT

CHANNELS = 126
_MIN_PACKETS = 2  # packets per channel, each with the retransmissions of the radio
_PACKETS = 20  # packets on a channel that answers
Progress = Callable[[int, int, str], None]
"""Receives the number of tested channels, the total, and the text of a new result."""


class ChannelResult(NamedTuple):
    """Channel and rate on which the robot answered."""

    channel: int
    rate: str
    answered: int
    packets: int
    retransmissions: float  # mean per answered packet


def scan_channels(
    parameters: LinkParameters, rates: Sequence[str], progress: Progress
) -> procedure.Script[list[ChannelResult]]:
    """Return where the robot answers; restore the radio configuration of the dongle."""
    yield from procedure.wait_for_dongle()
    before = yield from procedure.read_radio_setup()
    results: list[ChannelResult] = []
    try:
        total = CHANNELS * len(rates)
        for number in range(total):
            rate, channel = rates[number // CHANNELS], number % CHANNELS
            result = yield from _test_channel(replace(parameters, channel=channel, rate=rate))
            if result is not None:
                results.append(result)
            progress(number + 1, total, '' if result is None else format_channel(result))
    finally:
        yield from procedure.configure_radio(before)
    return results


def _test_channel(parameters: LinkParameters) -> procedure.Script[ChannelResult | None]:
    yield from procedure.configure_radio(parameters.configure(0))
    packets = answered = retransmissions = 0
    while packets < (_MIN_PACKETS if not answered else _PACKETS):
        response = yield procedure.Request(
            frames.Transmit(0, 0, encode(frames.Poll(0, 0, frames.STATE))), REPLY_TIMEOUT
        )
        if not isinstance(response.reply, frames.Result):
            raise procedure.ProcedureError(reasons.DONGLE_TIMEOUT)
        status = decode_exchange_status(response.reply.first)
        packets += 1
        answered += status.acknowledged
        retransmissions += status.retransmissions if status.acknowledged else 0
    if not answered:
        return None
    mean = retransmissions / answered
    return ChannelResult(parameters.channel, parameters.rate, answered, packets, mean)


def format_channel(result: ChannelResult) -> str:
    """Return the result of a channel as text."""
    return (
        f'channel {result.channel} at {result.rate}: {result.answered} of {result.packets} '
        f'packets answered, {result.retransmissions:.1f} retransmissions each'
    )


def recommend(results: Sequence[ChannelResult], parameters: LinkParameters) -> tuple[bool, str]:
    """Return whether the robot answers on the configured channel, and a recommendation."""
    if not results:
        return False, (
            'the robot answers on no channel. Check: robot switched on; 3.3 V and 10 uF at its '
            'radio; same address at both ends; another --set rate=…; distance 0.2 to 1 m; '
            'antenna free'
        )
    expected = parameters.channel, parameters.rate
    configured = [result for result in results if (result.channel, result.rate) == expected]
    if not configured:
        best = max(results, key=lambda result: result.answered / result.packets)
        return False, (
            'the robot is on another channel or rate than configured: set link.channel to '
            f"{best.channel} and link.rate to '{best.rate}', or build its firmware for "
            f'{parameters.channel} at {parameters.rate}'
        )
    if configured[0].answered < configured[0].packets:
        return True, 'the robot answers as configured; t3mpc robot ping measures the link quality'
    return True, 'the robot answers as configured'
