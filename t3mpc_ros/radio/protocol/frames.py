# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Frames of protocol 1 as typed values: radio payloads and the USB frames around them.

Fields keep their integers from the wire; :mod:`t3mpc_ros.radio.protocol.codec` converts frames to
bytes and back. docs/radio.md has the byte tables.
"""

from enum import Enum, IntFlag
from typing import NamedTuple

VERSION = 1
PAYLOAD_LIMIT = 32
"""bytes: the radio chip takes no more, and a robot rejects whatever claims to be longer"""


class FrameErrorKind(Enum):
    """Why a frame is none: the robot counts these apart."""

    VERSION = 'version'
    KIND = 'kind'
    LENGTH = 'length'
    VALUE = 'value'


class FrameError(ValueError):
    """A frame that cannot be read or written."""

    def __init__(self, kind: FrameErrorKind, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class CommandFlag(IntFlag):
    """Flags of a CMD."""

    ENABLE = 1
    ESTOP = 2
    ESTOP_CLEAR = 4


class StatusFlag(IntFlag):
    """What the robot says of itself in STATE, INFO and AUX."""

    ENABLED = 1
    MOVING = 2
    ESTOP = 4
    TTL_EXPIRED = 8
    IMU_FAULT = 16
    LOW_BATTERY = 32
    NO_SESSION = 64
    LIMITED = 128


STATE, AUX, INFO = 0, 1, 2
"""What a POLL asks for."""
RESET_ODOMETRY, CLEAR_COUNTERS = 1, 2
"""Verbs of an ACTION; the first is refused while the robot moves."""
OK, UNKNOWN, OUT_OF_RANGE, READ_ONLY, BUSY, FAILED = range(6)
"""Results in PARAM, ACK and, the last only there, KEY."""
NO_KEY, KEY_HELD, KEY_DAMAGED = range(3)
"""What a robot tells of its key."""
AGE_NONE = 0xFFFF
"""Age in a STATE before the first CMD of a session."""


# -- radio, downlink ------------------------------------------------------------------------------


class Command(NamedTuple):
    """CMD: the wheel speeds that are wanted, for as long as ``ttl`` says."""

    session: int
    seq: int
    flags: int
    ttl: int
    """10 ms; 0 stops"""
    left: int
    """mrad/s"""
    right: int
    """mrad/s"""
    host_us: int
    """The host's own microseconds, modulo 2**32."""
    tag: bytes = b''
    """8 bytes on a keyed link."""


class ParamGet(NamedTuple):
    """PARAM_GET: ask for a parameter."""

    session: int
    seq: int
    id: int


class ParamSet(NamedTuple):
    """PARAM_SET: change a parameter; the robot answers with what it is then."""

    session: int
    seq: int
    id: int
    value: int
    host_us: int = 0
    """Only on a keyed link."""
    tag: bytes = b''


class Hello(NamedTuple):
    """HELLO: start a session; signed under the long-term key on a keyed link."""

    session: int
    seq: int
    host_us: int
    nonce: bytes = b''
    """8 bytes on a keyed link."""
    tag: bytes = b''


class Poll(NamedTuple):
    """POLL: fetch an answer; changes nothing, and any session may."""

    session: int
    seq: int
    what: int


class Action(NamedTuple):
    """ACTION: do something once."""

    session: int
    seq: int
    verb: int
    host_us: int = 0
    """Only on a keyed link."""
    tag: bytes = b''


# -- radio, uplink --------------------------------------------------------------------------------


class State(NamedTuple):
    """STATE: what the robot measures, in the 32 bytes that fit."""

    session: int
    seq: int
    """Of the last CMD it took notice of."""
    status: int
    time_us: int
    """Robot time of the sample, modulo 2**32."""
    left: int
    """Microsteps issued since boot, modulo 2**32 as int32."""
    right: int
    gyro_z: int
    """Register of the MPU6050, as the next two."""
    accel_x: int
    accel_y: int
    age: int
    """10 us from the reception of the last CMD to the sample; AGE_NONE: there was none."""
    ranges: bytes
    """A code for each of the eight distance sensors."""


class Param(NamedTuple):
    """PARAM: a parameter as it is now."""

    session: int
    seq: int
    id: int
    rc: int
    value: int
    low: int
    high: int


class Info(NamedTuple):
    """INFO: who the robot is."""

    session: int
    seq: int
    protocol: int
    major: int
    minor: int
    reset_cause: int
    """MCUSR of the AVR."""
    parameters: int
    """How many there are."""
    steps_per_rev: int
    microsteps: int
    time_us: int
    status: int
    nonce: bytes = b''
    """8 bytes from a keyed robot; zeros before its first HELLO."""


class Ack(NamedTuple):
    """ACK: what became of an ACTION."""

    session: int
    seq: int
    verb: int
    rc: int


