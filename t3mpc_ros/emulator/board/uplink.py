# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Uplink frames of the robot board: STATE, AUX, INFO and PARAM."""

from typing import NamedTuple

from t3mpc_ros.emulator.board.hardware import Registers
from t3mpc_ros.emulator.board.parameter_store import ParameterStore
from t3mpc_ros.radio.protocol.authentication import CommandVerifier
from t3mpc_ros.radio.protocol.frames import (
    AGE_NONE,
    BOARD_PARAMETERS,
    VERSION,
    Aux,
    Info,
    Param,
    State,
    StatusFlag,
    Uplink,
)

FIRMWARE_MAJOR, FIRMWARE_MINOR = 1, 0
"""Of the firmware."""

_COUNTERS = (
    'received',
    'duplicates',
    'bad_session',
    'stale',
    'expired',
    'bad_version',
    'short',
)


class PendingReply(NamedTuple):
    """What is loaded next, and for which request."""

    kind: type[Uplink] = State
    seq: int = 0
    id: int = 0
    rc: int = 0


class PacketCounters:
    """What the board counts, modulo 2**16."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Start at zero."""
        self._counts = dict.fromkeys(_COUNTERS, 0)

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def add(self, name: str) -> None:
        """Count one more of what has a field of that name in AUX."""
        self._counts[name] = self._counts[name] + 1 & 0xFFFF


def info_frame(
    gate: CommandVerifier,
    seq: int,
    reset_cause: int,
    steps: tuple[int, int],
    time_us: int,
    status: StatusFlag,
) -> Info:
    """Return the INFO of this instant; ``steps`` of a turn and microsteps of a step."""
    who = VERSION, FIRMWARE_MAJOR, FIRMWARE_MINOR, reset_cause, len(BOARD_PARAMETERS)
    return Info(gate.session, seq, *who, *steps, time_us, status, gate.nonce)


def state_frame(
    session: int,
    seq: int,
    status: StatusFlag,
    time_us: int,
    counters: tuple[int, int],
    sample: Registers,
    age_us: int | None,
    ranges: bytes,
) -> State:
    """Return the STATE of this instant; ``age_us`` of the last command, None: there was none."""
    age = AGE_NONE if age_us is None else min(age_us // 10, AGE_NONE)
    left, right = map(wrap_int32, counters)
    axes = sample.gyro_z, sample.accel_x, sample.accel_y
    return State(session, seq, status, time_us, left, right, *axes, age, ranges)


def parameter_frame(session: int, answer: PendingReply, values: ParameterStore) -> Param:
    """Return the PARAM for a request; zeros of a parameter that does not exist."""
    if answer.id >= len(BOARD_PARAMETERS):
        return Param(session, answer.seq, answer.id, answer.rc, 0, 0, 0)
    row = BOARD_PARAMETERS[answer.id]
    value = values[answer.id]
    return Param(session, answer.seq, answer.id, answer.rc, value, row.low, row.high)


def aux_frame(
    session: int,
    seq: int,
    status: StatusFlag,
    battery: int,
    sample: Registers,
    counts: PacketCounters,
    time_us: int,
) -> Aux:
    """Return the AUX of this instant; battery in mV."""
    return Aux(
        session,
        seq,
        status,
        battery,
        sample.temperature,
        sample.accel_z,
        sample.gyro_x,
        sample.gyro_y,
        counts['received'],
        counts['duplicates'],
        counts['bad_session'],
        counts['stale'],
        counts['expired'],
        time_us,
        counts['bad_version'],
        counts['short'],
    )


def wrap_int32(counter: int) -> int:
    """Return a counter as it wraps in 32 bits."""
    return (counter + (1 << 31)) % (1 << 32) - (1 << 31)
