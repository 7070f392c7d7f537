# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Link test: quality of cable, dongle, radio and robot, measured without a session."""

from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.statistics import LOSS_LIMIT, RETRY_COUNTS, ROUND_TRIP_LIMIT
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_exchange_status, decode_uplink, encode
from t3mpc_ros.radio.protocol.frames import (
    FrameError,
    Ping,
    Poll,
    Pong,
    Result,
    State,
    StatusFlag,
    Transmit,
)
from t3mpc_ros.radio.tool.procedure import (
    Pause,
    Request,
    Script,
    configure_radio,
    read_radio_setup,
    wait_for_dongle,
)

_REPLY_TIMEOUT = 0.25
GOOD, POOR, BAD = 'good', 'poor', 'BAD'
_MAX_USB_ROUND_TRIP = 5e-3
"""s; on the line a PING and its answer take 0.7 ms"""
_MAX_MEAN_RETRIES = 0.5
"""Tries more per packet: the radio still gets through, with nothing to spare."""


class LinkTestResult(NamedTuple):
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


class ReportRow(NamedTuple):
    """A line of the report."""

    name: str
    seen: str
    verdict: str
    remedy: str = ''


def run_link_test(parameters: LinkParameters, count: int) -> Script[LinkTestResult]:
    """Ask ``count`` times over USB and by radio; the radio of the dongle is then as it was."""
    first = yield from wait_for_dongle()
    pings = []
    last = first
    for _ in range(count):
        heard = yield Request(Ping(0, b'ping'), _REPLY_TIMEOUT)
        if isinstance(heard.reply, Pong):
            pings.append(heard.round_trip)
            last = heard.reply
    before = yield from read_radio_setup()
    cycles: list[float] = []
    tries = [0] * RETRY_COUNTS
    state = None
    try:
        yield from configure_radio(parameters.configure(0))
        poll = encode(Poll(0, 0, frames.STATE))
        for _ in range(count):
            heard = yield Request(Transmit(0, parameters.gap, poll, poll), _REPLY_TIMEOUT)
            told = _read_state(heard.reply, tries)
            if told is not None:
                state = told
                cycles.append(heard.round_trip)
            spent = (heard.returned_ns - heard.sent_ns) / NANOSECONDS
            yield Pause(max(1.0 / parameters.cycle_rate - spent, 0.0))
    finally:
        yield from configure_radio(before)
    errors = _line_errors(last) - _line_errors(first) & 0xFFFF
    return LinkTestResult(count, tuple(pings), tuple(cycles), tuple(tries), errors, state)


def _read_state(reply: object, tries: list[int]) -> State | None:
    """Count the exchanges of a cycle; return the state that one of them fetched.

    Where the first packet needed several tries, the later ones may have fetched the new state, and
    nothing is left for the second.
    """
    if not isinstance(reply, Result):
        return None
    for one in (decode_exchange_status(reply.first), decode_exchange_status(reply.second)):
        if one.acknowledged:
            tries[one.retransmissions] += 1
    try:
        told = decode_uplink(reply.payload)
    except FrameError:
        return None
    return told if isinstance(told, State) else None


def _line_errors(pong: Pong) -> int:
    return pong.crc_errors + pong.frame_errors + pong.overruns


# -- in words -------------------------------------------------------------------------------------


def evaluate(seen: LinkTestResult, parameters: LinkParameters) -> list[ReportRow]:
    """Return the report: each figure with a verdict, and what to try if it is not good."""
    rows = [
        _evaluate_usb(seen),
        ReportRow(
            'frames damaged on the cable',
            str(seen.line_errors),
            GOOD if not seen.line_errors else POOR,
            'another cable, another USB port, no hub',
        ),
        _evaluate_losses(seen, parameters),
    ]
    if seen.cycles:
        rows += [_evaluate_retries(seen), _evaluate_round_trips(seen, parameters)]
    if seen.state is not None:
        rows.append(_evaluate_robot(seen.state))
    return rows


