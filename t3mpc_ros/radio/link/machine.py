# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The host's end of the link: from a closed port to commands and measurements, and back.

One frame is on its way at a time, and the host paces: each cycle is a CMD with the newest wheel
speeds and a POLL that fetches what the robot measured a moment later. Nothing is queued but
requests, which are repeated until answered.
"""

import math
import secrets

from t3mpc_ros.motion import WheelSpeeds
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.radio import frames
from t3mpc_ros.radio.frames import PARAMETERS, Configured, Downlink, Flag, Info, State, Status
from t3mpc_ros.radio.link import words
from t3mpc_ros.radio.link.dialogue import Dialogue, Heard
from t3mpc_ros.radio.link.orders import Orders
from t3mpc_ros.radio.link.running import Look, Running
from t3mpc_ros.radio.link.session import Entropy, Greeting, Session, absent
from t3mpc_ros.radio.link.settings import LinkSettings
from t3mpc_ros.radio.link.telemetry import GYRO_RANGE, Telemetry, TelemetryReader
from t3mpc_ros.radio.link.words import Close, Deed, Open, Phase, Wait, Write
from t3mpc_ros.radio.statistics import LinkStatistics, Quality
from t3mpc_ros.robot.backend import BatteryReading, RobotCommand

_BACK_OFF_NS, _LONGEST_NS = NANOSECONDS // 5, 2 * NANOSECONDS
_PING_NS = _CFG_NS = NANOSECONDS // 10
_PING_PATIENCE_NS = 5 * NANOSECONDS
"""For the boot loader of a dongle that opening the port has reset: 1.5 s."""
_NO_CHIP_NS = NANOSECONDS
_LOOK_PATIENCE_NS = NANOSECONDS // 20
"""While the link runs: the next command must not wait."""
_SILENT = 5
"""Frames without an answer of the dongle before it is looked for anew."""
_GREETING = (Phase.HELLO, Phase.INFO, Phase.PARAMS)
_GYRO_RANGE_ID = [parameter.name for parameter in PARAMETERS].index('gyro_range')


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
        settings: LinkSettings,
        key: bytes = b'',
        entropy: Entropy = secrets.token_bytes,
    ) -> None:
        self._settings = settings
        self._key = key
        self._entropy = entropy
        self._statistics = LinkStatistics(1.0 / settings.cycle_rate, settings.ttl)
        self._dialogue = Dialogue(self._statistics)
        self._orders = Orders(settings)
        self._reader = TelemetryReader()
        self._phase = Phase.CLOSED
        self._why = Phase.CLOSED.value
        self._deeds: list[Deed] = []
        self._due_ns = 0
        self._since_ns = 0
        """When looking for the dongle, or running, began."""
        self._back_off_ns = _BACK_OFF_NS
        self._estop_ns = 0
        self._session: Session | None = None
        self._greeting: Greeting | None = None
        self._running: Running | None = None
        self._info: Info | None = None
        self._parameters: dict[int, int] = {}
        self._telemetry: Telemetry | None = None
        self._heard_ns: int | None = None
        self._stopping = False

    # -- for whoever asks -------------------------------------------------------------------------

    @property
    def phase(self) -> Phase:
        """How far the link has come."""
        return self._phase

    @property
    def authenticated(self) -> bool:
        """Whether commands are signed, and the robot checks them."""
        return bool(self._key) and self._phase in (Phase.PARAMS, Phase.RUN, Phase.STOP)

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
        return {PARAMETERS[number].name: value for number, value in self._parameters.items()}

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

    def quality(self, now_ns: int) -> Quality:
        """Return how well the link works."""
        return self._statistics.quality(self._age(now_ns), self._dialogue.splitter.counts)

    def reason(self, now_ns: int) -> str:
        """Return in words why the robot does not move; empty when nothing hinders it."""
        if self._phase in _GREETING and self._greeting is not None:
            return self._greeting.why
        if self._phase is not Phase.RUN:
            return self._why
        silence = min(self._age(now_ns), (now_ns - self._since_ns) / NANOSECONDS)
        if silence > self._settings.ttl:
            return absent(self._settings.channel)
        status = self._telemetry.raw.status if self._telemetry is not None else Status(0)
        if why := self._orders.reason(bool(status & Status.ESTOP)):
            return why
        if status & Status.TTL_EXPIRED:
            return words.EXPIRED
        return '' if status & Status.ENABLED else words.DISABLED

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

    def opened(self, now_ns: int) -> None:
        """Take notice that the port is open."""
        self._dialogue.reset()
        # What was found at the last try is said until there is something newer to say.
        why = self._why if self._why == words.NO_DONGLE else words.STARTING
        self._look_for_dongle(why, now_ns)

    def failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Take notice that the port could not be opened or used; ``text`` says why.

        A device that is absent is looked for five times a second, which costs nothing; after any
        other failure the port is tried less and less often.
        """
        if self._phase is Phase.DONE:
            return
        if self._phase is not Phase.OPEN:
            self._statistics.port_failures += 1
        self._close(Phase.CLOSED, text)
        self._due_ns = now_ns + (_BACK_OFF_NS if absent else self._back_off_ns)
        # One that went away may come back free: whoever held it has lost it, too.
        self._back_off_ns = min(_BACK_OFF_NS if absent else 2 * self._back_off_ns, _LONGEST_NS)

    def step(self, now_ns: int, received: bytes = b'') -> list[Deed]:
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
        if self._phase in (Phase.OPEN, Phase.DONE):
            return now_ns + NANOSECONDS
        if self._dialogue.deadline_ns is not None:
            return self._dialogue.deadline_ns
        if self._running is not None:
            return self._running.due_ns
        if self._phase in _GREETING and self._orders.estop:
            return min(self._due_ns, self._estop_ns)
        return self._due_ns

    def _speak(self, now_ns: int) -> None:
        """Send what is due: one frame at most."""
        if self._running is not None and self._session is not None:
            self._speak_running(self._running, now_ns)
        elif self._phase in _GREETING and self._orders.estop and now_ns >= self._estop_ns:
            self._estop_ns = now_ns + round(NANOSECONDS / self._settings.cycle_rate)
            if self._session is not None:  # it has not begun, but stopping needs none
                self._transact(self._session.command(Flag.ESTOP, 0, 0, 0, now_ns), now_ns)
        elif now_ns < self._due_ns:
            pass
        elif self._phase is Phase.CLOSED:
            self._phase = Phase.OPEN
            self._deeds.append(Open())
        elif self._phase is Phase.PING and now_ns - self._since_ns >= _PING_PATIENCE_NS:
            self.failed(words.NO_DONGLE, False, now_ns)
        elif self._phase is Phase.PING:
            self._write(self._dialogue.ping(_PING_NS, now_ns))
        elif self._phase is Phase.CFG:
            self._write(self._dialogue.configure(self._settings.configure(0), now_ns))
        elif self._greeting is not None:
            frame, fetch = self._greeting.next(now_ns)
            self._transact(frame, now_ns, fetch)

    def _speak_running(self, running: Running, now_ns: int) -> None:
        frame = running.next(now_ns)
        if isinstance(frame, Look):
            self._write(self._dialogue.ping(_LOOK_PATIENCE_NS, now_ns))
        elif frame is not None:
            self._transact(frame, now_ns)

    def _transact(self, first: Downlink, now_ns: int, fetch: int = frames.STATE) -> None:
        if self._session is not None:
            poll = self._session.poll(fetch)
            self._write(
                self._dialogue.transact(first, poll, self._settings.gap_after(first), now_ns)
            )

    def _write(self, data: bytes) -> None:
        self._deeds.append(Write(data))

    def _hear(self, heard: Heard, now_ns: int) -> None:
        self._statistics.dongle_resets += heard.dongle_restarted
        if isinstance(heard.reply, frames.Pong):
            self._statistics.dongle = heard.reply
        if isinstance(heard.uplink, frames.Aux):
            self._statistics.robot = heard.uplink
        if isinstance(heard.uplink, State):
            self._see(heard, heard.uplink)
        if self._phase is Phase.PING:
            self._hear_pong(heard, now_ns)
        elif heard.dongle_restarted:
            self._set_radio(now_ns)  # what was set is gone
        elif self._dialogue.silent >= _SILENT:
            self._look_for_dongle(words.FELL_SILENT, now_ns)
        elif self._phase is Phase.CFG:
            self._hear_configured(heard, now_ns)
        elif self._running is not None:
            why = self._running.hear(heard)
            if self._running.finished:
                self._close(Phase.DONE, words.STOPPED)
            elif why:
                self._greet(why, now_ns)
        elif self._greeting is not None and not isinstance(heard.asked, frames.Command):
            self._due_ns = now_ns + self._greeting.hear(heard)
            self._phase = self._greeting.phase
            if self._phase is Phase.RUN:
                self._run(self._greeting, now_ns)

    def _see(self, heard: Heard, state: State) -> None:
        """Take a measurement; its times count if it answers the command that was sent."""
        ours = self._running is not None and state.seq == getattr(heard.asked, 'seq', None)
        sending = heard.sending if ours else None
        telemetry = self._reader.read(state, heard.returned_ns, sending)
        self._statistics.robot_resets += self._reader.rebooted
        if telemetry is not None:
            self._telemetry = telemetry
            self._heard_ns = heard.returned_ns

    def _hear_pong(self, heard: Heard, now_ns: int) -> None:
        pong = heard.reply
        if not isinstance(pong, frames.Pong):
            return
        self._back_off_ns = _BACK_OFF_NS
        if pong.protocol != frames.VERSION:
            self._why = (
                f'the dongle must speak protocol {frames.VERSION}: it speaks {pong.protocol}'
            )
        elif not pong.chip_ok:
            self._why = words.NO_CHIP
        else:
            self._set_radio(now_ns)
            return
        # It is there; what is wrong takes a person.
        self._since_ns = now_ns
        self._due_ns = now_ns + _NO_CHIP_NS

    def _hear_configured(self, heard: Heard, now_ns: int) -> None:
        reply = heard.reply
        if isinstance(reply, Configured) and isinstance(heard.asked, frames.Configure):
            if not reply.chip_ok:
                self._look_for_dongle(words.NO_CHIP, now_ns)
                return
            if reply[:-1] == tuple(heard.asked):
                self._greet(absent(self._settings.channel), now_ns)
                return
            self._why = words.NOT_SET
        self._due_ns = now_ns + _CFG_NS

    def _look_for_dongle(self, why: str, now_ns: int) -> None:
        self._enter(Phase.PING, why)
        self._since_ns = self._due_ns = now_ns

    def _set_radio(self, now_ns: int) -> None:
        self._enter(Phase.CFG, Phase.CFG.value)
        self._due_ns = now_ns

    def _greet(self, why: str, now_ns: int) -> None:
        before = self._session.number if self._session else 0
        self._session = Session(self._key, self._entropy, before, now_ns)
        self._enter(Phase.HELLO, why)
        self._greeting = Greeting(self._session, self._settings, why)
        self._due_ns = now_ns

    def _run(self, greeting: Greeting, now_ns: int) -> None:
        self._info, self._parameters = greeting.info, greeting.parameters
        if self._session is None or greeting.info is None:
            return
        steps = greeting.info.steps_per_rev * greeting.info.microsteps
        try:
            self._reader.configure(steps, self._parameters.get(_GYRO_RANGE_ID, GYRO_RANGE))
        except ValueError as error:
            self._greet(f'the robot tells nonsense of itself: {error}', now_ns)
            return
        self._enter(Phase.RUN, '')
        self._since_ns = now_ns
        self._statistics.sessions += 1
        self._running = Running(
            self._settings, self._session, self._orders, self._statistics, now_ns
        )

    def _stop(self, now_ns: int) -> None:
        if self._phase is Phase.RUN and self._running is not None:
            self._phase, self._why = Phase.STOP, Phase.STOP.value
            self._running.begin_stop(now_ns)
        elif self._phase not in (Phase.STOP, Phase.DONE):
            self._close(Phase.DONE, words.STOPPED)

    def _close(self, phase: Phase, why: str) -> None:
        if self._phase is not Phase.CLOSED:
            self._deeds.append(Close())
        self._dialogue.reset()
        self._enter(phase, why)

    def _enter(self, phase: Phase, why: str) -> None:
        self._phase, self._why = phase, why
        self._greeting = self._running = None

    def _age(self, now_ns: int) -> float:
        """Return how many seconds ago the robot was last heard."""
        return math.inf if self._heard_ns is None else (now_ns - self._heard_ns) / NANOSECONDS
