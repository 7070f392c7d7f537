#!/usr/bin/env python3
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
"""Write docs/radio_session.md: a complete session of the radio link, byte by byte.

The link of the host runs against the emulated boards, whose rules are the firmware's own. Run it
without arguments after a change of the protocol; a test compares the page with the code.
"""

from collections.abc import Iterator
from pathlib import Path
import random
from typing import Any, NamedTuple

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.radio.link.actions_and_states import LinkState, Open, Wait, Write
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import codec, frames
from t3mpc_ros.radio.protocol.framing import FrameDecoder

PAGE = Path(__file__).with_suffix('.md')
MS = 1_000_000
KEY = bytes(range(16))
_MEANINGS = {
    'session': 'number of the session, chosen by the host; in an answer that of the robot',
    'seq': 'number of the CMD; PARAM_* and ACTION have numbers of their own; POLL repeats that of '
    'the last CMD, and HELLO has 0',
    'STATE.seq': 'of the last accepted CMD',
    'PARAM.seq': 'of the request',
    'INFO.seq': 'of the request',
    'AUX.seq': 'of the request',
    'flags': 'CMD: 1 ENABLE, 2 ESTOP, 4 ESTOP_CLEAR; HELLO: 1 signed',
    'ttl': 'time to live, 10 ms',
    'reserved': 'zero',
    'left': 'wheel speed, mrad/s',
    'right': 'wheel speed, mrad/s',
    'STATE.left': 'microsteps issued since boot',
    'STATE.right': 'microsteps issued since boot',
    'echo_us': 'time_us of the newest STATE that the host has',
    'host_us': 'clock of the host, us',
    'tag': 'SipHash-2-4, see Signatures',
    'HELLO.nonce': 'random number of the host',
    'INFO.nonce': 'random number of the robot',
    'what': 'what the next packet fetches: 0 STATE, 1 AUX, 2 INFO',
    'PARAM_GET.id': 'number of the board parameter',
    'PARAM_SET.id': 'number of the board parameter',
    'PARAM.id': 'number of the board parameter',
    'id': 'number of the request, which the reply repeats',
    'value': 'value of the parameter',
    'rc': '0 done',
    'low': 'lower bound',
    'high': 'upper bound',
    'protocol': 'version of the protocol',
    'major': 'version of the firmware',
    'minor': 'version of the firmware',
    'reset_cause': 'register MCUSR: 1 power on, 2 external, 4 brown-out, 8 watchdog',
    'parameters': 'number of board parameters',
    'steps_per_rev': 'full steps of a turn',
    'microsteps': 'microsteps of a step',
    'refusal': 'reason of the newest refusal, 0: none since HELLO',
    'refused': 'first bytes of the newest refused payload',
    'settings': '0: stored in two copies; 0 from a dongle',
    'channel': '2400 MHz plus this',
    'address': 'address of the robot, last transmitted byte first',
    'build': 'digest of the firmware; 0 in the emulator',
    'status': '1 enabled, 2 moving, 4 emergency stop, 8 TTL expired, 16 no inertial sensor, '
    '32 low battery, 64 no session, 128 limited',
    'time_us': 'clock of the board, us',
    'gyro_z': 'register of the gyro, 65.5 counts per deg/s',
    'accel_x': 'register, 16384 counts per g',
    'accel_y': 'register, 16384 counts per g',
    'accel_z': 'register, 16384 counts per g',
    'gyro_x': 'register, 65.5 counts per deg/s',
    'gyro_y': 'register, 65.5 counts per deg/s',
    'age': 'from the reception of the last CMD to the sample, 10 us; 65535: none',
    'ranges': 'eight distances, 0.5 cm: 254 beyond range',
    'battery': 'mV',
    'temperature': 'register: / 340 + 36.53 deg C',
    'received': 'received payloads',
    'duplicates': 'refused: sequence',
    'bad_session': 'refused: session, tag, key, settings',
    'stale': 'refused: echo too old',
    'expired': 'expired commands',
    'bad_version': 'refused: version',
    'malformed': 'refused: form',
    'gap': 'time between both payloads, 250 us',
    'size': 'length of the first payload',
    'first': 'first payload, below',
    'second': 'second payload, below',
    'RESULT.first': 'first payload: 1 acknowledged, 2 with a payload; bits 4 to 7 retransmissions',
    'RESULT.second': 'second payload, the same',
    'dongle_us': 'clock of the dongle, us',
    'payload': 'payload of the last acknowledgement, below',
    'rate': '0: 250 kbit/s, 1: 1 Mbit/s, 2: 2 Mbit/s',
    'power': '0 to 3: -18, -12, -6, 0 dBm',
    'retry_delay': '(n + 1) 250 us',
    'retries': 'retransmissions',
    'chip_ok': '1: the radio chip answers',
    'echo': 'any four bytes, which the reply repeats',
    'crc_errors': 'damaged frames from the host',
    'frame_errors': 'damaged frames from the host',
    'overruns': 'lost bytes from the host',
}
"""Meaning of each field, by name, or by frame and name."""