def is_usable(rows: list[ReportRow]) -> bool:
    """Return whether the robot can be driven over this link."""
    return all(row.verdict != BAD for row in rows)


def format_report(rows: list[ReportRow]) -> str:
    """Return the report as text."""
    name, seen = (max(len(row[column]) for row in rows) for column in (0, 1))
    lines = []
    for row in rows:
        lines.append(f'{row.name:<{name}}  {row.seen:<{seen}}  {row.verdict}')
        if row.verdict != GOOD:
            lines.append(f'  try: {row.remedy}')
    return '\n'.join(lines)


def _format_trips(trips: tuple[float, ...]) -> str:
    if not trips:
        return ''
    median, slow = 1e3 * np.quantile(trips, [0.5, 0.99])
    return f', {median:.1f} ms (median), {slow:.1f} ms (99 of 100)'


def _evaluate_usb(seen: LinkTestResult) -> ReportRow:
    verdict = GOOD
    if len(seen.pings) < seen.asked or float(np.quantile(seen.pings, 0.99)) > _MAX_USB_ROUND_TRIP:
        verdict = POOR
    if len(seen.pings) < seen.asked * (1.0 - LOSS_LIMIT):
        verdict = BAD
    return ReportRow(
        'dongle answers over USB',
        f'{len(seen.pings)} of {seen.asked}{_format_trips(seen.pings)}',
        verdict,
        'the latency timer of an FTDI chip at 1 ms (docs/radio.md), another cable, no hub, a '
        'computer that is less busy',
    )


def _evaluate_losses(seen: LinkTestResult, parameters: LinkParameters) -> ReportRow:
    share = 1.0 - len(seen.cycles) / seen.asked
    verdict = GOOD if share <= LOSS_LIMIT / 5 else POOR if share <= LOSS_LIMIT else BAD
    remedy = (
        'more than 0.2 m between both, antennas upright and free; 10 uF and 100 nF at both radio '
        'chips; another channel (t3mpc robot scan shows where it answers now); --set power=…; '
        '--set rate=250k with plus chips at both ends'
    )
    if not seen.cycles:
        absent = reasons.robot_absent(parameters.channel)
        remedy = f'{absent} t3mpc robot scan searches all channels; {remedy}'
    return ReportRow(
        'robot answers by radio', f'{len(seen.cycles)} of {seen.asked}', verdict, remedy
    )


def _evaluate_retries(seen: LinkTestResult) -> ReportRow:
    tries = seen.retransmissions
    mean = sum(number * count for number, count in enumerate(tries)) / max(sum(tries), 1)
    told = ', '.join(f'{number}: {count}' for number, count in enumerate(tries) if count)
    remedy = 'the same: the radio needs several tries for most packets'
    return ReportRow(
        'tries more per packet', told, GOOD if mean <= _MAX_MEAN_RETRIES else POOR, remedy
    )


def _evaluate_round_trips(seen: LinkTestResult, parameters: LinkParameters) -> ReportRow:
    slow = float(np.quantile(seen.cycles, 0.99))
    period = 1.0 / parameters.cycle_rate
    verdict = GOOD if slow <= ROUND_TRIP_LIMIT * period else POOR if slow <= period else BAD
    return ReportRow(
        'round trip to the robot',
        _format_trips(seen.cycles)[2:],
        verdict,
        f'half a period is {500.0 * period:g} ms: a lower --set cycle_rate, or the latency timer '
        'of the serial port at 1 ms (docs/radio.md)',
    )


def _evaluate_robot(state: State) -> ReportRow:
    status = StatusFlag(state.status)
    troubles = {
        StatusFlag.ESTOP: 'its emergency stop is latched',
        StatusFlag.IMU_FAULT: 'its inertial sensor does not answer: SDA at 20, SCL at 21, 5 V',
        StatusFlag.LOW_BATTERY: 'its battery is low, or its divider differs from docs/robot.md',
    }
    found = [text for bit, text in troubles.items() if status & bit]
    session = f'in session {state.session}' if state.session else 'in no session'
    return ReportRow('robot', session, POOR if found else GOOD, '; '.join(found))
