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
"""State machine of the link: from a closed port to periodic commands and telemetry.

One frame is in flight at a time, and the host sets the pace: each cycle is a CMD with the newest
wheel speeds and a POLL that fetches the state sampled shortly after. Only requests are queued;
they are repeated until answered.
"""

import math
import secrets

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import Close, LinkState, Open, PortAction, Wait, Write
from t3mpc_ros.radio.link.handshake import BOOTS_ID, Entropy, Handshake, Session
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.setpoint_arbitration import SetpointArbiter
from t3mpc_ros.radio.link.statistics import LinkQuality, LinkStatistics, Loss
from t3mpc_ros.radio.link.telemetry import GYRO_RANGE, Telemetry, TelemetryDecoder
from t3mpc_ros.radio.link.transaction import TransactionLayer, TransactionResult
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_exchange_status
from t3mpc_ros.robot.interface import BatteryReading

_MIN_REOPEN_NS, _MAX_REOPEN_NS = NANOSECONDS // 5, 2 * NANOSECONDS
_PING_TIMEOUT_NS = _CONFIGURE_RETRY_NS = NANOSECONDS // 10
_DONGLE_START_TIMEOUT_NS = 5 * NANOSECONDS
"""Includes 1.5 s of boot loader after a reset by opening the port."""
_DEFECT_RETRY_NS = NANOSECONDS
_MAX_TIMEOUTS = 5
"""Consecutive requests without a reply before the link searches for the dongle again."""
_HANDSHAKE_STATES = (LinkState.HELLO, LinkState.INFO, LinkState.PARAMS)
_GYRO_RANGE_ID = [parameter.name for parameter in frames.BOARD_PARAMETERS].index('gyro_range')

_MIN_IDLE_NS = NANOSECONDS // 100  # idle time before the next cycle that a request needs
_REQUEST_DECIMATION = 10  # without idle time, every tenth cycle is replaced by a request
_AUX_PERIOD_NS = _PING_PERIOD_NS = _BOOTS_PERIOD_NS = NANOSECONDS
_ACTIVE_PING_TIMEOUT_NS = NANOSECONDS // 20  # short, because the next command waits for it
_MAX_LOST_CYCLES = 100
"""Consecutive lost cycles before a new handshake: sequence numbers have eight bits, so from the
128th on the robot would reject commands as old."""
_REJECTED_TIMEOUT_NS = NANOSECONDS // 2
_MIN_STOP_COMMANDS = 3
"""Standstill commands before the drives are disabled, if the robot then stands still."""
_STOP_TIMEOUT_NS = NANOSECONDS  # time after which the drives are disabled in any case
_DISABLE_COMMANDS = 5
_MIN_BATTERY_VOLTAGE = 1.0  # V; no battery has less
_CABLE_FIRMWARE = 2, 1  # first version of the firmware that drives over the cable
_COLLISION_HOLD_NS = 5 * NANOSECONDS  # standstill after two robots have answered
_REFUSAL_QUERY_NS = NANOSECONDS // 10
"""Time without an accepted command after which AUX is requested for the reason, and again."""


