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
"""Frames of protocol 2 as typed values: radio payloads and the USB frames around them.

Fields keep their integers from the wire; :mod:`t3mpc_ros.radio.protocol.codec` converts frames to
bytes and back. docs/radio.md has the byte tables.
"""

from enum import Enum, IntEnum, IntFlag
from typing import NamedTuple

VERSION = 2
PAYLOAD_LIMIT = 32  # maximum radio payload, bytes; a longer one is rejected


class FrameErrorKind(Enum):
    """Why bytes are rejected; the robot counts the kinds separately."""

    VERSION = 'version'
    KIND = 'kind'
    LENGTH = 'length'
    VALUE = 'value'


class FrameError(ValueError):
    """A frame that cannot be decoded or encoded."""

    def __init__(self, kind: FrameErrorKind, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class CommandFlag(IntFlag):
    """Flags of a CMD."""

    ENABLE = 1
    ESTOP = 2
    ESTOP_CLEAR = 4


class StatusFlag(IntFlag):
    """Status bits in STATE, INFO and AUX."""

    ENABLED = 1
    MOVING = 2
    ESTOP = 4
    TTL_EXPIRED = 8
    IMU_FAULT = 16
    LOW_BATTERY = 32
    NO_SESSION = 64
    LIMITED = 128


class RefusalReason(IntEnum):
    """Why the robot refuses a payload, in INFO and AUX."""

    NONE = 0
    VERSION = 1  # another version of the protocol
    FORM = 2  # unknown kind, wrong length, or a value out of range
    SETTINGS = 3  # HELLO: the robot has no valid settings
    KEY = 4  # HELLO: the key of the robot is damaged, or being written
    UNSIGNED = 5  # no tag, but the robot has a key
    SIGNED = 6  # A tag, but the robot has no key
    SESSION = 7  # no session, or not the current one
    TAG = 8  # bad tag, or a replay
    SEQUENCE = 9  # CMD: repeated, or overtaken by a newer one
    STALE = 10  # CMD: its echo is too old


STATE, AUX, INFO = 0, 1, 2  # frame that a POLL fetches
RESET_ODOMETRY, CLEAR_COUNTERS = 1, 2
"""Verbs of an ACTION; RESET_ODOMETRY is rejected while the robot moves."""
OK, UNKNOWN, OUT_OF_RANGE, READ_ONLY, BUSY, FAILED = range(6)
"""Result codes of PARAM, ACK, KEY and RECORD; FAILED not in the first two."""
NO_KEY, KEY_HELD, KEY_DAMAGED = range(3)  # state of the key in KEY from the robot
SETTINGS_GOOD, SETTINGS_ONE_COPY, SETTINGS_MISSING, SETTINGS_DAMAGED = range(4)
"""State of a record of the robot. Without valid settings it accepts no session."""
SETTINGS_OLD, CALIBRATION_DAMAGED = 4, 5
"""Settings of an older firmware; INFO and PONG: usable settings, but a damaged calibration."""
SETTINGS_RECORD, CALIBRATION_RECORD, LOG_RECORD = range(3)
"""Record of a RECORD or STORE; the log can only be read."""
PART_SIZE = 16  # bytes of a part of a record
RATES = ('250k', '1M', '2M')  # air data rates, bit/s, by their number in CFG and in the settings
POWERS = ('-18', '-12', '-6', '0')  # output powers, dBm, likewise
AGE_NONE = 0xFFFF  # age in a STATE before the first CMD of a session


# -- radio, downlink ------------------------------------------------------------------------------


class Command(NamedTuple):
    """CMD: wheel speeds, valid for ``ttl``."""

    session: int
    seq: int
    flags: int
    ttl: int  # time to live, unit 10 ms; 0 stops
    left: int  # mrad/s
    right: int  # mrad/s
    echo_us: int  # robot time of the newest STATE that the host has: ``State.time_us``
    host_us: int = 0
    """Host time, us, modulo 2**32; only on a keyed link, like that of the other frames."""
    tag: bytes = b''  # 8 bytes on a keyed link, otherwise empty


class ParamGet(NamedTuple):
    """PARAM_GET: read a parameter."""

    session: int
    seq: int
    id: int


class ParamSet(NamedTuple):
    """PARAM_SET: change a parameter; the robot answers with the resulting value."""

    session: int
    seq: int
    id: int
    value: int
    host_us: int = 0
    tag: bytes = b''


class Hello(NamedTuple):
    """HELLO: start a session; signed under the long-term key on a keyed link."""

    session: int
    seq: int
    host_us: int = 0
    nonce: bytes = b''  # 8 bytes on a keyed link
    tag: bytes = b''


class Poll(NamedTuple):
    """POLL: fetch an answer; read only, accepted from any session."""

    session: int
    seq: int
    what: int


class Action(NamedTuple):
    """ACTION: execute an action once."""

    session: int
    seq: int
    verb: int
    host_us: int = 0
    tag: bytes = b''


# -- radio, uplink --------------------------------------------------------------------------------


class State(NamedTuple):
    """STATE: measurements of the robot, 32 bytes."""

    session: int
    seq: int  # of the last accepted CMD
    status: int
    time_us: int  # robot time of the sample, modulo 2**32
    left: int  # microsteps issued since boot, modulo 2**32 as int32
    right: int
    gyro_z: int  # MPU6050 register, like the next two
    accel_x: int
    accel_y: int
    age: int
    """Time from the reception of the last CMD to the sample, unit 10 us; AGE_NONE without one."""
    ranges: bytes  # one code for each of the eight distance sensors


class Param(NamedTuple):
    """PARAM: current value and bounds of a parameter."""

    session: int
    seq: int
    id: int
    rc: int
    value: int
    low: int
    high: int


class Info(NamedTuple):
    """INFO: identity of the robot."""

    session: int
    seq: int
    protocol: int
    major: int
    minor: int
    reset_cause: int  # MCUSR of the AVR
    parameters: int  # number of board parameters
    steps_per_rev: int
    microsteps: int
    refusal: int  # RefusalReason of the newest refused payload
    settings: int  # SETTINGS_GOOD, …
    channel: int  # like the address: in effect
    address: bytes
    build: int  # digest of the sources and build settings of the firmware
    nonce: bytes = b''  # 8 bytes from a keyed robot, zeros before its first HELLO; otherwise empty


class Ack(NamedTuple):
    """ACK: result of an ACTION."""

    session: int
    seq: int
    verb: int
    rc: int


class Aux(NamedTuple):
    """AUX: slow measurements and counters, fetched once a second."""

    session: int
    seq: int
    status: int
    battery: int  # mV
    temperature: int  # MPU6050 register, like the next three
    accel_z: int
    gyro_x: int
    gyro_y: int
    received: int  # this and the following counters are modulo 2**16
    duplicates: int
    bad_session: int  # frames of another session, with a bad tag, or replayed
    stale: int
    expired: int  # number of TTL expiries
    bad_version: int
    malformed: int  # frames of unknown kind, of wrong length or with a value out of range
    refusal: int  # RefusalReason of the newest refused payload
    refused: bytes  # its first 3 bytes: version and kind, session, seq


# -- USB ------------------------------------------------------------------------------------------


class Transmit(NamedTuple):
    """TX: transmit the first payload, wait ``gap``, transmit the second unless empty."""

    id: int
    gap: int  # unit 250 us
    first: bytes
    second: bytes = b''


class Result(NamedTuple):
    """RESULT: result of a TX; ``codec.exchange`` decodes the status bytes."""

    id: int
    first: int
    second: int
    dongle_us: int  # dongle time at completion, modulo 2**32
    payload: bytes = b''  # ACK payload of the last exchange that returned one


class Configure(NamedTuple):
    """CFG, host to dongle: configure the radio; without an address, read its configuration."""

    id: int
    channel: int = 0  # 2400 MHz plus this
    rate: int = 0  # 0: 250 kbit/s, 1: 1 Mbit/s, 2: 2 Mbit/s
    power: int = 0  # 0: -18 dBm, 1: -12, 2: -6, 3: 0
    retry_delay: int = 0  # (This + 1) 250 us
    retries: int = 0
    address: bytes = b''  # 5 bytes, lowest first


class Configured(NamedTuple):
    """CFG, dongle to host: configuration of the radio."""

    id: int
    channel: int
    rate: int
    power: int
    retry_delay: int
    retries: int
    address: bytes
    chip_ok: int  # 1: the radio chip answers and holds the configuration


class Ping(NamedTuple):
    """PING: test the serial line; does not use the radio."""

    id: int
    echo: bytes  # 4 arbitrary bytes, returned in PONG


class Pong(NamedTuple):
    """PONG: identity, state of the radio chip, error counters."""

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
    settings: int  # state of the settings of a robot board; 0 from a dongle
    channel: int  # of the radio, like the address
    address: bytes
    build: int  # digest of the sources and build settings of the firmware


DONGLE_BUSY = 3  # code of a Refusal: another transaction runs


class Refusal(NamedTuple):
    """ERR: the dongle rejects a frame."""

    code: int  # 1: unknown kind, 2: malformed, 3: busy (DONGLE_BUSY)
    argument: int  # first byte of the rejected frame; its id for code 3


class Key(NamedTuple):
    """KEY, host to the USB of the robot board: store or erase the key; empty reads its state."""

    id: int
    key: bytes = b''  # 16 bytes; all zero erases the key


class KeyState(NamedTuple):
    """KEY, robot board to host over its USB: result and state of the key."""

    id: int
    rc: int
    """OK; BUSY: moving, drivers on, or writing a key; FAILED: the EEPROM did not hold the key."""
    state: int  # NO_KEY, KEY_HELD or KEY_DAMAGED
    check: int  # ``authentication.key_check`` of the stored key, else 0


class Record(NamedTuple):
    """RECORD, host to the USB of the robot board: stage a part of a record; without data, read."""

    id: int
    record: int  # SETTINGS_RECORD, CALIBRATION_RECORD or LOG_RECORD
    part: int  # from 0, each 16 bytes
    data: bytes = b''  # 16 bytes; what lies behind the end of the record is ignored


class Store(NamedTuple):
    """STORE, host to the USB of the robot board: write the staged record; RecordPart answers."""

    id: int
    record: int
    crc: int  # of the whole record


class RecordPart(NamedTuple):
    """RECORD, robot board to host over its USB: result, and a part of the record in effect."""

    id: int
    rc: int
    """OK; UNKNOWN: no such record or part, or other staged bytes; OUT_OF_RANGE; BUSY; FAILED."""
    record: int
    state: int  # SETTINGS_GOOD, …
    size: int  # bytes of the record
    part: int
    data: bytes  # 16 bytes, filled with zeros


class Sense(NamedTuple):
    """SENSE, host to the USB of the robot board: read the newest samples."""

    id: int


class Samples(NamedTuple):
    """SENSE, robot board to host over its USB: raw samples of the converter and the MPU6050."""

    id: int
    ranges: bytes  # 16 bytes: u16 counts of the eight distance sensors; 0xFFFF: not measured
    battery: int  # count of the divider
    accel_x: int  # MPU6050 register, like the next five; all zero while it does not answer
    accel_y: int
    accel_z: int
    gyro_x: int
    gyro_y: int
    gyro_z: int


Downlink = Command | ParamGet | ParamSet | Hello | Poll | Action
Uplink = State | Param | Info | Ack | Aux
ToDongle = Transmit | Configure | Ping
FromDongle = Result | Configured | Pong | Refusal
ToBoard = Ping | Key | Record | Store | Sense  # over the USB of the robot board, like the next
FromBoard = Pong | KeyState | RecordPart | Samples | Refusal
_REPLIES = {
    Ping: Pong, Configure: Configured, Transmit: Result,
    Key: KeyState, Record: RecordPart, Store: RecordPart, Sense: Samples,
}  # fmt: skip


def is_reply(reply: FromDongle | FromBoard, request: ToDongle | ToBoard) -> bool:
    """Return whether a USB frame answers a request, the only one in flight."""
    if isinstance(reply, Refusal):
        return True  # without an id
    if not isinstance(reply, _REPLIES[type(request)]) or reply.id != request.id:
        return False
    return not isinstance(request, Ping) or getattr(reply, 'echo', b'') == request.echo


# -- board parameters -----------------------------------------------------------------------------


class BoardParameter(NamedTuple):
    """Name, unit, default and bounds of a board parameter, which the robot holds in RAM."""

    name: str
    unit: str
    default: int
    low: int
    high: int
    text: str
    read_only: bool = False


BOARD_PARAMETERS = (
    BoardParameter('max_speed', 'mrad/s', 10000, 0, 19600, 'of a wheel; the faster scales both'),
    BoardParameter('acceleration', 'mrad/s2', 30000, 100, 100000, 'of the faster changing wheel'),
    BoardParameter('deceleration', 'mrad/s2', 60000, 100, 200000, 'the same while stopping'),
    BoardParameter('ttl_max', 'ms', 250, 20, 500, 'maximum time to live of a command'),
    BoardParameter('microsteps', '', 16, 1, 256, 'of the settings: t3mpc robot setup', True),
    BoardParameter('steps_per_rev', '', 200, 20, 10000, 'full steps; of the settings', True),
    BoardParameter('gyro_range', 'deg/s', 500, 500, 500, 'full scale of the gyro', True),
    BoardParameter('battery_low', 'mV', 10200, 0, 30000, 'status bit LOW_BATTERY below this'),
    BoardParameter('idle_off', 'ms', 0, 0, 600000, 'drivers off after this standstill; 0: never'),
    BoardParameter('invert_wheels', 'bits', 0, 0, 3, '1: left, 2: right; against the settings'),
    BoardParameter('battery_cutoff', 'mV', 9000, 0, 30000, 'no driving below this; 0: no limit'),
    BoardParameter('boots', '', 0, 0, 2**31 - 1, 'starts of the board, from any number', True),
)
"""Board parameters by id."""
