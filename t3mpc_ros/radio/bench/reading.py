# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the robot as they are: read only, in whatever session it is."""

from collections.abc import Callable, Sequence
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
from t3mpc_ros.radio.codec import decode_up, encode
from t3mpc_ros.radio.frames import (
    PARAMETERS,
    VERSION,
    Downlink,
    FrameError,
    Info,
    Param,
    ParamGet,
    Poll,
    Result,
    Transmit,
    Uplink,
)
from t3mpc_ros.radio.link import words
from t3mpc_ros.radio.link.session import Session, absent
from t3mpc_ros.radio.link.settings import LinkSettings

_PATIENCE = 0.25
_TRIES = 20


class Inventory(NamedTuple):
    """What the robot is, and its parameters."""

    info: Info
    values: tuple[Param, ...]


def read_parameters(
    settings: LinkSettings, key: bytes, entropy: Callable[[int], bytes]
) -> Talk[Inventory]:
    """Return all parameters of the robot.

    One that is in a session is read in that, and goes on undisturbed. One that is in none is
    greeted, which needs the key if it has one.
    """
    yield from look_for_dongle()
    before = yield from ask_radio()
    try:
        yield from set_radio(settings.configure(0))
        info = yield from _ask_who(settings)
        if not info.session:
            info = yield from _greet(settings, Session(key, entropy, 0, 0))
        values = []
        for number in range(info.parameters):
            values.append((yield from _get(settings, info.session, number)))
    finally:
        yield from set_radio(before)
    return Inventory(info, tuple(values))


def _exchange(settings: LinkSettings, first: Downlink, fetch: int) -> Talk[Uplink | None]:
    payloads = encode(first), encode(Poll(0, 0, fetch))
    heard = yield Ask(Transmit(0, settings.gap_after(first), *payloads), _PATIENCE)
    if isinstance(heard.reply, Result) and heard.reply.payload:
        try:
            return decode_up(heard.reply.payload)
        except FrameError:
            return None
    return None


def _ask_who(settings: LinkSettings) -> Talk[Info]:
    for _ in range(_TRIES):
        told = yield from _exchange(settings, Poll(0, 0, frames.INFO), frames.INFO)
        if isinstance(told, Info):
            if told.protocol != VERSION:
                raise ErrandError(
                    f'the robot must speak protocol {VERSION}: it speaks {told.protocol}'
                )
            return told
    raise ErrandError(absent(settings.channel))


def _greet(settings: LinkSettings, session: Session) -> Talk[Info]:
    problem = words.NO_SESSION
    for number in range(_TRIES):
        # A clock of its own: nobody commands in this session, it only has to go on.
        hello = session.hello(1000 * number)
        told = yield from _exchange(settings, hello, frames.INFO)
        if isinstance(told, Info):
            problem = session.accept(told)
            if not problem:
                return told
    raise ErrandError(problem)


def _get(settings: LinkSettings, session: int, number: int) -> Talk[Param]:
    for seq in range(_TRIES):
        told = yield from _exchange(settings, ParamGet(session, seq, number), frames.STATE)
        if isinstance(told, Param) and (told.id, told.seq) == (number, seq):
            return told
    raise ErrandError('the robot was there, and no longer answers: has it another host?')


def table(inventory: Inventory, settings: LinkSettings) -> str:
    """Return the parameters as text: value, bounds, and what a bridge with these settings sets."""
    info, wanted = inventory.info, settings.robot.on_wire()
    signed = 'signed commands only' if info.nonce else 'no key'
    lines = [
        f'firmware {info.major}.{info.minor}, {info.steps_per_rev} steps of {info.microsteps} '
        f'microsteps, {signed}',
        '',
        f'{"parameter":<14}  {"value":>7}  {"unit":<7}  {"allowed":<16}  {"bridge sets":>11}',
    ]
    for value in inventory.values:
        lines.append(_line(value, wanted.get(value.id)))
    return '\n'.join(lines)


def _line(value: Param, wanted: int | None) -> str:
    known: Sequence[frames.Parameter] = PARAMETERS
    row = known[value.id] if value.id < len(known) else None
    name, unit = (row.name, row.unit) if row else (f'number {value.id}', '')
    bounds = 'fixed' if value.low == value.high else f'{value.low} to {value.high}'
    sets = '' if wanted is None else str(wanted)
    text = f'{name:<14}  {value.value:>7}  {unit:<7}  {bounds:<16}  {sets:>11}'
    return text.rstrip()
