# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How well dongle, cable, radio and robot hear each other, without a session: nothing moves."""

from typing import NamedTuple

import numpy as np

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.radio import frames
from t3mpc_ros.radio.bench.errand import (
    Ask,
    Rest,
    Talk,
    ask_radio,
    look_for_dongle,
    set_radio,
)
from t3mpc_ros.radio.codec import decode_up, encode, exchange
from t3mpc_ros.radio.frames import FrameError, Ping, Poll, Pong, Result, State, Status, Transmit
from t3mpc_ros.radio.link.session import absent
from t3mpc_ros.radio.link.settings import LinkSettings
from t3mpc_ros.radio.statistics import LOSS_LIMIT, PERIOD_SHARE, RETRIES

_PATIENCE = 0.25
GOOD, POOR, BAD = 'good', 'poor', 'BAD'
_USB_SLOW = 5e-3
"""s; on the line a PING and its answer take 0.7 ms"""
_MANY_AGAIN = 0.5
"""Tries more per packet: the radio still gets through, with nothing to spare."""


class Probe(NamedTuple):
    """What was seen."""

    asked: int
    """PINGs, and cycles."""
    pings: tuple[float, ...]
    """Round trips, s, of those that were answered."""
    cycles: tuple[float, ...]
    retransmissions: tuple[int, ...]
    """How many packets that were answered needed 0, 1, … 15 tries more."""
    line_errors: int
    """Frames from the host that reached the dongle damaged, meanwhile."""
    state: State | None
    """What the robot said last."""


class Row(NamedTuple):
    """A line of the report."""

    name: str
    seen: str
    verdict: str
    remedy: str = ''


def probe(settings: LinkSettings, count: int) -> Talk[Probe]:
    """Ask ``count`` times over USB and by radio; the radio of the dongle is then as it was."""
    first = yield from look_for_dongle()
    pings = []
    last = first
    for _ in range(count):
        heard = yield Ask(Ping(0, b'ping'), _PATIENCE)
        if isinstance(heard.reply, Pong):
            pings.append(heard.round_trip)
            last = heard.reply
    before = yield from ask_radio()
    cycles: list[float] = []
    tries = [0] * RETRIES
    state = None
    try:
        yield from set_radio(settings.configure(0))
        poll = encode(Poll(0, 0, frames.STATE))
        for _ in range(count):
            heard = yield Ask(Transmit(0, settings.gap, poll, poll), _PATIENCE)
            told = _read(heard.reply, tries)
            if told is not None:
                state = told
                cycles.append(heard.round_trip)
            spent = (heard.returned_ns - heard.sent_ns) / NANOSECONDS
            yield Rest(max(1.0 / settings.cycle_rate - spent, 0.0))
    finally:
        yield from set_radio(before)
    errors = _errors(last) - _errors(first) & 0xFFFF
    return Probe(count, tuple(pings), tuple(cycles), tuple(tries), errors, state)


def _read(reply: object, tries: list[int]) -> State | None:
    """Count the exchanges of a cycle; return the state that one of them fetched.

    Where the first packet needed several tries, the later ones may have fetched the new state, and
    nothing is left for the second.
    """
    if not isinstance(reply, Result):
        return None
    for one in (exchange(reply.first), exchange(reply.second)):
        if one.acknowledged:
            tries[one.retransmissions] += 1
    try:
        told = decode_up(reply.payload)
    except FrameError:
        return None
    return told if isinstance(told, State) else None


def _errors(pong: Pong) -> int:
    return pong.crc_errors + pong.frame_errors + pong.overruns


# -- in words -------------------------------------------------------------------------------------


def judge(seen: Probe, settings: LinkSettings) -> list[Row]:
    """Return the report: each figure with a verdict, and what to try if it is not good."""
    rows = [
        _judge_usb(seen),
        Row(
            'frames damaged on the cable',
            str(seen.line_errors),
            GOOD if not seen.line_errors else POOR,
            'another cable, another USB port, no hub',
        ),
        _judge_losses(seen, settings),
    ]
    if seen.cycles:
        rows += [_judge_retries(seen), _judge_trips(seen, settings)]
    if seen.state is not None:
        rows.append(_judge_robot(seen.state))
    return rows


