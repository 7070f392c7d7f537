# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Within a session: cycles of command and measurement, requests between them, and the end."""

from typing import NamedTuple

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.radio import frames
from t3mpc_ros.radio.codec import exchange
from t3mpc_ros.radio.frames import Action, Command, Downlink, Flag, Result, State, Status
from t3mpc_ros.radio.link import words
from t3mpc_ros.radio.link.dialogue import Heard
from t3mpc_ros.radio.link.orders import Orders
from t3mpc_ros.radio.link.session import Session, absent
from t3mpc_ros.radio.link.settings import LinkSettings
from t3mpc_ros.radio.statistics import LinkStatistics

_SPARE_NS = NANOSECONDS // 100
"""A request is sent between two cycles if this much time is left."""
_GIVE_WAY = 10
"""Where cycles leave no such time, every tenth gives way to a request."""
_AUX_NS = _LOOK_NS = NANOSECONDS
_LOST = 100
"""Cycles without an answer before the robot is greeted anew: from the 128th on it would take
commands for old ones, because sequence numbers have eight bits."""
_UNTAKEN_NS = NANOSECONDS // 2
_STOPS = 3
"""Commands of standstill before the drives are taken out, if the robot stands by then."""
_STOP_NS = NANOSECONDS
"""After this long the drives are taken out even if it does not, or does not answer."""
_GOODBYES = 3


class Look(NamedTuple):
    """Ask the dongle how it fares."""


class Running:
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
        settings: LinkSettings,
        session: Session,
        orders: Orders,
        statistics: LinkStatistics,
        now_ns: int,
    ) -> None:
        self._settings = settings
        self._session = session
        self._orders = orders
        self._statistics = statistics
        self._period_ns = round(NANOSECONDS / settings.cycle_rate)
        self._due_ns = now_ns
        self._aux_ns = self._look_ns = now_ns
        self._cycles = 0
        self._taken_ns = now_ns
        self._status = Status(0)
        self._lost = 0
        self._stops: int | None = None
        self._stop_until_ns = 0
        self._goodbyes = _GOODBYES

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
            self._stops, self._stop_until_ns = _STOPS, now_ns + _STOP_NS
            self._due_ns = now_ns

    def next(self, now_ns: int) -> Downlink | Look | None:
        """Return what to send now, if anything; a POLL for the state goes with a payload."""
        if now_ns < self._due_ns:
            return self._aside(now_ns) if self._due_ns - now_ns >= _SPARE_NS else None
        # Late cycles are left out, not made up for.
        self._due_ns = max(self._due_ns + self._period_ns, now_ns + self._period_ns // 2)
        self._cycles += 1
        if self._period_ns < 2 * _SPARE_NS and self._cycles % _GIVE_WAY == 0:
            aside = self._aside(now_ns)
            if aside is not None:
                return aside
        return self._cycle(now_ns)

    def hear(self, heard: Heard) -> str:
        """Take an answer; return why the robot must be greeted anew, empty if it need not."""
        if isinstance(heard.asked, Action):
            self._orders.hear(heard.asked, heard.uplink)
        if isinstance(heard.asked, Command):
            answered = isinstance(heard.uplink, State)
            whole = answered and _own(heard, heard.asked)
            self._statistics.add_cycle(heard.round_trip if whole else None)
            self._lost = 0 if answered else self._lost + 1
            self._say_goodbye(heard)
        if isinstance(heard.uplink, State):
            return self._judge(heard, heard.uplink)
        return absent(self._settings.channel) if self._lost >= _LOST else ''

    def _aside(self, now_ns: int) -> Downlink | Look | None:
        """Return the request that has waited for a moment between cycles, if any."""
        if self._stops is not None:
            return None
        if self._orders.requested is not None:
            return self._session.action(self._orders.requested, now_ns)
        if now_ns >= self._aux_ns:
            self._aux_ns = now_ns + _AUX_NS
            return self._session.poll(frames.AUX)
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + _LOOK_NS
            return Look()
        return None

    def _cycle(self, now_ns: int) -> Downlink:
        if self._stops is not None:
            stands = not self._status & Status.MOVING and self._stops <= 0
            leave = stands or now_ns >= self._stop_until_ns
            self._stops = min(self._stops - 1, -1 if leave else self._stops)
            flags = Flag(0) if leave else Flag.ENABLE
            return self._session.command(flags, 0, 0, 0, now_ns)
        order = self._orders.next(bool(self._status & Status.ESTOP), now_ns)
        return self._session.command(
            order.flags, self._settings.ttl_units, order.left, order.right, now_ns
        )

    def _say_goodbye(self, heard: Heard) -> None:
        """Count a command that took the drives out; one that was acknowledged is enough."""
        if self._stops is None or not isinstance(heard.asked, Command) or heard.asked.flags:
            return
        reply = heard.reply
        taken = isinstance(reply, Result) and bool(reply.first & 1)
        self._goodbyes = 0 if taken else self._goodbyes - 1

    def _judge(self, heard: Heard, state: State) -> str:
        self._status = Status(state.status)
        if state.session != self._session.number or state.status & Status.NO_SESSION:
            return 'the robot has lost its session'
        if isinstance(heard.asked, Command):
            # An emergency stop is always obeyed, whatever comes of the rest of the command.
            if state.seq == heard.asked.seq or heard.asked.flags & Flag.ESTOP:
                self._taken_ns = heard.returned_ns
            elif heard.returned_ns - self._taken_ns > _UNTAKEN_NS:
                return words.NOT_TAKEN
        return ''


def _own(heard: Heard, asked: Command) -> bool:
    """Return whether a state is this cycle's own: a CMD alone fetches what was loaded before.

    Unless it was sent again: then it may fetch the answer to itself, and leave the POLL none.
    """
    fetched = isinstance(heard.reply, Result) and exchange(heard.reply.second).answered
    return fetched or getattr(heard.uplink, 'seq', None) == asked.seq
