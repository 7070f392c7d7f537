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
"""s"""
GOOD, POOR, BAD = 'good', 'poor', 'BAD'
_MAX_USB_ROUND_TRIP = 5e-3
"""s; PING and PONG take 0.7 ms on the line"""
_MAX_MEAN_RETRIES = 0.5
"""Mean retransmissions per packet above which the radio has no margin."""


class LinkTestResult(NamedTuple):
    """Measurements of the link test."""

    requests: int
    """Number of PINGs, and of radio cycles."""
    pings: tuple[float, ...]
    """Round trips of the answered PINGs, s."""
    cycles: tuple[float, ...]
    """Round trips of the answered cycles, s."""
    retransmissions: tuple[int, ...]
    """Number of acknowledged packets with 0, 1, … 15 retransmissions."""
    line_errors: int
    """Frames that reached the dongle damaged during the test."""
    state: State | None
    """Last STATE of the robot."""


class ReportRow(NamedTuple):
    """Row of the report."""

    name: str
    value: str
    verdict: str
    remedy: str = ''


def run_link_test(parameters: LinkParameters, count: int) -> Script[LinkTestResult]:
    """Send ``count`` requests over USB and by radio; restore the radio configuration."""
    first = yield from wait_for_dongle()
    pings = []
    last = first
    for _ in range(count):
        response = yield Request(Ping(0, b'ping'), _REPLY_TIMEOUT)
        if isinstance(response.reply, Pong):
            pings.append(response.round_trip)
            last = response.reply
    before = yield from read_radio_setup()
    cycles: list[float] = []
    retries = [0] * RETRY_COUNTS
    state = None
    try:
        yield from configure_radio(parameters.configure(0))
        poll = encode(Poll(0, 0, frames.STATE))
        for _ in range(count):
            response = yield Request(Transmit(0, parameters.gap, poll, poll), _REPLY_TIMEOUT)
            fetched = _read_state(response.reply, retries)
            if fetched is not None:
                state = fetched
                cycles.append(response.round_trip)
            elapsed = (response.returned_ns - response.sent_ns) / NANOSECONDS
            yield Pause(max(1.0 / parameters.cycle_rate - elapsed, 0.0))
    finally:
        yield from configure_radio(before)
    errors = _line_errors(last) - _line_errors(first) & 0xFFFF
    return LinkTestResult(count, tuple(pings), tuple(cycles), tuple(retries), errors, state)


def _read_state(reply: object, retries: list[int]) -> State | None:
    """Count the retransmissions of a cycle; return its STATE.

    A retransmission of the first packet may fetch the new STATE; the second then returns none.
    """
    if not isinstance(reply, Result):
        return None
    for status in (decode_exchange_status(reply.first), decode_exchange_status(reply.second)):
        if status.acknowledged:
            retries[status.retransmissions] += 1
    try:
        payload = decode_uplink(reply.payload)
    except FrameError:
        return None
    return payload if isinstance(payload, State) else None


def _line_errors(pong: Pong) -> int:
    return pong.crc_errors + pong.frame_errors + pong.overruns


# -- report ---------------------------------------------------------------------------------------


def evaluate(result: LinkTestResult, parameters: LinkParameters) -> list[ReportRow]:
    """Return the report: each measurement with a verdict and a remedy."""
    rows = [
        _evaluate_usb(result),
        ReportRow(
            'frames damaged on the cable',
            str(result.line_errors),
            GOOD if not result.line_errors else POOR,
            'another cable, another USB port, no hub',
        ),
        _evaluate_losses(result, parameters),
    ]
    if result.cycles:
        rows += [_evaluate_retries(result), _evaluate_round_trips(result, parameters)]
    if result.state is not None:
        rows.append(_evaluate_robot(result.state))
    return rows


def is_usable(rows: list[ReportRow]) -> bool:
    """Return whether the link is good enough to drive the robot."""
    return all(row.verdict != BAD for row in rows)