def is_good(rows: list[Row]) -> bool:
    """Return whether the robot can be driven over this link."""
    return all(row.verdict != BAD for row in rows)


def table(rows: list[Row]) -> str:
    """Return the report as text."""
    name, seen = (max(len(row[column]) for row in rows) for column in (0, 1))
    lines = []
    for row in rows:
        lines.append(f'{row.name:<{name}}  {row.seen:<{seen}}  {row.verdict}')
        if row.verdict != GOOD:
            lines.append(f'  try: {row.remedy}')
    return '\n'.join(lines)


def _trips(trips: tuple[float, ...]) -> str:
    if not trips:
        return ''
    median, slow = 1e3 * np.quantile(trips, [0.5, 0.99])
    return f', {median:.1f} ms (median), {slow:.1f} ms (99 of 100)'


def _judge_usb(seen: Probe) -> Row:
    verdict = GOOD
    if len(seen.pings) < seen.asked or float(np.quantile(seen.pings, 0.99)) > _USB_SLOW:
        verdict = POOR
    if len(seen.pings) < seen.asked * (1.0 - LOSS_LIMIT):
        verdict = BAD
    return Row(
        'dongle answers over USB',
        f'{len(seen.pings)} of {seen.asked}{_trips(seen.pings)}',
        verdict,
        'the latency timer of an FTDI chip at 1 ms (docs/radio.md), another cable, no hub, a '
        'computer that is less busy',
    )


def _judge_losses(seen: Probe, settings: LinkSettings) -> Row:
    share = 1.0 - len(seen.cycles) / seen.asked
    verdict = GOOD if share <= LOSS_LIMIT / 5 else POOR if share <= LOSS_LIMIT else BAD
    remedy = (
        'more than 0.2 m between both, antennas upright and free; 10 uF and 100 nF at both radio '
        'chips; another channel (radio_tool find shows where it answers now); --set power=…; '
        '--set rate=250k with plus chips at both ends'
    )
    if not seen.cycles:
        remedy = f'{absent(settings.channel)} radio_tool find looks on all channels; {remedy}'
    return Row('robot answers by radio', f'{len(seen.cycles)} of {seen.asked}', verdict, remedy)


def _judge_retries(seen: Probe) -> Row:
    tries = seen.retransmissions
    mean = sum(number * count for number, count in enumerate(tries)) / max(sum(tries), 1)
    told = ', '.join(f'{number}: {count}' for number, count in enumerate(tries) if count)
    remedy = 'the same: the radio needs several tries for most packets'
    return Row('tries more per packet', told, GOOD if mean <= _MANY_AGAIN else POOR, remedy)


def _judge_trips(seen: Probe, settings: LinkSettings) -> Row:
    slow = float(np.quantile(seen.cycles, 0.99))
    period = 1.0 / settings.cycle_rate
    verdict = GOOD if slow <= PERIOD_SHARE * period else POOR if slow <= period else BAD
    return Row(
        'round trip to the robot',
        _trips(seen.cycles)[2:],
        verdict,
        f'half a period is {500.0 * period:g} ms: a lower --set cycle_rate, or the latency timer '
        'of the serial port at 1 ms (docs/radio.md)',
    )


def _judge_robot(state: State) -> Row:
    status = Status(state.status)
    troubles = {
        Status.ESTOP: 'its emergency stop is latched',
        Status.IMU_FAULT: 'its inertial sensor does not answer: SDA at 20, SCL at 21, 5 V',
        Status.LOW_BATTERY: 'its battery is low, or its divider is not the one of docs/radio.md',
    }
    found = [text for bit, text in troubles.items() if status & bit]
    session = f'in session {state.session}' if state.session else 'in no session'
    return Row('robot', session, POOR if found else GOOD, '; '.join(found))
