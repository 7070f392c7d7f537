# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where the robot answers: a POLL, which changes nothing, on every channel at each rate."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from t3mpc_ros.radio import frames
from t3mpc_ros.radio.bench.errand import (
    Ask,
    ErrandError,
    Talk,
    ask_radio,
    look_for_dongle,
    set_radio,
)
from t3mpc_ros.radio.codec import encode, exchange
from t3mpc_ros.radio.frames import Poll, Result, Transmit
from t3mpc_ros.radio.link.settings import LinkSettings

CHANNELS = 126
_TRIES = 2
"""Of a channel, each with the retransmissions of the radio."""
_SURE = 20
"""More of one that answers."""
_PATIENCE = 0.25
"""s; fifteen retransmissions at 250 kbit/s take 60 ms"""

Progress = Callable[[int, int, str], None]
"""Told how many of how many channels are done, and what was found last."""


class Place(NamedTuple):
    """Where the robot answered."""

    channel: int
    rate: str
    answered: int
    """Of ``asked`` packets."""
    asked: int
    retransmissions: float
    """Per packet that was answered."""


def find_robot(
    settings: LinkSettings, rates: Sequence[str], progress: Progress
) -> Talk[list[Place]]:
    """Return where the robot answers; the radio of the dongle is then set as it was."""
    yield from look_for_dongle()
    before = yield from ask_radio()
    found: list[Place] = []
    try:
        total = CHANNELS * len(rates)
        for number in range(total):
            rate, channel = rates[number // CHANNELS], number % CHANNELS
            place = yield from _try(replace(settings, channel=channel, rate=rate))
            if place is not None:
                found.append(place)
            progress(number + 1, total, '' if place is None else describe(place))
    finally:
        yield from set_radio(before)
    return found


def _try(settings: LinkSettings) -> Talk[Place | None]:
    yield from set_radio(settings.configure(0))
    asked = answered = again = 0
    while asked < (_TRIES if not answered else _SURE):
        heard = yield Ask(Transmit(0, 0, encode(Poll(0, 0, frames.STATE))), _PATIENCE)
        if not isinstance(heard.reply, Result):
            raise ErrandError('the dongle has fallen silent: was it restarted?')
        one = exchange(heard.reply.first)
        asked += 1
        answered += one.acknowledged
        again += one.retransmissions if one.acknowledged else 0
    if not answered:
        return None
    return Place(settings.channel, settings.rate, answered, asked, again / answered)


def describe(place: Place) -> str:
    """Return a place in words."""
    return (
        f'channel {place.channel} at {place.rate}: {place.answered} of {place.asked} packets '
        f'answered, {place.retransmissions:.1f} tries more each'
    )


def advise(found: Sequence[Place], settings: LinkSettings) -> tuple[bool, str]:
    """Return whether the robot is where the settings look for it, and what to do."""
    if not found:
        return False, (
            'the robot answers nowhere. Try: is it on, does its radio have 3.3 V with 10 uF next '
            'to it, is the address the same at both ends, another --set rate=…; the dongle less '
            'than 1 m away but more than 0.2 m; an antenna that is not touched'
        )
    here = [place for place in found if (place.channel, place.rate) == _where(settings)]
    if not here:
        best = max(found, key=lambda place: place.answered / place.asked)
        return False, (
            f'the robot is on another channel or rate than the settings say: set link.channel to '
            f"{best.channel} and link.rate to '{best.rate}', or build its firmware for "
            f'{settings.channel} at {settings.rate}'
        )
    if here[0].answered < here[0].asked:
        return True, 'the robot is where it is looked for; radio_tool ping says how well it hears'
    return True, 'the robot is where it is looked for'


def _where(settings: LinkSettings) -> tuple[int, str]:
    return settings.channel, settings.rate
