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
"""Link test: cable, dongle, radio and robot, measured without a session."""

from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.statistics import LOSS_LIMIT, RETRY_COUNTS, ROUND_TRIP_LIMIT
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_exchange_status, decode_uplink, encode
from t3mpc_ros.radio.tool import procedure

REPLY_TIMEOUT = 0.25  # fifteen retransmissions at 250 kbit/s take 60 ms, s
PASS, POOR, FAIL, SKIPPED = 'pass', 'poor', 'fail', 'skipped'
STEP = 2  # row of the link test in the checklist of docs/robot.md
_MAX_USB_ROUND_TRIP = 5e-3  # s; PING and PONG take 0.7 ms on the line
_MAX_MEAN_RETRIES = 0.5  # mean retransmissions per packet above which the radio has no margin
_SEARCH = '{} t3mpc robot scan searches all channels; '
_PROBLEMS = {
    frames.StatusFlag.ESTOP: 'its emergency stop is latched',
    frames.StatusFlag.IMU_FAULT: 'its inertial sensor does not answer: SDA at 20, SCL at 21, 5 V',
    frames.StatusFlag.LOW_BATTERY: 'its battery is low, or its divider differs from docs/robot.md',
}


class LinkTestResult(NamedTuple):
    """Measurements of the link test."""

    requests: int  # number of PINGs, and of radio cycles
    pings: tuple[float, ...]  # round trips of the answered PINGs, s
    cycles: tuple[float, ...]  # round trips of the answered cycles, s
    retransmissions: tuple[int, ...]
    """Number of acknowledged packets with 0, 1, … 15 retransmissions."""
    line_errors: int  # frames that reached the dongle damaged during the test
    state: frames.State | None


class Check(NamedTuple):
    """A line of a report."""

    step: int  # row of the checklist in docs/robot.md; 0: not in it
    name: str
    verdict: str  # PASS, POOR (usable, with a remedy), FAIL or SKIPPED
    value: str  # what was measured or answered
    remedy: str = ''


def run_link_test(parameters: LinkParameters, count: int) -> procedure.Script[LinkTestResult]:
    """Send ``count`` requests over USB and by radio; restore the radio configuration."""
    first = yield from procedure.wait_for_dongle()
    pings = []
    last = first
    for _ in range(count):
        response = yield procedure.Request(frames.Ping(0, b'ping'), REPLY_TIMEOUT)
        if isinstance(response.reply, frames.Pong):
            pings.append(response.round_trip)
            last = response.reply
    before = yield from procedure.read_radio_setup()
    cycles: list[float] = []
    retries = [0] * RETRY_COUNTS
    state = None
    try:
        yield from procedure.configure_radio(parameters.configure(0))
        poll = encode(frames.Poll(0, 0, frames.STATE))
        for _ in range(count):
            response = yield procedure.Request(
                frames.Transmit(0, parameters.gap, poll, poll), REPLY_TIMEOUT
            )
            fetched = _read_state(response.reply, retries)
            if fetched is not None:
                state = fetched
                cycles.append(response.round_trip)
            elapsed = (response.returned_ns - response.sent_ns) / NANOSECONDS
            yield procedure.Pause(max(1.0 / parameters.cycle_rate - elapsed, 0.0))
    finally:
        yield from procedure.configure_radio(before)
    errors = _line_errors(last) - _line_errors(first) & 0xFFFF
    return LinkTestResult(count, tuple(pings), tuple(cycles), tuple(retries), errors, state)


def _read_state(reply: object, retries: list[int]) -> frames.State | None:
    """Count the retransmissions of a cycle; return its STATE.

    A retransmission of the first packet may fetch the new STATE; the second then returns none.
    """
    if not isinstance(reply, frames.Result):
        return None
    for status in (decode_exchange_status(reply.first), decode_exchange_status(reply.second)):
        if status.acknowledged:
            retries[status.retransmissions] += 1
    try:
        payload = decode_uplink(reply.payload)
    except frames.FrameError:
        return None
    return payload if isinstance(payload, frames.State) else None