def format_report(rows: list[ReportRow]) -> str:
    """Return the report as text."""
    name, width = (max(len(row[column]) for row in rows) for column in (0, 1))
    lines = []
    for row in rows:
        lines.append(f'{row.name:<{name}}  {row.value:<{width}}  {row.verdict}')
        if row.verdict != GOOD:
            lines.append(f'  try: {row.remedy}')
    return '\n'.join(lines)


def _format_trips(trips: tuple[float, ...]) -> str:
    if not trips:
        return ''
    median, slow = 1e3 * np.quantile(trips, [0.5, 0.99])
    return f', {median:.1f} ms (median), {slow:.1f} ms (99 of 100)'


def _slow_trip(trips: tuple[float, ...]) -> float:
    return float(np.quantile(trips, 0.99))


def _evaluate_usb(result: LinkTestResult) -> ReportRow:
    answered = len(result.pings)
    verdict = GOOD
    if answered < result.requests or _slow_trip(result.pings) > _MAX_USB_ROUND_TRIP:
        verdict = POOR
    if answered < result.requests * (1.0 - LOSS_LIMIT):
        verdict = BAD
    return ReportRow(
        'dongle answers over USB',
        f'{answered} of {result.requests}{_format_trips(result.pings)}',
        verdict,
        'the latency timer of an FTDI chip at 1 ms (docs/radio.md), another cable, no hub, less '
        'load on the computer',
    )


def _evaluate_losses(result: LinkTestResult, parameters: LinkParameters) -> ReportRow:
    share = 1.0 - len(result.cycles) / result.requests
    verdict = GOOD if share <= LOSS_LIMIT / 5 else POOR if share <= LOSS_LIMIT else BAD
    remedy = (
        'more than 0.2 m between the radios, antennas upright and free; 10 uF and 100 nF at both '
        'radio chips; another channel (t3mpc robot scan lists them); --set power=…; '
        '--set rate=250k with nRF24L01+ chips at both ends'
    )
    if not result.cycles:
        absent = reasons.robot_absent(parameters.channel)
        remedy = f'{absent} t3mpc robot scan searches all channels; {remedy}'
    return ReportRow(
        'robot answers by radio', f'{len(result.cycles)} of {result.requests}', verdict, remedy
    )


def _evaluate_retries(result: LinkTestResult) -> ReportRow:
    retries = result.retransmissions
    mean = sum(number * count for number, count in enumerate(retries)) / max(sum(retries), 1)
    counts = ', '.join(f'{number}: {count}' for number, count in enumerate(retries) if count)
    remedy = 'as for the answers by radio: most packets are retransmitted'
    return ReportRow(
        'retransmissions per packet', counts, GOOD if mean <= _MAX_MEAN_RETRIES else POOR, remedy
    )


def _evaluate_round_trips(result: LinkTestResult, parameters: LinkParameters) -> ReportRow:
    slow = _slow_trip(result.cycles)
    period = 1.0 / parameters.cycle_rate
    verdict = GOOD if slow <= ROUND_TRIP_LIMIT * period else POOR if slow <= period else BAD
    return ReportRow(
        'round trip to the robot',
        _format_trips(result.cycles)[2:],
        verdict,
        f'half a period is {500.0 * period:g} ms: a lower --set cycle_rate, or the latency timer '
        'of the serial port at 1 ms (docs/radio.md)',
    )


def _evaluate_robot(state: State) -> ReportRow:
    status = StatusFlag(state.status)
    problems = {
        StatusFlag.ESTOP: 'its emergency stop is latched',
        StatusFlag.IMU_FAULT: 'its inertial sensor does not answer: SDA at 20, SCL at 21, 5 V',
        StatusFlag.LOW_BATTERY: 'its battery is low, or its divider differs from docs/robot.md',
    }
    found = [text for bit, text in problems.items() if status & bit]
    session = f'in session {state.session}' if state.session else 'in no session'
    return ReportRow('robot', session, POOR if found else GOOD, '; '.join(found))
