# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""State machine of the link: from a closed port to periodic commands and telemetry.

One frame is in flight at a time, and the host sets the pace: each cycle is a CMD with the newest
wheel speeds and a POLL that fetches the state sampled shortly after. Only requests are queued;
they are repeated until answered.
"""

import math
import secrets
from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.handshake import Entropy, Handshake, Session
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import Close, LinkState, Open, PortAction, Wait, Write
from t3mpc_ros.radio.link.setpoint import SetpointArbiter
from t3mpc_ros.radio.link.statistics import LinkQuality, LinkStatistics
from t3mpc_ros.radio.link.telemetry import GYRO_RANGE, Telemetry, TelemetryDecoder
from t3mpc_ros.radio.link.transaction import TransactionLayer, TransactionResult
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_exchange_status
from t3mpc_ros.radio.protocol.frames import (
    BOARD_PARAMETERS,
    Action,
    Command,
    CommandFlag,
    Configured,
    Downlink,
    Info,
    Result,
    State,
    StatusFlag,
)
from t3mpc_ros.robot.interface import BatteryReading, RobotCommand

_MIN_IDLE_NS = NANOSECONDS // 100
"""A request is sent between two cycles if this much time is left."""
_REQUEST_DECIMATION = 10
"""Where cycles leave no such time, every tenth gives way to a request."""
_AUX_PERIOD_NS = _PING_PERIOD_NS = NANOSECONDS
_MAX_LOST_CYCLES = 100
"""Cycles without an answer before the robot is greeted anew: from the 128th on it would take
commands for old ones, because sequence numbers have eight bits."""
_REJECTED_TIMEOUT_NS = NANOSECONDS // 2
_MIN_STOP_COMMANDS = 3
"""Commands of standstill before the drives are taken out, if the robot stands by then."""
_STOP_TIMEOUT_NS = NANOSECONDS
"""After this long the drives are taken out even if it does not, or does not answer."""
_DISABLE_COMMANDS = 3


class PingRequest(NamedTuple):
    """Ask the dongle how it fares."""


class ActiveSession:
    """Decides what to send in a session, and when the session is over.

    Parameters
    ----------
    settings
        The pace and the TTL.
    session
        That has begun.
    orders
        What to tell the robot.
    statistics
        Counts the cycles.
    now_ns
        The first cycle is due.
    """

    def __init__(
        self,
        parameters: LinkParameters,
        session: Session,
        orders: SetpointArbiter,
        statistics: LinkStatistics,
        now_ns: int,
    ) -> None:
        self._parameters = parameters
        self._session = session
        self._orders = orders
        self._statistics = statistics
        self._period_ns = round(NANOSECONDS / parameters.cycle_rate)
        self._due_ns = now_ns
        self._aux_ns = self._look_ns = now_ns
        self._cycles = 0
        self._taken_ns = now_ns
        self._status = StatusFlag(0)
        self._lost = 0
        self._stops: int | None = None
        self._stop_until_ns = 0
        self._goodbyes = _DISABLE_COMMANDS

    @property
    def due_ns(self) -> int:
        """When the next cycle is due."""
        return self._due_ns

    @property
    def finished(self) -> bool:
        """Whether the robot was brought to rest, as far as that can be done from here."""
        return self._goodbyes == 0

    def begin_stop(self, now_ns: int) -> None:
        """Bring the robot to rest from now on, whatever is ordered."""
        if self._stops is None:
            self._stops, self._stop_until_ns = _MIN_STOP_COMMANDS, now_ns + _STOP_TIMEOUT_NS
            self._due_ns = now_ns

    def next(self, now_ns: int) -> Downlink | PingRequest | None:
        """Return what to send now, if anything; a POLL for the state goes with a payload."""
        if now_ns < self._due_ns:
            return self._aside(now_ns) if self._due_ns - now_ns >= _MIN_IDLE_NS else None
        # Late cycles are left out, not made up for.
        self._due_ns = max(self._due_ns + self._period_ns, now_ns + self._period_ns // 2)
        self._cycles += 1
        if self._period_ns < 2 * _MIN_IDLE_NS and self._cycles % _REQUEST_DECIMATION == 0:
            aside = self._aside(now_ns)
            if aside is not None:
                return aside
        return self._cycle(now_ns)

    def hear(self, heard: TransactionResult) -> str:
        """Take an answer; return why the robot must be greeted anew, empty if it need not."""
        if isinstance(heard.asked, Action):
            self._orders.hear(heard.asked, heard.uplink)
        if isinstance(heard.asked, Command):
            answered = isinstance(heard.uplink, State)
            whole = answered and _is_own_state(heard, heard.asked)
            self._statistics.add_cycle(heard.round_trip if whole else None)
            self._lost = 0 if answered else self._lost + 1
            self._say_goodbye(heard)
        if isinstance(heard.uplink, State):
            return self._judge(heard, heard.uplink)
        return (
            reasons.robot_absent(self._parameters.channel)
            if self._lost >= _MAX_LOST_CYCLES
            else ''
        )

    def _aside(self, now_ns: int) -> Downlink | PingRequest | None:
        """Return the request that has waited for a moment between cycles, if any."""
        if self._stops is not None:
            return None
        if self._orders.requested is not None:
            return self._session.action(self._orders.requested, now_ns)
        if now_ns >= self._aux_ns:
            self._aux_ns = now_ns + _AUX_PERIOD_NS
            return self._session.poll(frames.AUX)
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + _PING_PERIOD_NS
            return PingRequest()
        return None

    def _cycle(self, now_ns: int) -> Downlink:
        if self._stops is not None:
            stands = not self._status & StatusFlag.MOVING and self._stops <= 0
            leave = stands or now_ns >= self._stop_until_ns
            self._stops = min(self._stops - 1, -1 if leave else self._stops)
            flags = CommandFlag(0) if leave else CommandFlag.ENABLE
            return self._session.command(flags, 0, 0, 0, now_ns)
        order = self._orders.next(bool(self._status & StatusFlag.ESTOP), now_ns)
        return self._session.command(
            order.flags, self._parameters.ttl_units, order.left, order.right, now_ns
        )

    def _say_goodbye(self, heard: TransactionResult) -> None:
        """Count a command that took the drives out; one that was acknowledged is enough."""
        if self._stops is None or not isinstance(heard.asked, Command) or heard.asked.flags:
            return
        reply = heard.reply
        taken = isinstance(reply, Result) and bool(reply.first & 1)
        self._goodbyes = 0 if taken else self._goodbyes - 1

    def _judge(self, heard: TransactionResult, state: State) -> str:
        self._status = StatusFlag(state.status)
        if state.session != self._session.number or state.status & StatusFlag.NO_SESSION:
            return 'the robot has lost its session'
        if isinstance(heard.asked, Command):
            # An emergency stop is always obeyed, whatever comes of the rest of the command.
            if state.seq == heard.asked.seq or heard.asked.flags & CommandFlag.ESTOP:
                self._taken_ns = heard.returned_ns
            elif heard.returned_ns - self._taken_ns > _REJECTED_TIMEOUT_NS:
                return reasons.COMMANDS_REJECTED
        return ''


def _is_own_state(heard: TransactionResult, asked: Command) -> bool:
    """Return whether a state is this cycle's own: a CMD alone fetches what was loaded before.

    Unless it was sent again: then it may fetch the answer to itself, and leave the POLL none.
    """
    fetched = (
        isinstance(heard.reply, Result) and decode_exchange_status(heard.reply.second).answered
    )
    return fetched or getattr(heard.uplink, 'seq', None) == asked.seq


_MIN_REOPEN_NS, _MAX_REOPEN_NS = NANOSECONDS // 5, 2 * NANOSECONDS
_PING_TIMEOUT_NS = _CONFIGURE_RETRY_NS = NANOSECONDS // 10
_DONGLE_START_TIMEOUT_NS = 5 * NANOSECONDS
"""For the boot loader of a dongle that opening the port has reset: 1.5 s."""
_DEFECT_RETRY_NS = NANOSECONDS
_ACTIVE_PING_TIMEOUT_NS = NANOSECONDS // 20
"""While the link runs: the next command must not wait."""
_MAX_TIMEOUTS = 5
"""Frames without an answer of the dongle before it is looked for anew."""
_HANDSHAKE_STATES = (LinkState.HELLO, LinkState.INFO, LinkState.PARAMS)
_GYRO_RANGE_ID = [parameter.name for parameter in BOARD_PARAMETERS].index('gyro_range')


class Link:
    """Decides what to send and when, from time, bytes and orders alone.

    Whoever holds the port calls :meth:`step` whenever bytes arrive or the instant of the last
    ``Wait`` has come, does what it returns, and reports with :meth:`opened` and :meth:`failed`.
    Times are those of a steady clock in nanoseconds.

    Parameters
    ----------
    settings
        Fixed for the life of the link.
    key
        Of the robot, 16 bytes; empty for an open link.
    entropy
        For session numbers and nonces.
    """

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes = b'',
        entropy: Entropy = secrets.token_bytes,
    ) -> None:
        self._parameters = parameters
        self._key = key
        self._entropy = entropy
        self._statistics = LinkStatistics(1.0 / parameters.cycle_rate, parameters.ttl)
        self._dialogue = TransactionLayer(self._statistics)
        self._orders = SetpointArbiter(parameters)
        self._reader = TelemetryDecoder()
        self._state = LinkState.CLOSED
        self._why = LinkState.CLOSED.value
        self._deeds: list[PortAction] = []
        self._due_ns = 0
        self._since_ns = 0
        """When looking for the dongle, or running, began."""
        self._back_off_ns = _MIN_REOPEN_NS
        self._estop_ns = 0
        self._session: Session | None = None
        self._greeting: Handshake | None = None
        self._running: ActiveSession | None = None
        self._info: Info | None = None
        self._board_parameters: dict[int, int] = {}
        self._telemetry: Telemetry | None = None
        self._heard_ns: int | None = None
        self._stopping = False

    # -- for whoever asks -------------------------------------------------------------------------

    @property
    def state(self) -> LinkState:
        """How far the link has come."""
        return self._state

    @property
    def authenticated(self) -> bool:
        """Whether commands are signed, and the robot checks them."""
        return bool(self._key) and self._state in (LinkState.PARAMS, LinkState.RUN, LinkState.STOP)

    @property
    def telemetry(self) -> Telemetry | None:
        """The newest measurement."""
        return self._telemetry

    @property
    def cycle_ns(self) -> int | None:
        """When the next command is to be sent: what is ordered then is not late; None: never."""
        return None if self._running is None else self._running.due_ns

    @property
    def sent(self) -> WheelSpeeds:
        """The wheel speeds that were last ordered, after every limit of the host."""
        return self._orders.sent

    @property
    def info(self) -> Info | None:
        """Who the robot is; None before it was met."""
        return self._info

    @property
    def parameters(self) -> dict[str, int]:
        """The robot's parameters as read back, in their units on the wire."""
        return {
            BOARD_PARAMETERS[number].name: value
            for number, value in self._board_parameters.items()
        }

    @property
    def battery(self) -> BatteryReading | None:
        """The robot's supply as it last said."""
        aux = self._statistics.robot
        return BatteryReading(aux.battery / 1000.0, math.nan, math.nan) if aux else None

    @property
    def robot_resets(self) -> int:
        """How often the robot was seen to start anew."""
        return self._statistics.robot_resets

    def answer(self, verb: int) -> str | None:
        """Return what became of the last request: None not known yet, empty done, or why not."""
        return self._orders.answers.get(verb)

    def quality(self, now_ns: int) -> LinkQuality:
        """Return how well the link works."""
        return self._statistics.quality(self._age(now_ns), self._dialogue.splitter.counts)

    def reason(self, now_ns: int) -> str:
        """Return in words why the robot does not move; empty when nothing hinders it."""
        if self._state in _HANDSHAKE_STATES and self._greeting is not None:
            return self._greeting.why
        if self._state is not LinkState.RUN:
            return self._why
        silence = min(self._age(now_ns), (now_ns - self._since_ns) / NANOSECONDS)
        if silence > self._parameters.ttl:
            return reasons.robot_absent(self._parameters.channel)
        status = self._telemetry.raw.status if self._telemetry is not None else StatusFlag(0)
        if why := self._orders.reason(bool(status & StatusFlag.ESTOP)):
            return why
        if status & StatusFlag.TTL_EXPIRED:
            return reasons.TTL_EXPIRED
        return '' if status & StatusFlag.ENABLED else reasons.DRIVES_DISABLED

    # -- for whoever orders -----------------------------------------------------------------------

    def command(self, command: RobotCommand, now_ns: int) -> str:
        """Follow a command until the next one or until it is too old; return why not."""
        return self._orders.take(command, now_ns)

    def stop(self, reason: str) -> None:
        """Come to rest; the next command moves the robot again."""
        self._orders.drop(reason)

    def latch_estop(self, reason: str) -> None:
        """Come to rest and stay so; a robot that is in nobody's session obeys, too."""
        self._orders.latch(reason)

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop here and in the robot; return why that is not needed."""
        there = self._telemetry is not None and self._telemetry.status.estop
        return self._orders.release(there, now_ns)

    def request(self, verb: int) -> None:
        """Ask the robot for an action as soon as it can be reached; see :meth:`answer`."""
        self._orders.request(verb)

    def shut_down(self) -> None:
        """Bring the robot to rest, take its drives out, close the port: the phase is DONE then."""
        self._stopping = True

    # -- for whoever holds the port ---------------------------------------------------------------

    def port_opened(self, now_ns: int) -> None:
        """Take notice that the port is open."""
        self._dialogue.reset()
        # What was found at the last try is said until there is something newer to say.
        why = self._why if self._why == reasons.NO_DONGLE else reasons.DONGLE_STARTING
        self._look_for_dongle(why, now_ns)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Take notice that the port could not be opened or used; ``text`` says why.

        A device that is absent is looked for five times a second, which costs nothing; after any
        other failure the port is tried less and less often.
        """
        if self._state is LinkState.DONE:
            return
        if self._state is not LinkState.OPEN:
            self._statistics.port_failures += 1
        self._close(LinkState.CLOSED, text)
        self._due_ns = now_ns + (_MIN_REOPEN_NS if absent else self._back_off_ns)
        # One that went away may come back free: whoever held it has lost it, too.
        self._back_off_ns = min(
            _MIN_REOPEN_NS if absent else 2 * self._back_off_ns, _MAX_REOPEN_NS
        )

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return what to do now; the last deed says until when there is nothing more to do."""
        for heard in self._dialogue.feed(received, now_ns):
            self._hear(heard, now_ns)
        silence = self._dialogue.expire(now_ns)
        if silence is not None:
            self._hear(silence, now_ns)
        if self._stopping:
            self._stop(now_ns)
        if self._dialogue.deadline_ns is None:
            self._speak(now_ns)
        deeds, self._deeds = self._deeds, []
        deeds.append(Wait(max(self._until_ns(now_ns), now_ns)))
        return deeds

    # -- inside -----------------------------------------------------------------------------------

    def _until_ns(self, now_ns: int) -> int:
        if self._state in (LinkState.OPEN, LinkState.DONE):
            return now_ns + NANOSECONDS
        if self._dialogue.deadline_ns is not None:
            return self._dialogue.deadline_ns
        if self._running is not None:
            return self._running.due_ns
        if self._state in _HANDSHAKE_STATES and self._orders.estop:
            return min(self._due_ns, self._estop_ns)
        return self._due_ns

    def _speak(self, now_ns: int) -> None:
        """Send what is due: one frame at most."""
        if self._running is not None and self._session is not None:
            self._speak_running(self._running, now_ns)
        elif self._state in _HANDSHAKE_STATES and self._orders.estop and now_ns >= self._estop_ns:
            self._estop_ns = now_ns + round(NANOSECONDS / self._parameters.cycle_rate)
            if self._session is not None:  # it has not begun, but stopping needs none
                self._transact(self._session.command(CommandFlag.ESTOP, 0, 0, 0, now_ns), now_ns)
        elif now_ns < self._due_ns:
            pass
        elif self._state is LinkState.CLOSED:
            self._state = LinkState.OPEN
            self._deeds.append(Open())
        elif self._state is LinkState.PING and now_ns - self._since_ns >= _DONGLE_START_TIMEOUT_NS:
            self.port_failed(reasons.NO_DONGLE, False, now_ns)
        elif self._state is LinkState.PING:
            self._write(self._dialogue.ping(_PING_TIMEOUT_NS, now_ns))
        elif self._state is LinkState.CFG:
            self._write(self._dialogue.configure(self._parameters.configure(0), now_ns))
        elif self._greeting is not None:
            frame, fetch = self._greeting.next(now_ns)
            self._transact(frame, now_ns, fetch)

    def _speak_running(self, running: ActiveSession, now_ns: int) -> None:
        frame = running.next(now_ns)
        if isinstance(frame, PingRequest):
            self._write(self._dialogue.ping(_ACTIVE_PING_TIMEOUT_NS, now_ns))
        elif frame is not None:
            self._transact(frame, now_ns)

    def _transact(self, first: Downlink, now_ns: int, fetch: int = frames.STATE) -> None:
        if self._session is not None:
            poll = self._session.poll(fetch)
            self._write(
                self._dialogue.transact(first, poll, self._parameters.gap_after(first), now_ns)
            )

    def _write(self, data: bytes) -> None:
        self._deeds.append(Write(data))

    def _hear(self, heard: TransactionResult, now_ns: int) -> None:
        self._statistics.dongle_resets += heard.dongle_restarted
        if isinstance(heard.reply, frames.Pong):
            self._statistics.dongle = heard.reply
        if isinstance(heard.uplink, frames.Aux):
            self._statistics.robot = heard.uplink
        if isinstance(heard.uplink, State):
            self._see(heard, heard.uplink)
        if self._state is LinkState.PING:
            self._hear_pong(heard, now_ns)
        elif heard.dongle_restarted:
            self._set_radio(now_ns)  # what was set is gone
        elif self._dialogue.silent >= _MAX_TIMEOUTS:
            self._look_for_dongle(reasons.DONGLE_TIMEOUT, now_ns)
        elif self._state is LinkState.CFG:
            self._hear_configured(heard, now_ns)
        elif self._running is not None:
            why = self._running.hear(heard)
            if self._running.finished:
                self._close(LinkState.DONE, reasons.SHUT_DOWN)
            elif why:
                self._greet(why, now_ns)
        elif self._greeting is not None and not isinstance(heard.asked, frames.Command):
            self._due_ns = now_ns + self._greeting.hear(heard)
            self._state = self._greeting.state
            if self._state is LinkState.RUN:
                self._run(self._greeting, now_ns)

    def _see(self, heard: TransactionResult, state: State) -> None:
        """Take a measurement; its times count if it answers the command that was sent."""
        ours = self._running is not None and state.seq == getattr(heard.asked, 'seq', None)
        sending = heard.sending if ours else None
        telemetry = self._reader.read(state, heard.returned_ns, sending)
        self._statistics.robot_resets += self._reader.rebooted
        if telemetry is not None:
            self._telemetry = telemetry
            self._heard_ns = heard.returned_ns

    def _hear_pong(self, heard: TransactionResult, now_ns: int) -> None:
        pong = heard.reply
        if not isinstance(pong, frames.Pong):
            return
        self._back_off_ns = _MIN_REOPEN_NS
        if pong.protocol != frames.VERSION:
            self._why = (
                f'the dongle must speak protocol {frames.VERSION}: it speaks {pong.protocol}'
            )
        elif not pong.chip_ok:
            self._why = reasons.NO_CHIP
        else:
            self._set_radio(now_ns)
            return
        # It is there; what is wrong takes a person.
        self._since_ns = now_ns
        self._due_ns = now_ns + _DEFECT_RETRY_NS

    def _hear_configured(self, heard: TransactionResult, now_ns: int) -> None:
        reply = heard.reply
        if isinstance(reply, Configured) and isinstance(heard.asked, frames.Configure):
            if not reply.chip_ok:
                self._look_for_dongle(reasons.NO_CHIP, now_ns)
                return
            if reply[:-1] == tuple(heard.asked):
                self._greet(reasons.robot_absent(self._parameters.channel), now_ns)
                return
            self._why = reasons.RADIO_NOT_CONFIGURED
        self._due_ns = now_ns + _CONFIGURE_RETRY_NS

    def _look_for_dongle(self, why: str, now_ns: int) -> None:
        self._enter(LinkState.PING, why)
        self._since_ns = self._due_ns = now_ns

    def _set_radio(self, now_ns: int) -> None:
        self._enter(LinkState.CFG, LinkState.CFG.value)
        self._due_ns = now_ns

    def _greet(self, why: str, now_ns: int) -> None:
        before = self._session.number if self._session else 0
        self._session = Session(self._key, self._entropy, before, now_ns)
        self._enter(LinkState.HELLO, why)
        self._greeting = Handshake(self._session, self._parameters, why)
        self._due_ns = now_ns

    def _run(self, greeting: Handshake, now_ns: int) -> None:
        self._info, self._board_parameters = greeting.info, greeting.parameters
        if self._session is None or greeting.info is None:
            return
        steps = greeting.info.steps_per_rev * greeting.info.microsteps
        try:
            self._reader.configure(steps, self._board_parameters.get(_GYRO_RANGE_ID, GYRO_RANGE))
        except ValueError as error:
            self._greet(f'the robot tells nonsense of itself: {error}', now_ns)
            return
        self._enter(LinkState.RUN, '')
        self._since_ns = now_ns
        self._statistics.sessions += 1
        self._running = ActiveSession(
            self._parameters, self._session, self._orders, self._statistics, now_ns
        )

    def _stop(self, now_ns: int) -> None:
        if self._state is LinkState.RUN and self._running is not None:
            self._state, self._why = LinkState.STOP, LinkState.STOP.value
            self._running.begin_stop(now_ns)
        elif self._state not in (LinkState.STOP, LinkState.DONE):
            self._close(LinkState.DONE, reasons.SHUT_DOWN)

    def _close(self, state: LinkState, why: str) -> None:
        if self._state is not LinkState.CLOSED:
            self._deeds.append(Close())
        self._dialogue.reset()
        self._enter(state, why)

    def _enter(self, state: LinkState, why: str) -> None:
        self._state, self._why = state, why
        self._greeting = self._running = None

    def _age(self, now_ns: int) -> float:
        """Return how many seconds ago the robot was last heard."""
        return math.inf if self._heard_ns is None else (now_ns - self._heard_ns) / NANOSECONDS