class Aux(NamedTuple):
    """AUX: what is worth knowing once a second."""

    session: int
    seq: int
    status: int
    battery: int
    """mV"""
    temperature: int
    """Register of the MPU6050, as the next three."""
    accel_z: int
    gyro_x: int
    gyro_y: int
    received: int
    """Counters from here on, modulo 2**16."""
    duplicates: int
    bad_session: int
    """Frames of another session, with a bad tag, or replayed."""
    stale: int
    expired: int
    """How often the TTL ran out."""
    time_us: int
    bad_version: int
    short: int
    """Frames of a wrong length or with a value out of range."""


# -- USB ------------------------------------------------------------------------------------------


class Transmit(NamedTuple):
    """TX: send the first payload, wait ``gap``, send the second unless empty."""

    id: int
    gap: int
    """250 us"""
    first: bytes
    second: bytes = b''


class Result(NamedTuple):
    """RESULT: what became of a TX; ``codec.exchange`` reads the two statuses."""

    id: int
    first: int
    second: int
    dongle_us: int
    """Dongle time at completion, modulo 2**32."""
    payload: bytes = b''
    """Of the last exchange that was answered with one."""


class Configure(NamedTuple):
    """CFG, host to dongle: set the radio; without an address: only ask."""

    id: int
    channel: int = 0
    """2400 MHz + this"""
    rate: int = 0
    """0: 250 kbit/s, 1: 1 Mbit/s, 2: 2 Mbit/s"""
    power: int = 0
    """0: -18 dBm, 1: -12, 2: -6, 3: 0"""
    retry_delay: int = 0
    """(this + 1) 250 us"""
    retries: int = 0
    address: bytes = b''
    """5 bytes, lowest first"""


class Configured(NamedTuple):
    """CFG, dongle to host: how the radio is set."""

    id: int
    channel: int
    rate: int
    power: int
    retry_delay: int
    retries: int
    address: bytes
    chip_ok: int
    """1: the radio chip answers and holds what was set."""


class Ping(NamedTuple):
    """PING: is a dongle there? Never touches the radio."""

    id: int
    echo: bytes
    """4 bytes of the host's choice."""


class Pong(NamedTuple):
    """PONG: it is, and this is how it fares."""

    id: int
    echo: bytes
    time_us: int
    protocol: int
    major: int
    minor: int
    chip_ok: int
    crc_errors: int
    frame_errors: int
    overruns: int
    reset_cause: int


class Refusal(NamedTuple):
    """ERR: the dongle could not make sense of a frame."""

    code: int
    """1: unknown kind, 2: malformed, 3: busy"""
    argument: int
    """First byte of that frame; for 3, its id."""


class Key(NamedTuple):
    """KEY, host to the robot's own USB: store a key, or forget it; without one: only ask."""

    id: int
    key: bytes = b''
    """16 bytes; all zero: forget it."""


class KeyState(NamedTuple):
    """KEY, robot to host over its own USB: what became of it, and what there is now."""

    id: int
    rc: int
    """OK, BUSY: it moves, its drivers are on, or it is writing one; FAILED: it did not hold."""
    state: int
    """NO_KEY, KEY_HELD or KEY_DAMAGED."""
    check: int
    """``authentication.key_check`` of a key that is held, else 0."""


Downlink = Command | ParamGet | ParamSet | Hello | Poll | Action
Uplink = State | Param | Info | Ack | Aux
ToDongle = Transmit | Configure | Ping
FromDongle = Result | Configured | Pong | Refusal
ToBoard = Ping | Key
"""Over the USB of the robot's own board, as the next."""
FromBoard = Pong | KeyState | Refusal


# -- parameters of the robot ----------------------------------------------------------------------


class BoardParameter(NamedTuple):
    """What a robot's parameter is called, and what it may be. It is kept in RAM only."""

    name: str
    unit: str
    default: int
    low: int
    high: int
    text: str


BOARD_PARAMETERS = (
    BoardParameter(
        'max_speed', 'mrad/s', 10000, 0, 19600, 'of a wheel; the faster one sets the scale'
    ),
    BoardParameter('acceleration', 'mrad/s2', 30000, 100, 100000, 'of the faster changing wheel'),
    BoardParameter('deceleration', 'mrad/s2', 60000, 100, 200000, 'the same when it is to stand'),
    BoardParameter('ttl_max', 'ms', 250, 20, 500, 'no command is followed longer than this'),
    BoardParameter('microsteps', '', 16, 1, 256, 'takes effect at the next start; only at rest'),
    BoardParameter('steps_per_rev', '', 200, 200, 200, 'full steps of the motor'),
    BoardParameter('gyro_range', 'deg/s', 500, 500, 500, 'full scale of the gyro'),
    BoardParameter('battery_low', 'mV', 10200, 0, 30000, 'below this the status says so'),
    BoardParameter('idle_off', 'ms', 0, 0, 600000, 'at rest this long, drivers go off; 0: never'),
    BoardParameter('invert_wheels', 'bits', 0, 0, 3, '1: left, 2: right'),
)
"""In the order of their ids; one with ``low == high`` is read-only."""
