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
"""Journal of a controller: the order of its inputs, which makes a run exactly reproducible.

A recorder may receive odometry and references in another order than the controller did. The
topic ``controller/journal`` has one row of five integers per event of the controller and thus
defines the order.
"""

from array import array
from collections.abc import Mapping
import enum
import json
import struct

from t3mpc_ros.parameters.table import Value

JOURNAL_COLUMNS = ('number', 'event', 'stamp_ns', 'references', 'value')
"""Columns of a row:

number
    0, 1, 2 ... since the start of the node; a gap is a lost row.
event
    An :class:`Event`.
stamp_ns
    Stamp of the odometry message of a STEP, or of the last one before an ODOMETRY_TIMEOUT; the
    instant of a STEP_WITHOUT_ODOMETRY; the sensor of a RANGE; else 0.
references
    Number of reference messages that the controller received since the start of the node.
value
    See :class:`Event`.
"""


class Event(enum.IntEnum):
    """Event of the controller."""

    STEP = 0
    """Odometry was processed and a command published; value: the stamp of the newest reference,
    0 without one."""
    ODOMETRY_TIMEOUT = 1
    """The odometry timed out and a stop was commanded."""
    ENABLE = 2
    """Motion was enabled (value 1) or disabled (value 0)."""
    RESET = 3
    """Learned weights were reset; value: 1 if motion is enabled, else 0."""
    CONFIGURE = 4
    """Dynamic parameters changed; value: their revision, see :func:`parameters_to_json`."""
    MODEL = 5
    """A model file was loaded at the start; value: CRC-32 of the file."""
    FINISH = 6
    """The node shut down and commanded a stop."""
    RANGE = 7
    """A range reading was used by the keep-out; stamp_ns: number of the sensor from 0; value: the
    bits of the reading as a 64-bit float."""
    STEP_WITHOUT_ODOMETRY = 8
    """A command was published in a gap of the odometry."""


COMMAND_EVENTS = (Event.STEP, Event.STEP_WITHOUT_ODOMETRY, Event.ODOMETRY_TIMEOUT, Event.FINISH)
"""Events that publish a command, before the row of the journal is published."""


class Journal:
    """Numbers the events of one controller and counts its references."""

    def __init__(self) -> None:
        self.row = array('q', [0] * len(JOURNAL_COLUMNS))
        """Last row, as in :data:`JOURNAL_COLUMNS`; overwritten by each event."""
        self.revision = 0
        """Revision of the parameters: the number of their changes."""
        self._number = 0
        self._references = 0
        self._newest_ns = 0
        self._enabled = True

    def count_reference(self, stamp_ns: int) -> None:
        """Count a reference message, accepted or rejected by the controller."""
        self._references += 1
        self._newest_ns = stamp_ns

    def step(self, stamp_ns: int) -> 'array[int]':
        """Return the row of a step with the stamp of its odometry message."""
        return self._append(Event.STEP, stamp_ns, self._newest_ns)

    def step_without_odometry(self, stamp_ns: int) -> 'array[int]':
        """Return the row of a command in a gap of the odometry, for an instant."""
        return self._append(Event.STEP_WITHOUT_ODOMETRY, stamp_ns, 0)

    def odometry_timeout(self, stamp_ns: int) -> 'array[int]':
        """Return the row of a stop after an odometry timeout, with the last odometry stamp."""
        return self._append(Event.ODOMETRY_TIMEOUT, stamp_ns, 0)

    def enable(self, on: bool) -> 'array[int]':
        """Return the row of enabled or disabled motion."""
        self._enabled = on
        return self._append(Event.ENABLE, 0, int(on))

    def reset(self) -> 'array[int]':
        """Return the row of a reset of the learned weights."""
        return self._append(Event.RESET, 0, int(self._enabled))

    def configure(self) -> 'array[int]':
        """Increment :attr:`revision` and return the row of changed parameters."""
        self.revision += 1
        return self._append(Event.CONFIGURE, 0, self.revision)

    def model(self, checksum: int) -> 'array[int]':
        """Return the row of a loaded model file with its CRC-32."""
        return self._append(Event.MODEL, 0, checksum)

    def range(self, sensor: int, reading: float) -> 'array[int]':
        """Return the row of a range reading, m."""
        bits = struct.unpack('<q', struct.pack('<d', reading))[0]
        return self._append(Event.RANGE, sensor, bits)

    def finish(self) -> 'array[int]':
        """Return the row of the shutdown."""
        return self._append(Event.FINISH, 0, 0)

    def _append(self, event: Event, stamp_ns: int, value: int) -> 'array[int]':
        row = self.row
        row[0], row[1], row[2] = self._number, event, stamp_ns
        row[3], row[4] = self._references, value
        self._number += 1
        return row


def reading_from_value(value: int) -> float:
    """Return the reading (m) of the value of a :attr:`Event.RANGE` row."""
    reading: float = struct.unpack('<d', struct.pack('<q', value))[0]
    return reading


def parameters_to_json(revision: int, parameters: Mapping[str, Value]) -> str:
    """Return the JSON text of ``controller/parameters``: a revision and its parameters by name."""
    return json.dumps({'revision': revision, 'parameters': dict(parameters)})


def parameters_from_json(text: str) -> tuple[int, dict[str, object]]:
    """Return the revision and the parameters of a text of :func:`parameters_to_json`."""
    try:
        content = json.loads(text)
        return int(content['revision']), dict(content['parameters'])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f'no revision of parameters: {text[:60]!r}') from error