class ActiveSession:
    """Cycles of command and state within a session, requests between them, and its end."""

    def __init__(
        self,
        parameters: LinkParameters,
        session: Session,
        arbiter: SetpointArbiter,
        statistics: LinkStatistics,
        now_ns: int,
        counts_boots: bool,
    ) -> None:
        self._parameters = parameters
        self._session = session
        self._arbiter = arbiter
        self._statistics = statistics
        self._period_ns = round(NANOSECONDS / parameters.cycle_rate)
        self.due_ns = now_ns  # time of the next cycle
        self._aux_ns = self._ping_ns = self._boots_ns = now_ns
        self._counts_boots = counts_boots
        self._cycles = 0
        self._accepted_ns = self._answered_ns = now_ns
        self._silence_ns = _silence_ns(parameters)
        self._status = frames.StatusFlag(0)
        self._lost = 0
        self._stops: int | None = None
        self._stop_until_ns = 0
        self._disable_attempts = _DISABLE_COMMANDS

    def is_silent(self, now_ns: int) -> bool:
        """Return whether the robot has not answered for the time to live of a command."""
        return now_ns - self._answered_ns > self._silence_ns

    @property
    def out_of_reach(self) -> bool:
        """Whether so many cycles were lost that the robot may reject the numbers of new ones."""
        return self._lost >= _MAX_LOST_CYCLES

    @property
    def finished(self) -> bool:
        """Whether the stop is complete: drives disabled, or all attempts used."""
        return self._disable_attempts == 0

    def begin_stop(self, now_ns: int) -> None:
        """Stop the robot from now on; setpoints are ignored."""
        if self._stops is None:
            self._stops, self._stop_until_ns = _MIN_STOP_COMMANDS, now_ns + _STOP_TIMEOUT_NS
            self.due_ns = now_ns

    def next(self, now_ns: int, hold: bool) -> frames.Downlink | frames.Ping | None:
        """Return the request to send now, if any, before a POLL; ``hold``: command standstill."""
        if now_ns < self.due_ns:
            return self._next_request(now_ns) if self.due_ns - now_ns >= _MIN_IDLE_NS else None
        # Late cycles are skipped.
        self.due_ns = max(self.due_ns + self._period_ns, now_ns + self._period_ns // 2)
        self._cycles += 1
        if self._period_ns < 2 * _MIN_IDLE_NS and self._cycles % _REQUEST_DECIMATION == 0:
            request = self._next_request(now_ns)
            if request is not None:
                return request
        return self._next_command(now_ns, hold)

    def handle(self, result: TransactionResult) -> str:
        """Process a result; return the reason for a new handshake, empty if none is needed."""
        request, now_ns = result.request, result.returned_ns
        state = result.uplink if isinstance(result.uplink, frames.State) else None
        polls = isinstance(request, frames.Poll) and request.what == frames.STATE
        # The first STATE, or the first after a silence, is followed by a command at once: the
        # robot refuses every command before it, for its echo.
        if state is not None and self.is_silent(now_ns):
            self.due_ns = self._accepted_ns = now_ns
        elif state is not None and polls:
            self.due_ns = now_ns
        if result.uplink is not None:
            self._answered_ns = now_ns
        if isinstance(request, frames.Command):
            loss = _find_loss(result, request)
            self._statistics.add_cycle(result.round_trip if loss is None else loss)
            if self._stops is not None and not request.flags:
                # A STATE with disabled drives completes the stop. After a pause of the host, the
                # first command that disables them is refused for its echo.
                disabled = state is not None and not state.status & frames.StatusFlag.ENABLED
                self._disable_attempts = 0 if disabled else self._disable_attempts - 1
        if polls or isinstance(request, frames.Command):
            self._lost = 0 if state is not None else self._lost + 1
        return '' if state is None else self._check_state(result, state)

    def _next_request(self, now_ns: int) -> frames.Downlink | frames.Ping | None:
        """Return the request that is due between cycles, if any."""
        if self._stops is not None:
            return None
        if now_ns >= self._aux_ns:
            self._aux_ns = now_ns + _AUX_PERIOD_NS
            return self._session.poll(frames.AUX)
        if now_ns >= self._ping_ns:
            self._ping_ns = now_ns + _PING_PERIOD_NS
            return frames.Ping(0, b'')
        if self._counts_boots and now_ns >= self._boots_ns:
            # Another count than at the start of the session is that of another robot.
            self._boots_ns = now_ns + _BOOTS_PERIOD_NS
            return self._session.get(BOOTS_ID)
        return None

    def _next_command(self, now_ns: int, hold: bool) -> frames.Downlink:
        if self._stops is not None:
            standing = not self._status & frames.StatusFlag.MOVING and self._stops <= 0
            disable = standing or now_ns >= self._stop_until_ns
            self._stops = min(self._stops - 1, -1 if disable else self._stops)
            flags = frames.CommandFlag(0) if disable else frames.CommandFlag.ENABLE
            return self._session.command(flags, self._parameters.ttl_units, 0, 0, now_ns)
        if self._session.echo_us is None and not self._arbiter.estop:
            return self._session.poll(frames.STATE)
        flags, left, right, ttl = self._arbiter.next_setpoint(
            bool(self._status & frames.StatusFlag.ESTOP), now_ns, hold or self.is_silent(now_ns)
        )
        return self._session.command(flags, ttl, left, right, now_ns)

    def _check_state(self, result: TransactionResult, state: frames.State) -> str:
        self._status = frames.StatusFlag(state.status)
        if state.session != self._session.number or state.status & frames.StatusFlag.NO_SESSION:
            return reasons.SESSION_LOST
        if isinstance(result.request, frames.Command):
            # ESTOP is always executed, whether or not the rest of the command is accepted.
            if state.seq == result.request.seq or result.request.flags & frames.CommandFlag.ESTOP:
                self._accepted_ns = result.returned_ns
                return ''
            refused_ns = result.returned_ns - self._accepted_ns
            if refused_ns > _REJECTED_TIMEOUT_NS:
                aux = self._statistics.robot
                return reasons.refused('commands', aux.refusal if aux else 0)
            if refused_ns > _REFUSAL_QUERY_NS:
                self._aux_ns = min(self._aux_ns, self._accepted_ns + _REFUSAL_QUERY_NS)
        return ''


def _silence_ns(parameters: LinkParameters) -> int:
    """Return the time without an answer until the robot is silent: the TTL, or two slow cycles."""
    return round(NANOSECONDS * max(parameters.ttl, 2.0 / parameters.cycle_rate))


def _find_loss(result: TransactionResult, command: frames.Command) -> Loss | None:
    """Return where a cycle was lost; None if it returned a STATE that was sampled in it.

    The CMD itself fetches an older one. A retransmitted CMD may fetch its own STATE; the POLL then
    returns none.
    """
    if not isinstance(result.reply, frames.Result):
        return Loss.NO_REPLY
    poll = decode_exchange_status(result.reply.second)
    if isinstance(result.uplink, frames.State) and (
        poll.has_payload or result.uplink.seq == command.seq
    ):
        return None
    return Loss.ROBOT if poll.acknowledged else Loss.RADIO


class Link:
    """State machine of the link: decides what to send and when, from time, bytes and commands.

    The owner of the port calls :meth:`step` when bytes arrive or the last ``Wait`` ends,
    executes the returned actions, and reports with :meth:`port_opened` and
    :meth:`port_failed`. Times are nanoseconds of one steady clock. ``key`` has 16 bytes, or
    none for an open link; ``entropy`` is the source of session numbers and nonces.
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
        self._transactions = TransactionLayer(self._statistics)
        self._arbiter = SetpointArbiter(parameters)
        self._decoder = TelemetryDecoder()
        self.state = LinkState.CLOSED  # state of the connection
        self._reason = LinkState.CLOSED.value
        self._actions: list[PortAction] = []
        self._due_ns = 0
        self._since_ns = 0  # entry into PING or RUN
        self._reopen_ns = _MIN_REOPEN_NS
        self._estop_ns = 0
        self._lost_session = 0
        """Number of the session that the robot has reported as lost; 0: none."""
        self._session_ended = False
        """Whether an answer had another session than this one, which had started."""
        self._collision_until_ns = 0
        """Time until which the robot stands, because two robots have answered."""
        self._session: Session | None = None
        self._handshake: Handshake | None = None
        self._active: ActiveSession | None = None
        self._cable_allowed = True
        self.over_cable = False
        """Whether the port is the USB port of the robot board: there is no dongle and no radio."""
        self.info: frames.Info | None = None
        """Identity of the robot; None before the first session."""
        self._board_parameters: dict[int, int] = {}
        self.telemetry: Telemetry | None = None  # newest measurement
        self._received_ns: int | None = None
        self._silence_ns = _silence_ns(parameters)
        self._longest_pause_ns = 3 * self._silence_ns // 4
        """Time without a call of step after which the host was suspended."""
        self._stepped_ns = self._resumed_ns = self._pause_ns = 0
        """Time of the last call; of the one after a suspension, and its duration; in a session."""
        self._shutting_down = False

    # -- status -----------------------------------------------------------------------------------

    @property
    def authenticated(self) -> bool:
        """Whether commands are signed and the robot verifies them."""
        return bool(self._key) and self.state in (LinkState.PARAMS, LinkState.RUN, LinkState.STOP)

    @property
    def next_cycle_ns(self) -> int | None:
        """Time at which the next command is sent; None outside a session."""
        return None if self._active is None else self._active.due_ns

    @property
    def sent_wheels(self) -> WheelSpeeds:
        """Wheel speeds of the last setpoint, after every limit of the host."""
        return self._arbiter.sent_wheels

    @property
    def board_parameters(self) -> dict[str, int]:
        """Board parameters as read back, in their units on the wire."""
        return {
            frames.BOARD_PARAMETERS[number].name: value
            for number, value in self._board_parameters.items()
        }

    @property
    def battery(self) -> BatteryReading | None:
        """Last battery reading of the robot."""
        aux = self._statistics.robot
        return BatteryReading(aux.battery / 1000.0, math.nan, math.nan) if aux else None

    @property
    def robot_resets(self) -> int:
        """Number of detected restarts of the robot."""
        return self._statistics.robot_resets

    def is_silent(self, now_ns: int) -> bool:
        """Return whether the robot has not answered for the time to live of a command.

        Commands may still reach it. The link then sends standstill.
        """
        return self._active is not None and self._active.is_silent(now_ns)

    def quality(self, now_ns: int) -> LinkQuality:
        """Return the quality of the link."""
        return self._statistics.quality(self._age(now_ns), self._transactions.frame_counts)

    def reason(self, now_ns: int) -> str:
        """Return why the robot does not move; empty when it follows commands."""
        if now_ns < self._collision_until_ns and self.state in (*_HANDSHAKE_STATES, LinkState.RUN):
            return reasons.two_robots(self._parameters.address, self._parameters.channel)
        if self.state in _HANDSHAKE_STATES and self._handshake is not None:
            return self._handshake.reason
        if self.state is not LinkState.RUN:
            return self._reason
        silence_ns = min(self._age(now_ns) * NANOSECONDS, now_ns - self._since_ns)
        if silence_ns > self._silence_ns:
            return self._silence_reason(now_ns)
        status = self.telemetry.raw.status if self.telemetry is not None else frames.StatusFlag(0)
        if reason := self._arbiter.reason(bool(status & frames.StatusFlag.ESTOP)):
            return reason
        if status & frames.StatusFlag.TTL_EXPIRED:
            return reasons.TTL_EXPIRED
        if status & frames.StatusFlag.ENABLED:
            return ''
        if not status & frames.StatusFlag.LOW_BATTERY:
            return reasons.DRIVES_DISABLED
        absent = self.battery is not None and self.battery.voltage < _MIN_BATTERY_VOLTAGE
        return reasons.BATTERY_ABSENT if absent else reasons.BATTERY_CUTOFF

    def _silence_reason(self, now_ns: int) -> str:
        """Return why nothing has come from the robot; it was not asked by a suspended host."""
        pause_ns = now_ns - self._stepped_ns
        if pause_ns <= self._longest_pause_ns and now_ns - self._resumed_ns <= self._silence_ns:
            pause_ns = self._pause_ns
        if pause_ns > self._longest_pause_ns:
            return reasons.host_suspended(pause_ns / NANOSECONDS)
        return self._no_reply if self._statistics.lost_before_radio() else self._absent

    @property
    def _absent(self) -> str:
        """Text for a robot that does not answer."""
        if self.over_cable:
            return reasons.ROBOT_SILENT
        return reasons.robot_absent(self._parameters.address, self._parameters.channel)

    @property
    def _no_reply(self) -> str:
        """Text for a board at the port that does not reply."""
        return reasons.BOARD_TIMEOUT if self.over_cable else reasons.NO_REPLY

    # -- commands ---------------------------------------------------------------------------------

    def command(self, wheels: WheelSpeeds, until_ns: int) -> None:
        """Follow finite wheel speeds (rad/s) up to ``until_ns``, even if the host dies."""
        self._arbiter.command(wheels, until_ns)

    def stop(self, reason: str) -> None:
        """Stop until the next command."""
        self._arbiter.clear(reason)

    def latch_estop(self, reason: str) -> None:
        """Latch the emergency stop; the robot accepts it in any session."""
        self._arbiter.latch(reason)

    def release_estop(self, now_ns: int) -> str:
        """Release the emergency stop of host and robot; return why that is not needed."""
        robot_latched = self.telemetry is not None and self.telemetry.status.estop
        return self._arbiter.release(robot_latched, now_ns)

    def shut_down(self) -> None:
        """Stop the robot, disable its drives and close the port; the final state is DONE."""
        self._shutting_down = True

    # -- port -------------------------------------------------------------------------------------

    def port_opened(self, now_ns: int, cable: bool = True) -> None:
        """Report that the port is open; ``cable``: that of a robot board will do."""
        self._transactions.reset()
        self._cable_allowed = cable
        # The finding of the last attempt stays visible until there is a new one.
        reason = self._reason if self._reason == reasons.NO_DONGLE else reasons.DONGLE_STARTING
        self._search_dongle(reason, now_ns)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Report that the port cannot be opened or used, for the reason ``text``.

        The port of an absent device is retried five times a second; after any other failure the
        retry interval doubles up to 2 s.
        """
        if self.state is LinkState.DONE:
            return
        if self.state is not LinkState.OPEN:
            self._statistics.port_failures += 1
        self._close(LinkState.CLOSED, text)
        self._due_ns = now_ns + (_MIN_REOPEN_NS if absent else self._reopen_ns)
        # A device that was unplugged returns free of other users: the interval starts again.
        self._reopen_ns = min(_MIN_REOPEN_NS if absent else 2 * self._reopen_ns, _MAX_REOPEN_NS)

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return the actions to execute now; the last one is the time of the next call."""
        if self._active is not None and now_ns - self._stepped_ns > self._longest_pause_ns:
            self._resumed_ns, self._pause_ns = now_ns, now_ns - self._stepped_ns
        self._stepped_ns = now_ns
        for result in self._transactions.feed(received, now_ns):
            self._handle(result, now_ns)
        silence = self._transactions.expire(now_ns)
        if silence is not None:
            self._handle(silence, now_ns)
        if self._shutting_down:
            self._continue_stop(now_ns)
        if self._transactions.deadline_ns is None:
            self._send(now_ns)
        actions, self._actions = self._actions, []
        actions.append(Wait(max(self._until_ns(now_ns), now_ns)))
        return actions

    # -- internal ---------------------------------------------------------------------------------

    def _until_ns(self, now_ns: int) -> int:
        if self.state in (LinkState.OPEN, LinkState.DONE):
            return now_ns + NANOSECONDS
        if self._transactions.deadline_ns is not None:
            return self._transactions.deadline_ns
        if self._active is not None:
            return self._active.due_ns
        if self.state in _HANDSHAKE_STATES and self._arbiter.estop:
            return min(self._due_ns, self._estop_ns)
        return self._due_ns

    def _send(self, now_ns: int) -> None:
        """Send the request that is due, if any."""
        if self._active is not None:
            self._send_active(self._active, now_ns)
        elif self.state in _HANDSHAKE_STATES and self._arbiter.estop and now_ns >= self._estop_ns:
            self._send_estop(now_ns)
        elif now_ns >= self._due_ns:
            self._send_connecting(now_ns)

    def _send_estop(self, now_ns: int) -> None:
        """Repeat ESTOP with the cycles: it needs no session that has started."""
        self._estop_ns = now_ns + round(NANOSECONDS / self._parameters.cycle_rate)
        if self._session is not None:
            self._transact(
                self._session.command(frames.CommandFlag.ESTOP, 0, 0, 0, now_ns), now_ns
            )

    def _send_connecting(self, now_ns: int) -> None:
        """Take the next step from a closed port to a session."""
        match self.state:
            case LinkState.CLOSED:
                self.state = LinkState.OPEN
                self._actions.append(Open())
            case LinkState.PING if now_ns - self._since_ns >= _DONGLE_START_TIMEOUT_NS:
                self.port_failed(reasons.NO_DONGLE, False, now_ns)
            case LinkState.PING:
                self._write(self._transactions.ping(_PING_TIMEOUT_NS, now_ns))
            case LinkState.CFG:
                self._write(self._transactions.configure(self._parameters.configure(0), now_ns))
        if self._handshake is not None:
            frame, what = self._handshake.next_request(now_ns)
            self._transact(frame, now_ns, what)

    def _send_active(self, active: ActiveSession, now_ns: int) -> None:
        frame = active.next(now_ns, hold=now_ns < self._collision_until_ns)
        if isinstance(frame, frames.Ping):
            self._write(self._transactions.ping(_ACTIVE_PING_TIMEOUT_NS, now_ns))
        elif frame is not None:
            self._transact(frame, now_ns)

    def _transact(self, first: frames.Downlink, now_ns: int, what: int = frames.STATE) -> None:
        if self._session is not None:
            poll = self._session.poll(what)
            self._write(
                self._transactions.transact(first, poll, self._parameters.gap_after(first), now_ns)
            )

    def _write(self, data: bytes) -> None:
        self._actions.append(Write(data))

    def _handle(self, result: TransactionResult, now_ns: int) -> None:
        restarted = result.dongle_restarted or self._lost_configuration(result)
        self._statistics.dongle_resets += restarted and not self.over_cable
        if restarted:
            self._statistics.explain_losses()
        self._statistics.count_host_errors(self._transactions.frame_counts)
        if isinstance(result.reply, frames.Pong):
            self._statistics.add_pong(result.reply, restarted)
        if isinstance(result.uplink, frames.Aux):
            self._statistics.robot = result.uplink
        if isinstance(result.uplink, frames.State):
            self._handle_state(result, result.uplink)
        self._note_collision(self._contradicts(result.uplink), now_ns)
        if self.state is LinkState.PING:
            self._handle_pong(result, now_ns)
        elif restarted:
            self._configure_radio(now_ns)  # the restart cleared its configuration
        elif self._transactions.timeouts >= _MAX_TIMEOUTS:
            cable = self.over_cable
            self._search_dongle(reasons.BOARD_TIMEOUT if cable else reasons.DONGLE_TIMEOUT, now_ns)
        elif self.state is LinkState.CFG:
            self._handle_configured(result, now_ns)
        else:
            self._handle_robot(result, now_ns)

    def _lost_configuration(self, result: TransactionResult) -> bool:
        """Return whether a PONG in a session shows another channel or address than configured."""
        pong = result.reply
        if self._active is None or self.over_cable or not isinstance(pong, frames.Pong):
            return False
        wanted = self._parameters.configure(0)
        return (pong.channel, pong.address) != (wanted.channel, wanted.address)

    def _handle_robot(self, result: TransactionResult, now_ns: int) -> None:
        """Process the answer of the robot in a session, or in the handshake before it."""
        if self._active is not None:
            reason = self._active.handle(result)
            if self._active.out_of_reach:
                reason = self._silence_reason(now_ns)
            if self._active.finished:
                self._close(LinkState.DONE, reasons.SHUT_DOWN)
            elif self._counts_differ(result.uplink):
                self._start_handshake(reasons.OTHER_ROBOT, now_ns)
            elif reason:
                self._start_handshake(reason, now_ns)
        elif self._handshake is not None and not isinstance(result.request, frames.Command):
            self._due_ns = now_ns + self._handshake.handle(result)
            self.state = self._handshake.state
            if self.state is LinkState.RUN:
                self._start_session(self._handshake, now_ns)

    def _handle_state(self, result: TransactionResult, state: frames.State) -> None:
        """Process a STATE; it is a clock sample if it answers the command sent."""
        own = self._active is not None and state.seq == getattr(result.request, 'seq', None)
        timing = result.timing if own else None
        telemetry = self._decoder.decode(state, result.returned_ns, timing)
        self._note_collision(self._decoder.two_robots, result.returned_ns)
        if telemetry is not None:
            if self._session is not None:
                self._session.echo_us = state.time_us
            self.telemetry = telemetry
            self._received_ns = result.returned_ns

    def _note_collision(self, two_robots: bool, now_ns: int) -> None:
        """Stop for a while if two robots answer: each would follow every command."""
        if two_robots:
            self._statistics.collisions += 1
            self._collision_until_ns = now_ns + _COLLISION_HOLD_NS

    def _contradicts(self, answer: frames.Uplink | None) -> bool:
        """Return whether an answer and an earlier one cannot be of one robot.

        A session that an answer did not have is over, and the robot does not return to it.
        """
        if answer is None or self._session is None:
            return False
        if self._lost_session and answer.session == self._lost_session:
            return True
        if self.state not in (LinkState.PARAMS, LinkState.RUN, LinkState.STOP):
            self._session_ended = False
        elif answer.session != self._session.number:
            self._session_ended = True
        elif self._session_ended:
            return True
        return self._counts_differ(answer)

    def _counts_differ(self, answer: frames.Uplink | None) -> bool:
        """Return whether an answer has another count of starts than that of the session."""
        known = self._handshake.board_parameters if self._handshake else self._board_parameters
        return (
            isinstance(answer, frames.Param)
            and (answer.id, answer.rc) == (BOOTS_ID, frames.OK)
            and known.get(BOOTS_ID) not in (None, answer.value)
        )

    def _handle_pong(self, result: TransactionResult, now_ns: int) -> None:
        pong = result.reply
        if not isinstance(pong, frames.Pong):
            return
        self._reopen_ns = _MIN_REOPEN_NS
        if pong.protocol == frames.VERSION:
            self._configure_radio(now_ns)
            return
        # The dongle answers; the defect needs manual repair.
        self._reason = (
            f'the dongle must speak protocol {frames.VERSION}: it speaks {pong.protocol}'
        )
        self._since_ns = now_ns
        self._due_ns = now_ns + _DEFECT_RETRY_NS

    def _handle_configured(self, result: TransactionResult, now_ns: int) -> None:
        reply = result.reply
        if isinstance(reply, frames.Configured) and isinstance(result.request, frames.Configure):
            self._use_cable(False)
            if not reply.chip_ok:
                self._reason = reasons.NO_CHIP
                self._statistics.explain_losses()
                self._due_ns = now_ns + _DEFECT_RETRY_NS
                return
            if reply[:-1] == tuple(result.request):
                self._start_handshake(LinkState.HELLO.value, now_ns)
                return
            self._reason = reasons.RADIO_NOT_CONFIGURED
        elif isinstance(reply, frames.Refusal) and reply.code == frames.UNKNOWN:
            # Its console answers PING as well. The port stays open: opening it resets the robot.
            pong = self._statistics.dongle
            new = pong is not None and (pong.major, pong.minor) >= _CABLE_FIRMWARE
            if self._cable_allowed and new:
                self._use_cable(True)
                self._start_handshake(LinkState.HELLO.value, now_ns)
                return
            self._reason = reasons.ROBOT_USB
            self._due_ns = now_ns + _DEFECT_RETRY_NS
            return
        self._due_ns = now_ns + _CONFIGURE_RETRY_NS

    def _use_cable(self, cable: bool) -> None:
        self.over_cable = self._transactions.over_cable = cable

    def _search_dongle(self, reason: str, now_ns: int) -> None:
        self._enter(LinkState.PING, reason)
        self._since_ns = self._due_ns = now_ns

    def _configure_radio(self, now_ns: int) -> None:
        self._enter(LinkState.CFG, LinkState.CFG.value)
        self._due_ns = now_ns

    def _start_handshake(self, reason: str, now_ns: int) -> None:
        before = self._session.number if self._session else 0
        self._session = Session(self._key, self._entropy, before, now_ns)
        self._lost_session = before if reason == reasons.SESSION_LOST else 0
        self._enter(LinkState.HELLO, reason)
        self._handshake = Handshake(
            self._session, self._parameters, reason, self._absent, self._no_reply
        )
        self._due_ns = now_ns

    def _start_session(self, handshake: Handshake, now_ns: int) -> None:
        self.info, self._board_parameters = handshake.info, handshake.board_parameters
        if self._session is None or handshake.info is None:
            return
        steps = handshake.info.steps_per_rev * handshake.info.microsteps
        try:
            self._decoder.configure(steps, self._board_parameters.get(_GYRO_RANGE_ID, GYRO_RANGE))
        except ValueError as error:
            self._start_handshake(f'the robot reports invalid information: {error}', now_ns)
            return
        restarts = self._decoder.start_session(
            self._session.number, self._board_parameters.get(BOOTS_ID), now_ns
        )
        self._statistics.robot_resets += restarts
        if restarts:
            self._statistics.explain_losses()
        self._note_collision(self._decoder.two_robots, now_ns)
        self._lost_session = 0
        self._enter(LinkState.RUN, '')
        self._since_ns = now_ns
        self._statistics.sessions += 1
        self._active = ActiveSession(
            self._parameters,
            self._session,
            self._arbiter,
            self._statistics,
            now_ns,
            BOOTS_ID in self._board_parameters,
        )

    def _continue_stop(self, now_ns: int) -> None:
        if self.state is LinkState.RUN and self._active is not None:
            self.state, self._reason = LinkState.STOP, LinkState.STOP.value
            self._active.begin_stop(now_ns)
        elif self.state not in (LinkState.STOP, LinkState.DONE):
            self._close(LinkState.DONE, reasons.SHUT_DOWN)

    def _close(self, state: LinkState, reason: str) -> None:
        if self.state is not LinkState.CLOSED:
            self._actions.append(Close())
        self._transactions.reset()
        self._enter(state, reason)

    def _enter(self, state: LinkState, reason: str) -> None:
        self.state, self._reason = state, reason
        self._handshake = self._active = None
        self._resumed_ns = self._pause_ns = 0

    def _age(self, now_ns: int) -> float:
        """Return the time since the last telemetry, s."""
        return (
            math.inf if self._received_ns is None else (now_ns - self._received_ns) / NANOSECONDS
        )
