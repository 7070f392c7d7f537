# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Channel scan: the channels and rates on which the robot answers a POLL."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_exchange_status, encode
from t3mpc_ros.radio.protocol.frames import Poll, Result, Transmit
from t3mpc_ros.radio.tool.procedure import (
    ProcedureError,
    Request,
    Script,
    configure_radio,
    read_radio_setup,
    wait_for_dongle,
)

CHANNELS = 126
_MIN_PACKETS = 2
"""Of a channel, each with the retransmissions of the radio."""
_PACKETS = 20
"""More of one that answers."""
_REPLY_TIMEOUT = 0.25
"""s; fifteen retransmissions at 250 kbit/s take 60 ms"""

Progress = Callable[[int, int, str], None]
"""Told how many of how many channels are done, and what was found last."""


class ChannelResult(NamedTuple):
    """Where the robot answered."""

    channel: int
    rate: str
    answered: int
    """Of ``asked`` packets."""
    asked: int
    retransmissions: float
    """Per packet that was answered."""


def scan_channels(
    parameters: LinkParameters, rates: Sequence[str], progress: Progress
) -> Script[list[ChannelResult]]:
    """Return where the robot answers; the radio of the dongle is then set as it was."""
    yield from wait_for_dongle()
    before = yield from read_radio_setup()
    found: list[ChannelResult] = []
    try:
        total = CHANNELS * len(rates)
        for number in range(total):
            rate, channel = rates[number // CHANNELS], number % CHANNELS
            place = yield from _test_channel(replace(parameters, channel=channel, rate=rate))
            if place is not None:
                found.append(place)
            progress(number + 1, total, '' if place is None else format_channel(place))
    finally:
        yield from configure_radio(before)
    return found


def _test_channel(parameters: LinkParameters) -> Script[ChannelResult | None]:
    yield from configure_radio(parameters.configure(0))
    asked = answered = again = 0
    while asked < (_MIN_PACKETS if not answered else _PACKETS):
        heard = yield Request(Transmit(0, 0, encode(Poll(0, 0, frames.STATE))), _REPLY_TIMEOUT)
        if not isinstance(heard.reply, Result):
            raise ProcedureError('the dongle has fallen silent: was it restarted?')
        one = decode_exchange_status(heard.reply.first)
        asked += 1
        answered += one.acknowledged
        again += one.retransmissions if one.acknowledged else 0
    if not answered:
        return None
    return ChannelResult(parameters.channel, parameters.rate, answered, asked, again / answered)


def format_channel(place: ChannelResult) -> str:
    """Return a place in words."""
    return (
        f'channel {place.channel} at {place.rate}: {place.answered} of {place.asked} packets '
        f'answered, {place.retransmissions:.1f} tries more each'
    )


def recommend(found: Sequence[ChannelResult], parameters: LinkParameters) -> tuple[bool, str]:
    """Return whether the robot is where the settings look for it, and what to do."""
    if not found:
        return False, (
            'the robot answers nowhere. Try: is it on, does its radio have 3.3 V with 10 uF next '
            'to it, is the address the same at both ends, another --set rate=…; the dongle less '
            'than 1 m away but more than 0.2 m; an antenna that is not touched'
        )
    here = [
        place for place in found if (place.channel, place.rate) == _configured_channel(parameters)
    ]
    if not here:
        best = max(found, key=lambda place: place.answered / place.asked)
        return False, (
            f'the robot is on another channel or rate than the settings say: set link.channel to '
            f"{best.channel} and link.rate to '{best.rate}', or build its firmware for "
            f'{parameters.channel} at {parameters.rate}'
        )
    if here[0].answered < here[0].asked:
        return True, 'the robot is where it is looked for; t3mpc robot ping says how well it hears'
    return True, 'the robot is where it is looked for'


def _configured_channel(parameters: LinkParameters) -> tuple[int, str]:
    return parameters.channel, parameters.rate
