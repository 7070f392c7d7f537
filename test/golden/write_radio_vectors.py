#!/usr/bin/env python3
# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Write radio_vectors.json, the reference vectors of the radio protocol.

Run ``PYTHONPATH=. python test/golden/write_radio_vectors.py`` after a change of the protocol; a
test compares the committed file with the output of this script. The format is in docs/radio.md.
"""

from collections.abc import Callable
import json
from pathlib import Path
import random

from t3mpc_ros.radio.protocol import authentication, codec, frames
from t3mpc_ros.radio.protocol.frames import CommandFlag
from t3mpc_ros.radio.protocol.framing import cobs_encode, crc16, encode_frame

TARGET = Path(__file__).with_name('radio_vectors.json')

# Published with the reference implementation of SipHash-2-4 (CC0) for 8 bytes of output: the tag
# of 00 01 02 … of each length from 0 to 63 under the key 00 01 … 0f, as little-endian numbers.
SIPHASH = """\
726fdb47dd0e0e31 74f839c593dc67fd 0d6c8009d9a94f5a 85676696d7fb7e2d
cf2794e0277187b7 18765564cd99a68d cbc9466e58fee3ce ab0200f58b01d137
93f5f5799a932462 9e0082df0ba9e4b0 7a5dbbc594ddb9f3 f4b32f46226bada7
751e8fbc860ee5fb 14ea5627c0843d90 f723ca908e7af2ee a129ca6149be45e5
3f2acc7f57c29bdb 699ae9f52cbe4794 4bc1b3f0968dd39c bb6dc91da77961bd
bed65cf21aa2ee98 d0f2cbb02e3b67c7 93536795e3a33e88 a80c038ccd5ccec8
b8ad50c6f649af94 bce192de8a85b8ea 17d835b85bbb15f3 2f2e6163076bcfad
de4daaaca71dc9a5 a6a2506687956571 ad87a3535c49ef28 32d892fad841c342
7127512f72f27cce a7f32346f95978e3 12e0b01abb051238 15e034d40fa197ae
314dffbe0815a3b4 027990f029623981 cadcd4e59ef40c4d 9abfd8766a33735c
0e3ea96b5304a7d0 ad0c42d6fc585992 187306c89bc215a9 d4a60abcf3792b95
f935451de4f21df2 a9538f0419755787 db9acddff56ca510 d06c98cd5c0975eb
e612a3cb9ecba951 c766e62cfcadaf96 ee64435a9752fe72 a192d576b245165a
0a8787bf8ecb74b2 81b3e73d20b49b6f 7fa8220ba3b2ecea 245731c13ca42499
b78dbfaf3a8d83bd ea1ad565322a1a0b 60e61c23a3795013 6606d7e446282b93
6ca4ecb15c5f91e1 9f626da15c9625f3 e51b38608ef25f57 958a324ceb064572
"""

GOLDEN_COMMAND = frames.Command(0x5A, 7, CommandFlag.ENABLE, 20, 5000, -2500, 0x01020304)
GOLDEN_STATE = frames.State(
    0x5A, 7, 3, 123456789, 1000, -1000, -131, 164, 0, 76, bytes.fromhex('a0fe013c00145078')
)
NONCE, TAG = bytes(range(0x10, 0x18)), bytes(range(0x20, 0x28))
ADDRESS = bytes.fromhex('c25a33a6e1')
PONG = frames.Pong(
    4, b'\x00\x11\x22\x33', 4711, 1, 1, 2, 1, 10, 20, 65535, 0x02, 1, 100, ADDRESS, 0xFEDCBA98
)

DOWN = {
    'radio.md': GOLDEN_COMMAND,
    'minimum values': frames.Command(0, 0, 0, 0, -32768, -32768, 0),
    'maximum values': frames.Command(255, 255, 7, 255, 32767, 32767, 0xFFFFFFFF),
    'stop': frames.Command(0x5A, 8, 0, 0, 0, 0, 0x01020305),
    'emergency stop, session 0': frames.Command(0, 0, CommandFlag.ESTOP, 0, 0, 0, 0),
    'release': frames.Command(0x5A, 9, CommandFlag.ESTOP_CLEAR, 0, 0, 0, 0x01020306),
    'with an invalid tag': GOLDEN_COMMAND._replace(tag=TAG),
    'get': frames.ParamGet(0x5A, 10, 3),
    'set': frames.ParamSet(0x5A, 11, 0, 12345678),
    'set, negative': frames.ParamSet(0x5A, 12, 255, -0x80000000),
    'set, with an invalid tag': frames.ParamSet(0x5A, 13, 1, 15000, 0x01020307, TAG),
    'hello': frames.Hello(0x5A, 14, 0x01020308),
    'hello, with an invalid tag': frames.Hello(0xFF, 15, 0xFFFFFFFF, NONCE, TAG),
    'poll state': frames.Poll(0x5A, 7, frames.STATE),
    'poll aux': frames.Poll(0x5A, 7, frames.AUX),
    'poll info, session 0': frames.Poll(0, 0, frames.INFO),
    'reset odometry': frames.Action(0x5A, 16, frames.RESET_ODOMETRY),
    'clear counters, with an invalid tag': frames.Action(
        0x5A, 17, frames.CLEAR_COUNTERS, 0x01020309, TAG
    ),
    'unknown verb': frames.Action(0x5A, 18, 255),
}
UP = {
    'radio.md': GOLDEN_STATE,
    'minimum values': frames.State(
        0, 0, 0, 0, -0x80000000, -0x80000000, -32768, -32768, -32768, 0, bytes(8)
    ),
    'maximum values': frames.State(
        255, 255, 255, 0xFFFFFFFF, 0x7FFFFFFF, 0x7FFFFFFF, 32767, 32767, 32767, 0xFFFF, b'\xff' * 8
    ),
    'ttl_max': frames.Param(0x5A, 10, 3, frames.OK, 250, 20, 500),
    'out of range': frames.Param(0x5A, 11, 0, frames.OUT_OF_RANGE, 10000, 0, 19600),
    'unknown': frames.Param(0x5A, 12, 255, frames.UNKNOWN, 0, 0, 0),
    'info': frames.Info(0x5A, 14, 1, 1, 2, 0x02, 11, 200, 16, 1, 0, 82, ADDRESS, 0xFEDCBA98),
    'info of a keyed robot': frames.Info(
        0, 0, 1, 1, 2, 0x08, 11, 200, 16, 64, 3, 125, b'T3MPC', 0, NONCE
    ),
    'done': frames.Ack(0x5A, 16, frames.RESET_ODOMETRY, frames.OK),
    'busy': frames.Ack(0x5A, 17, frames.RESET_ODOMETRY, frames.BUSY),
    'aux': frames.Aux(
        0x5A, 7, 33, 10150, -4000, 8192, -12, 13, 65535, 1, 2, 3, 4, 0xFEDCBA98, 5, 6
    ),
}
TO_DONGLE = {
    'radio.md': frames.Transmit(
        0x2A, 6, codec.encode(GOLDEN_COMMAND), codec.encode(frames.Poll(0x5A, 7, frames.STATE))
    ),
    'one payload only': frames.Transmit(0, 0, codec.encode(frames.Poll(0, 0, frames.INFO))),
    'maximum length': frames.Transmit(255, 255, bytes(range(32)), bytes(32)),
    'read the radio configuration': frames.Configure(1),
    'configure the radio': frames.Configure(2, 82, 1, 0, 1, 3, ADDRESS),
    'ping': frames.Ping(3, b'\x00\x11\x22\x33'),
}
FROM_DONGLE = {
    'radio.md': frames.Result(0x2A, 0x03, 0x13, 0x075BCA00, codec.encode(GOLDEN_STATE)),
    'no acknowledgement': frames.Result(0x2B, 0x34, 0x08, 1),
    'acknowledged, no payload': frames.Result(0x2C, 0x01, 0x21, 0xFFFFFFFF),
    'payload of the first only': frames.Result(0x2D, 0x03, 0x34, 2, b'\x00\x00\x00'),
    'the radio configuration': frames.Configured(2, 82, 1, 0, 1, 3, ADDRESS, 1),
    'no radio chip': frames.Configured(2, 0, 0, 0, 0, 0, bytes(5), 0),
    'pong': PONG._replace(id=3, settings=0),
    'busy': frames.Refusal(3, 0x2A),
}

TO_BOARD = {
    'read the state of the key': frames.Key(1),
    'store a key': frames.Key(2, bytes(range(0x80, 0x90))),
    'erase the key': frames.Key(3, bytes(16)),
    'read the settings': frames.Settings(1),
    'store settings': frames.Settings(2, 100, 32, ADDRESS),
    'ping': frames.Ping(4, b'\x00\x11\x22\x33'),
}
FROM_BOARD = {
    'no key': frames.KeyState(1, frames.OK, frames.NO_KEY, 0),
    'a key': frames.KeyState(
        2, frames.OK, frames.KEY_HELD, authentication.key_check(bytes(range(0x80, 0x90)))
    ),
    'busy': frames.KeyState(3, frames.BUSY, frames.KEY_HELD, 0xFFFFFFFF),
    'EEPROM failed': frames.KeyState(4, frames.FAILED, frames.KEY_DAMAGED, 0),
    'settings': frames.SettingsState(1, frames.OK, frames.SETTINGS_GOOD, 82, 16, ADDRESS),
    'no settings': frames.SettingsState(2, frames.OK, frames.SETTINGS_MISSING, 82, 16, b'T3MPC'),
    'settings out of range': frames.SettingsState(
        3, frames.OUT_OF_RANGE, frames.SETTINGS_ONE_COPY, 0, 256, ADDRESS
    ),
    'damaged settings': frames.SettingsState(
        4, frames.FAILED, frames.SETTINGS_DAMAGED, 125, 1, ADDRESS
    ),
    'pong': PONG,
    'unknown to the robot board': frames.Refusal(1, 0x01),
}
KEYS = (bytes(range(0x80, 0x90)), bytes(range(16)), b'\xff' * 16)

ONE_OF_EACH = codec.encode(GOLDEN_COMMAND).hex()
REJECTED = (
    ('down', '', 'length'),
    ('down', ONE_OF_EACH[:-2], 'length'),
    ('down', ONE_OF_EACH + '00', 'length'),
    ('down', ONE_OF_EACH + 19 * '00', 'length'),
    ('down', '21' + ONE_OF_EACH[2:], 'version'),
    ('down', '17' + ONE_OF_EACH[2:], 'kind'),
    ('down', '10' + ONE_OF_EACH[2:], 'kind'),
    ('down', '115a07081400' + ONE_OF_EACH[12:], 'value'),
    ('down', '115a07011401' + ONE_OF_EACH[12:], 'value'),
    ('down', '145a000100000000', 'value'),
    ('down', '1400000000000000', 'value'),
    ('down', '155a0703', 'value'),
    ('down', '165a07010001', 'value'),
    ('up', codec.encode(GOLDEN_STATE).hex()[:-2], 'length'),
    ('up', codec.encode(GOLDEN_STATE).hex() + '00', 'length'),
    ('up', '145a070105', 'value'),
    ('to dongle', '01000000', 'length'),
    ('to dongle', '0100000211', 'length'),
    ('to dongle', '01000021' + 33 * '11', 'length'),
    ('to dongle', '020052010001035a5a5a5a', 'length'),
    ('to dongle', '02007e010001035a5a5a5a5a', 'value'),
    ('to dongle', '0400', 'kind'),
    ('from dongle', '81000100000000', 'length'),
    ('from dongle', '8100030000000000', 'length'),
    ('from dongle', '810001000000000011', 'length'),
    ('from dongle', '8100050000000000', 'value'),
    ('from dongle', '8100020000000000', 'value'),
    ('from dongle', '8f0000', 'value'),
    ('to board', '04', 'length'),
    ('to board', '0401' + 15 * '11', 'length'),
    ('to board', '0401' + 17 * '11', 'length'),
    ('to board', '05', 'length'),
    ('to board', '0501' + 7 * '11', 'length'),
    ('to board', '0200', 'kind'),
    ('to board', '0100000115', 'kind'),
    ('from board', '84010000000000', 'length'),
    ('from board', '8401060000000000', 'value'),
    ('from board', '8401000300000000', 'value'),
    ('from board', '8501000452100054334d5043', 'value'),
    ('from board', '8100010000000000', 'kind'),
)


def _plain(frame: tuple) -> dict:
    fields = frame._asdict()
    return {
        name: value.hex() if isinstance(value, bytes) else int(value)
        for name, value in fields.items()
    }


def _frames(table: dict, on_wire: bool) -> list[dict]:
    rows = []
    for name, frame in table.items():
        data = codec.encode(frame)
        row = {'kind': type(frame).__name__, 'name': name, 'bytes': data.hex()}
        if on_wire:
            row['wire'] = encode_frame(data).hex()
        rows.append(row | {'fields': _plain(frame)})
    return rows


def _random_wires() -> list[dict]:
    source = random.Random(20260101)
    rows = []
    for length in range(1, 79):
        data = bytes(source.choice((0, 0, 1, 255, source.randrange(256))) for _ in range(length))
        rows.append({'bytes': data.hex(), 'wire': encode_frame(data).hex()})
    return rows


def _session() -> dict:
    """Return a keyed session at the robot: each frame and its verification."""
    key = bytes(range(0x80, 0x90))
    other = bytes(range(0x81, 0x91))
    nonces = bytes.fromhex('0102030405060708'), bytes.fromhex('1112131415161718')
    fresh = bytes.fromhex('a1a2a3a4a5a6a7a8'), bytes.fromhex('b1b2b3b4b5b6b7b8')
    start = 0xFFFFF000
    verifier = authentication.CommandVerifier(key)
    rows: list[dict] = []

    def hello(name: str, frame: frames.Hello, nonce: bytes = bytes(8)) -> None:
        begin = lambda: verifier.begin_session(frame, nonce)  # noqa: E731
        _add(name, frame, begin, {'fresh_nonce': nonce.hex()})

    def other_kind(name: str, frame: authentication.SignedFrame) -> None:
        _add(name, frame, lambda: verifier.verify(frame), {})

    def _add(name: str, frame: tuple, verify: Callable[[], str], more: dict) -> None:
        why = verify()
        row = {'name': name, 'kind': type(frame).__name__, 'bytes': codec.encode(frame).hex()}
        after = {'session': verifier.session, 'robot_nonce': verifier.nonce.hex()}
        rows.append(row | more | {'accepted': not why, 'why': why} | after)

    first = authentication.sign_hello(key, 0x5A, 1, start, nonces[0])
    forged = authentication.sign_hello(other, 0x5A, 1, start, nonces[0])
    command = GOLDEN_COMMAND._replace(host_us=start + 10)
    other_kind('CMD before any HELLO', command._replace(tag=TAG))
    hello('HELLO without a tag', frames.Hello(0x5A, 1, start), fresh[0])
    hello('HELLO under another key', forged, fresh[0])
    hello('HELLO', first, fresh[0])
    hello('the same HELLO again: the same nonce', first, fresh[1])

    signer = authentication.Signer(authentication.session_key(key, nonces[0], fresh[0]), start)
    early = signer.sign(command)
    setting = signer.sign(frames.ParamSet(0x5A, 8, 0, 12000, start + 20))
    reset = signer.sign(frames.Action(0x5A, 9, frames.RESET_ODOMETRY, start + 30))
    late = signer.sign(command._replace(seq=10, host_us=start + 40))
    clear = signer.sign(frames.Command(0x5A, 11, CommandFlag.ESTOP_CLEAR, 0, 0, 0, start + 50))
    wrapped = signer.sign(command._replace(seq=12, host_us=5))
    after = signer.sign(frames.ParamSet(0x5A, 13, 1, -1, 0xFFFFFFFF))
    twice = signer.sign(command._replace(seq=14, host_us=0))
    stop = frames.Command(0, 0, CommandFlag.ESTOP, 0, 0, 0, 0)
    other_kind('CMD', early)
    other_kind('the same CMD again', early)
    other_kind('CMD without a tag', command._replace(host_us=start + 15))
    other_kind('CMD of another session', early._replace(session=0x5B))
    other_kind('PARAM_SET', setting)
    other_kind('PARAM_SET again', setting)
    other_kind('ACTION with one bit of its tag changed', _flip(reset))
    other_kind('ACTION', reset)
    other_kind('ESTOP of session 0, without a tag', stop)
    other_kind('ESTOP with a bad tag', stop._replace(session=0x5A, tag=TAG))
    other_kind('ESTOP_CLEAR without a tag', clear._replace(tag=b''))
    other_kind('ESTOP_CLEAR with a bad tag', _flip(clear))
    other_kind('ESTOP_CLEAR', clear)
    other_kind('CMD received out of order', late)
    other_kind('CMD with speeds exchanged', wrapped._replace(left=-2500, right=5000))
    other_kind('CMD after the wrap of host_us', wrapped)
    other_kind('CMD from before the wrap again', late)
    other_kind('PARAM_SET at the end of epoch 1', after)
    other_kind('CMD of epoch 1 again', wrapped)
    other_kind('CMD of epoch 2', twice)

    hello('another HELLO for the same session', _second(key, nonces[1]), fresh[1])
    other_kind('CMD of the session before', late)
    signer = authentication.Signer(authentication.session_key(key, nonces[1], fresh[1]), 100)
    other_kind('CMD of this one', signer.sign(command._replace(seq=3, host_us=101)))
    hello('the first HELLO again: a session with an unknown key', first, bytes(8))
    other_kind('CMD of the first session', early)

    keyless = authentication.CommandVerifier()
    return {
        'key': key.hex(),
        'session_keys': [
            {
                'host_nonce': host.hex(),
                'robot_nonce': robot.hex(),
                'session_key': authentication.session_key(key, host, robot).hex(),
            }
            for host, robot in zip(nonces, fresh, strict=True)
        ],
        'tags': [
            {
                'session_key': authentication.session_key(key, nonces[0], fresh[0]).hex(),
                'epoch': epoch,
                'bytes': codec.encode(frame).hex(),
            }
            for frame, epoch in (
                (early, 0),
                (setting, 0),
                (reset, 0),
                (clear, 0),
                (wrapped, 1),
                (after, 1),
                (twice, 2),
            )
        ],
        'robot': rows,
        'stops': _stops(key),
        'robot_without_key': [
            {
                'name': 'a signed HELLO cannot be checked',
                'bytes': codec.encode(first).hex(),
                'accepted': not keyless.begin_session(first, bytes(8)),
            },
        ],
    }


def _stops(key: bytes) -> dict:
    """Return emergency stops: all are executed, ``counted`` are those that pass verification."""
    start = 0xFFFFF000
    host, fresh = bytes.fromhex('2122232425262728'), bytes.fromhex('c1c2c3c4c5c6c7c8')
    verifier = authentication.CommandVerifier(key)
    hello = authentication.sign_hello(key, 0x5B, 1, start, host)
    if why := verifier.begin_session(hello, fresh):
        raise ValueError(f'HELLO must be accepted: got {why}')
    signer = authentication.Signer(authentication.session_key(key, host, fresh), start)
    stop = frames.Command(0x5B, 1, CommandFlag.ESTOP, 0, 0, 0, 0)
    before = signer.sign(GOLDEN_COMMAND._replace(session=0x5B, seq=2, host_us=start + 10))
    signed = signer.sign(stop._replace(seq=3, host_us=start + 20))
    wrapped = signer.sign(stop._replace(seq=4, host_us=5))
    later = signer.sign(GOLDEN_COMMAND._replace(session=0x5B, seq=5, host_us=30))
    cases = (
        ('ESTOP of session 0', stop._replace(session=0)),
        ('ESTOP without a tag', stop),
        ('ESTOP with a bad tag and a later host_us', stop._replace(host_us=start + 999, tag=TAG)),
        ('ESTOP', signed),
        ('CMD received after it, sent before', before),
        ('ESTOP again', signed),
        ('ESTOP after the wrap of host_us', wrapped),
        ('ESTOP from before the wrap', signed),
        ('CMD after it', later),
    )
    return {
        'hello': codec.encode(hello).hex(),
        'fresh_nonce': fresh.hex(),
        'frames': [
            {
                'name': name,
                'kind': 'Command',
                'bytes': codec.encode(frame).hex(),
                'counted': not verifier.accept(frame),
            }
            for name, frame in cases
        ],
    }


def _second(key: bytes, nonce: bytes) -> frames.Hello:
    return authentication.sign_hello(key, 0x5A, 2, 100, nonce)


def _flip(frame: authentication.AnySignedFrame) -> authentication.AnySignedFrame:
    return frame._replace(tag=bytes([frame.tag[0] ^ 1]) + frame.tag[1:])


def vectors() -> dict:
    """Return the content of the file."""
    codes = ('OK', 'UNKNOWN', 'OUT_OF_RANGE', 'READ_ONLY', 'BUSY')
    return {
        'format': 1,
        'constants': {
            'version': frames.VERSION,
            'payload_limit': frames.PAYLOAD_LIMIT,
            'flags': {flag.name: flag.value for flag in CommandFlag},
            'status': {status.name: status.value for status in frames.StatusFlag},
            'results': {name: getattr(frames, name) for name in codes},
            'actions': {
                name: getattr(frames, name) for name in ('RESET_ODOMETRY', 'CLEAR_COUNTERS')
            },
            'polls': {name: getattr(frames, name) for name in ('STATE', 'AUX', 'INFO')},
            'parameters': [
                {'id': number} | parameter._asdict()
                for number, parameter in enumerate(frames.BOARD_PARAMETERS)
            ],
        },
        'crc16': [
            {'bytes': data.hex(), 'crc': crc16(data)}
            for data in (b'', b'123456789', bytes(1), b'\xff' * 78)
        ],
        'cobs': [
            {'bytes': data.hex(), 'stuffed': cobs_encode(data).hex()}
            for data in (b'', b'\0', b'\0\0', b'\1', b'\1\0', b'\0\1', b'11\x000', b'\xff' * 80)
        ],
        'siphash': {
            'key': bytes(range(16)).hex(),
            'tags': [int(tag, 16).to_bytes(8, 'little').hex() for tag in SIPHASH.split()],
        },
        'down': _frames(DOWN, False),
        'up': _frames(UP, False),
        'to_dongle': _frames(TO_DONGLE, True),
        'from_dongle': _frames(FROM_DONGLE, True),
        'to_board': _frames(TO_BOARD, True),
        'from_board': _frames(FROM_BOARD, True),
        'key_checks': [{'key': key.hex(), 'check': authentication.key_check(key)} for key in KEYS],
        'wire': _random_wires(),
        'rejected': [
            {'direction': direction.replace(' ', '_'), 'bytes': data, 'fault': fault}
            for direction, data, fault in REJECTED
        ],
        'authentication': _session(),
    }


def text() -> str:
    """Return the file: JSON with one vector on each line."""
    return _pretty(vectors(), '') + '\n'


def _pretty(value: object, indent: str) -> str:
    flat = json.dumps(value)
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    if not any(isinstance(one, dict | list) for one in inner) or len(flat) < 60 or 'kind' in value:
        return flat
    deeper = indent + ' '
    if isinstance(value, dict):
        rows = [f'{json.dumps(name)}: {_pretty(one, deeper)}' for name, one in value.items()]
        opening, closing = '{', '}'
    else:
        rows = [_pretty(one, deeper) for one in value]
        opening, closing = '[', ']'
    body = ',\n'.join(deeper + row for row in rows)
    return f'{opening}\n{body}\n{indent}{closing}'


if __name__ == '__main__':
    TARGET.write_text(text())