def _line_errors(pong: frames.Pong) -> int:
    return pong.crc_errors + pong.frame_errors + pong.overruns


# -- report ---------------------------------------------------------------------------------------


def evaluate(result: LinkTestResult, parameters: LinkParameters) -> list[Check]:
    """Return the report: each measurement with a verdict and a remedy."""
    requests, pings, cycles = result.requests, result.pings, result.cycles
    lost = 1.0 - len(cycles) / requests
    absent = reasons.robot_absent(parameters.address, parameters.channel)
    rows = [
        Check(
            STEP,
            'dongle answers over USB',
            _verdict(
                len(pings) == requests and _slow_trip(pings) <= _MAX_USB_ROUND_TRIP,
                len(pings) >= requests * (1.0 - LOSS_LIMIT),
            ),
            f'{len(pings)} of {requests}{", " if pings else ""}{_format_trips(pings)}',
            'the latency timer of an FTDI chip at 1 ms (docs/radio.md), another cable, no hub, '
            'less load on the computer',
        ),
        Check(
            STEP,
            'frames damaged on the cable',
            _verdict(not result.line_errors),
            str(result.line_errors),
            'another cable, another USB port, no hub',
        ),
        Check(
            STEP,
            'robot answers by radio',
            _verdict(lost <= LOSS_LIMIT / 5, lost <= LOSS_LIMIT),
            f'{len(cycles)} of {requests}',
            ('' if cycles else _SEARCH.format(absent))
            + 'more than 0.2 m between the radios, antennas upright and free; 10 uF and 100 nF at '
            'both radio chips; another channel (t3mpc robot scan lists them); --set power=…; '
            '--set rate=250k with nRF24L01+ chips at both ends',
        ),
    ]
    if cycles:
        retries = result.retransmissions
        mean = sum(k * count for k, count in enumerate(retries)) / max(sum(retries), 1)
        slow, period = _slow_trip(cycles), 1.0 / parameters.cycle_rate
        rows += [
            Check(
                STEP,
                'retransmissions per packet',
                _verdict(mean <= _MAX_MEAN_RETRIES),
                ', '.join(f'{number}: {count}' for number, count in enumerate(retries) if count),
                'as for the answers by radio: most packets are retransmitted',
            ),
            Check(
                STEP,
                'round trip to the robot',
                _verdict(slow <= ROUND_TRIP_LIMIT * period, slow <= period),
                _format_trips(cycles),
                f'half a period is {500.0 * period:g} ms: a lower --set cycle_rate, or the '
                'latency timer of the serial port at 1 ms (docs/radio.md)',
            ),
        ]
    if (state := result.state) is not None:
        found = [text for bit, text in _PROBLEMS.items() if frames.StatusFlag(state.status) & bit]
        session = f'in session {state.session}' if state.session else 'in no session'
        rows.append(Check(STEP, 'robot', _verdict(not found), session, '; '.join(found)))
    return rows


def _verdict(good: bool, usable: bool = True) -> str:
    return FAIL if not usable else PASS if good else POOR


def is_usable(rows: list[Check]) -> bool:
    """Return whether the link is good enough to drive the robot."""
    return all(row.verdict != FAIL for row in rows)


def format_report(rows: list[Check]) -> str:
    """Return the report as text."""
    name = max(len(row.name) for row in rows)
    width = max(len(row.value) for row in rows)
    lines = []
    for row in rows:
        lines.append(f'{row.name:<{name}}  {row.value:<{width}}  {row.verdict}')
        if row.verdict != PASS:
            lines.append(f'  try: {row.remedy}')
    return '\n'.join(lines)


def _format_trips(trips: tuple[float, ...]) -> str:
    if not trips:
        return ''
    median, slow = 1e3 * np.quantile(trips, [0.5, 0.99])
    return f'{median:.1f} ms (median), {slow:.1f} ms (99 of 100)'


def _slow_trip(trips: tuple[float, ...]) -> float:
    return float(np.quantile(trips, 0.99))