class Line(NamedTuple):
    """A frame on the serial line."""

    time_ns: int
    from_host: bool
    wire: bytes
    frame: bytes


def record_session(key: bytes, seconds: float) -> list[Line]:
    """Return the frames of a session: connect, drive for a time, stop, shut down."""
    emulator = Emulator(EmulatorParameters(), key, seed=1)
    link = Link(LinkParameters(), key, random.Random(1).randbytes)
    now_ns, driven_ns = 0, None
    lines: list[Line] = []
    decoders = {True: FrameDecoder(), False: FrameDecoder()}

    def note(time_ns: int, from_host: bool, wire: bytes) -> None:
        lines.extend(
            Line(time_ns, from_host, wire, frame) for frame in decoders[from_host].feed(wire)
        )

    received = b''
    while link.state is not LinkState.DONE:
        if link.state is LinkState.RUN:
            driven_ns = driven_ns or now_ns + round(seconds * 1e9)
            link.command(WheelSpeeds(1.5, 2.0), now_ns + 250 * MS)
            if now_ns >= driven_ns:
                link.shut_down()
        until_ns = now_ns
        for action in link.step(now_ns, received):
            if isinstance(action, Open):
                link.port_opened(now_ns)
                until_ns = now_ns
                break
            if isinstance(action, Write):
                note(now_ns, True, action.data)
                emulator.feed(action.data, now_ns)
            elif isinstance(action, Wait):
                until_ns = action.until_ns
        events = [] if emulator.next_ns is None else [emulator.next_ns]
        now_ns = max(now_ns + 1000, min([until_ns, *events]))
        blocks = emulator.run_to(now_ns)
        for time_ns, data in blocks:
            note(time_ns, False, data)
        received = b''.join(data for _, data in blocks)
    return lines


def fields(frame: bytes, from_host: bool) -> tuple[str, Any, list[tuple[str, int, object]]]:
    """Return name and value of a frame or radio payload, and its fields with their sizes."""
    decode = codec.decode_to_dongle if from_host else codec.decode_from_dongle
    if frame[0] >> 4 == frames.VERSION:
        decode = codec.decode_downlink if from_host else codec.decode_uplink  # type: ignore[assignment]
    value: Any = decode(frame)
    name, sizes = codec.layout(value)
    rows: list[tuple[str, int, object]] = [('first byte', 1, frame[0])]
    rows += [(field, size, getattr(value, field, 0)) for field, size in sizes]
    if isinstance(value, frames.Transmit):
        rows.append(('size', 1, len(value.first)))
        rows += [
            ('first', len(value.first), value.first),
            ('second', len(value.second), value.second),
        ]
    elif isinstance(value, frames.Result) and value.payload:
        rows.append(('payload', len(value.payload), value.payload))
    return name, value, rows


