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
"""A run in real time: its data, what its nodes report, and the banner that says what it does."""

from collections.abc import Mapping, Sequence
import math
from typing import Literal, NamedTuple

from t3mpc_ros.view.live_data import SPAN, STEP, LiveData

Condition = Literal['normal', 'warning', 'stopped']

LOST = 1.5
"""Time without odometry after which the connection counts as lost, s."""
ROBOTS = ('sim_robot', 'radio_bridge')
"""Nodes that are a robot."""
ESTOP = 'emergency stop'
"""Begin of the reason of a robot whose e-stop is latched."""


class NodeReport(NamedTuple):
    """Newest report of a node about itself, from its log or its diagnostics."""

    text: str
    condition: Condition = 'normal'


PAUSED = NodeReport('paused')
"""Report of a reference generator that was paused."""


LOST_REMEDY = (
    'what is shown is old, and a stop may not reach the robot: use the switch on the robot, then '
    'check that sim_robot or radio_bridge runs and is connected'
)


class Banner(NamedTuple):
    """One line in large letters, and the reason for it."""

    kind: Literal['good', 'warning', 'stopped', 'lost']
    headline: str
    detail: str

    def cause(self) -> tuple[str, str]:
        """Return the headline and the first reason."""
        return self.headline, self.detail.partition('; ')[0]


def banner(
    reports: Mapping[str, NodeReport], odometry_age: float | None, others: Sequence[str] = ()
) -> Banner:
    """Return what a person has to know first.

    ``reports`` are the newest ones of the nodes; ``odometry_age`` is the time since the last
    odometry, s, None before the first one; ``others`` are namespaces of other robots. The reason
    of the robot stands before those of the other nodes: theirs often follow from it.
    """
    order = sorted(reports, key=lambda name: name not in ROBOTS)
    worse = {name: reports[name] for name in order if reports[name].condition != 'normal'}
    stops = {name: each for name, each in worse.items() if each.condition == 'stopped'}
    detail = '; '.join(f'{name}: {each.text}' for name, each in (stops or worse).items())
    if odometry_age is None:
        reason = detail or 'no odometry on the graph yet'
        if others:
            reason += f'; robots of other namespaces: {", ".join(others)} (t3mpc view --namespace)'
        return Banner('lost', 'Waiting for a robot', reason)
    if odometry_age > LOST:
        silence = f'no odometry for {odometry_age:.0f} s'
        return Banner('lost', 'Connection lost', f'{silence}: {detail or LOST_REMEDY}')
    if any(each.text.startswith(ESTOP) for each in stops.values()):
        return Banner('stopped', 'E-STOP', detail)
    if reports.get('reference_generator') == PAUSED:
        return Banner('warning', 'Reference paused', detail)
    if stops:
        return Banner('stopped', 'Stopped', detail)
    if worse:
        return Banner('warning', 'Driving, with a warning', detail)
    if 'controller' in reports:
        return Banner('good', 'Tracking the reference', '')
    return Banner('good', 'Following commands' if reports else 'Receiving odometry', '')


ODOMETRY = 'odometry'
"""Stream whose samples show that a robot is connected."""


MAX_AGE = 3.0
"""Age of a command up to which it is executed, s."""
STOPS = (('e_stop', True), ('enable', False), ('pause', True))
"""Commands that stop the robot, each with the value of its ``on``."""


class LiveRun(LiveData):
    """LiveData of a run in real time; the facts include the banner.

    Time of samples is that of the messages; the connection is judged by the time of their
    arrival, because clocks of other machines differ.
    """

    def __init__(self) -> None:
        super().__init__(step=STEP)
        self.set('span', SPAN)
        self._reports: dict[str, NodeReport] = {}
        self._odometry_pending = False
        self._last_odometry: float | None = None
        self._time = 0.0
        self._banner: Banner | None = None
        self._newest_stop = -math.inf
        self._others: Sequence[str] = ()

    def add(self, stream: str, time: float, values: Sequence[float]) -> None:
        """Add a sample."""
        super().add(stream, time, values)
        if stream == ODOMETRY:
            self._odometry_pending, self._time = True, time

    def node_report(self, name: str, text: str, condition: Condition) -> None:
        """Replace the newest report of a node."""
        self._reports[name] = NodeReport(text, condition)

    def node_gone(self, name: str) -> None:
        """Discard the report of a node that has left the graph."""
        self._reports.pop(name, None)

    def other_robots(self, namespaces: Sequence[str]) -> None:
        """Replace the namespaces of other robots."""
        self._others = namespaces

    def is_latched(self) -> bool:
        """Return whether the robot stands by its emergency stop."""
        return any(
            self._reports[name].text.startswith(ESTOP) for name in {*ROBOTS} & {*self._reports}
        )

    def tick(self, now: float) -> None:
        """Update the banner at steady time ``now`` (s); call it several times a second."""
        if self._odometry_pending:
            self._odometry_pending, self._last_odometry = False, now
        age = None if self._last_odometry is None else now - self._last_odometry
        shown = banner(self._reports, age, self._others)
        if shown == self._banner:
            return
        previous, self._banner = self._banner, shown
        self.set('banner', shown._asdict())
        if previous is None or shown.kind == previous.kind == 'lost':
            return
        if shown.kind in ('stopped', 'lost'):
            if shown.cause() == previous.cause():
                return  # what follows from a stop comes later: it is no other stop
            reason = f': {shown.detail}' if shown.detail else ''
            self.report(self._time, 'stop', f'{shown.headline}{reason}')
        elif previous.kind in ('stopped', 'lost'):
            self.report(self._time, 'resume', shown.headline)

    def refusal(self, name: str, on: object, asked: float, now: float) -> str:
        """Return why a command is not to be executed; '' for one that is.

        ``asked`` is the time of the click and ``now`` the present one on the same clock, s. While
        the program is suspended or the network stalls, clicks wait, and then arrive together and
        in any order. A stop is executed whenever it arrives. Anything else is executed only while
        it is recent, and never if it was asked for before the newest stop: a release that waited
        must not undo the stop that a person asked for after it.
        """
        if (name, on) in STOPS:
            self._newest_stop = max(self._newest_stop, min(asked, now))
            return ''
        if not now - MAX_AGE <= asked <= now + MAX_AGE:
            return (
                f'{name} was asked for more than {MAX_AGE:g} s ago and is not executed: ask again'
            )
        if asked <= self._newest_stop:
            return f'{name} was asked for before the last stop and is not executed: ask again'
        return ''