def describe(frame: bytes, from_host: bool) -> Iterator[str]:
    """Yield the table of the fields of a frame."""
    name, _, rows = fields(frame, from_host)
    yield '| byte | bytes | field | value | meaning |'
    yield '|---|---|---|---|---|'
    at = 0
    for field, size, value in rows:
        meaning = 'kind of the frame'
        if field != 'first byte':
            meaning = _MEANINGS.get(f'{name}.{field}') or _MEANINGS[field]
        elif frame[0] >> 4 == frames.VERSION:
            meaning = 'version (2) and kind'
        shown = '' if isinstance(value, bytes) else f'{value:#04x}' if at == 0 else str(value)
        data = frame[at : at + size].hex(' ')
        yield f'| {at} | `{data}` | {field} | {shown} | {meaning} |'
        at += size


def payloads(frame: bytes, from_host: bool) -> list[bytes]:
    """Return the radio payloads of a serial frame."""
    _, value, _ = fields(frame, from_host)
    if isinstance(value, frames.Transmit):
        return [data for data in (value.first, value.second) if data]
    return [value.payload] if isinstance(value, frames.Result) and value.payload else []


def title(line: Line) -> str:
    """Return the names of a serial frame and of its payloads."""
    name, _, _ = fields(line.frame, line.from_host)
    inner = ', '.join(
        fields(data, line.from_host)[0] for data in payloads(*line[3:], line.from_host)
    )
    return f'{name} ({inner})' if inner else name


def sections(lines: list[Line], known: set[str]) -> Iterator[str]:
    """Yield the table of the fields of each kind of frame that is not known, once."""
    for line in lines:
        for number, data in enumerate([line.frame, *payloads(line.frame, line.from_host)]):
            name, value, _ = fields(data, line.from_host)
            kind = f'{name} {"to" if line.from_host else "from"} {"robot" if number else "dongle"}'
            variant = f'{kind} {value[-1] != b""}' if number else kind
            if variant in known:
                continue
            known.add(variant)
            yield ''
            yield f'### {kind}'
            yield ''
            yield from describe(data, line.from_host)


def transcript(lines: list[Line]) -> Iterator[str]:
    """Yield the table of all frames of a session."""
    yield '| ms | way | frame | bytes on the line |'
    yield '|---|---|---|---|'
    for line in lines:
        way = 'to dongle' if line.from_host else 'to host'
        yield f'| {line.time_ns / MS:.2f} | {way} | {title(line)} | `{line.wire.hex()}` |'


def page() -> str:
    """Return the page."""
    open_link, keyed = record_session(b'', 0.06), record_session(KEY, 0.0)
    known: set[str] = set()
    text = [
        '# A session of the radio link, byte by byte',
        '',
        'Written by `docs/radio_session.py`, which runs the host against the emulated boards; a '
        'test compares this page with the code. [The radio link](radio.md) has the rules.',
        '',
        'The host pings and configures the dongle, starts a session, writes eight board '
        'parameters and reads all back (the count of starts five times), fetches a first STATE '
        'for its echo, drives with 2.0 rad/s left and 1.5 rad/s right, stops, and disables the '
        'drives. Each line is one frame: its bytes and a CRC, stuffed by COBS, and a zero; a PING '
        'has a zero in front, which ends what may have come before.',
        '',
        '## All frames, without a key',
        '',
        *transcript(open_link),
        '',
        '## Fields',
        '',
        'The first frame of each kind.',
        *sections(open_link, known),
        '',
        '## With a key',
        '',
        f'The key is `{KEY.hex()}`, the random numbers of the host begin as above. The first '
        'frames with payloads, and the fields that differ:',
        '',
        *transcript([line for line in keyed if payloads(line.frame, line.from_host)][:4]),
        *sections(keyed, known),
        '',
    ]
    return '\n'.join(text)


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
