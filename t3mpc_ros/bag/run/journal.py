# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Journal of a controller: the order of its inputs, which makes a run exactly reproducible."""

from array import array
from collections.abc import Mapping
import enum
import json

from t3mpc_ros.parameters.table import Value

JOURNAL_COLUMNS = ('number', 'event', 'stamp_ns', 'references', 'value')
"""What the numbers of a row are:

number
    0, 1, 2 ... since the node was started: a gap is a row that was lost.
event
    One of :class:`Event`.
stamp_ns
    Of a STEP the stamp of its odometry message, of a SILENT that of the last one, else 0.
references
    How many reference messages had been handed to the controller since the start of the node.
value
    As said at each :class:`Event`.
"""


class Event(enum.IntEnum):
    """What happened to the controller."""

    STEP = 0
    """It took an odometry message and commanded; value: the stamp of the newest reference that
    it had been handed, 0 without one."""
    ODOMETRY_TIMEOUT = 1
    """It was found that the odometry had gone silent, and a stop was commanded."""
    ENABLE = 2
    """The robot may move (value 1) or must not (value 0)."""
    RESET = 3
    """What was learnt is forgotten; value: 1 where the robot may move, else 0."""
    CONFIGURE = 4
    """Other dynamic parameters; value: their revision, see :func:`parameters_to_json`."""
    MODEL = 5
    """A model file was loaded at start; value: CRC-32 of the file."""
    FINISH = 6
    """The node ended and commanded a last stop."""


COMMAND_EVENTS = (Event.STEP, Event.ODOMETRY_TIMEOUT, Event.FINISH)
"""Events with which a command is sent, before the row of the journal is."""


class Journal:
    """Numbers the events of one controller, and counts the references it was handed."""

    def __init__(self) -> None:
        self.row = array('q', [0] * len(JOURNAL_COLUMNS))
        """The newest row, as in :data:`COLUMNS`; overwritten by each event."""
        self.revision = 0
        """Of the settings: how often they have been changed."""
        self._number = 0
        self._references = 0
        self._newest_ns = 0
        self._enabled = True

    def reference(self, stamp_ns: int) -> None:
        """Count a reference message handed to the controller, whether it was refused or not."""
        self._references += 1
        self._newest_ns = stamp_ns

    def step(self, stamp_ns: int) -> 'array[int]':
        """Return the row of a step on the odometry message with this stamp."""
        return self._note(Event.STEP, stamp_ns, self._newest_ns)

    def silent(self, stamp_ns: int) -> 'array[int]':
        """Return the row of a stop for want of odometry, the last of which had this stamp."""
        return self._note(Event.ODOMETRY_TIMEOUT, stamp_ns, 0)

    def enable(self, on: bool) -> 'array[int]':
        """Return the row of the robot being let move, or stopped."""
        self._enabled = on
        return self._note(Event.ENABLE, 0, int(on))

    def reset(self) -> 'array[int]':
        """Return the row of everything learnt being forgotten."""
        return self._note(Event.RESET, 0, int(self._enabled))

    def configure(self) -> 'array[int]':
        """Return the row of other settings, and raise :attr:`revision`."""
        self.revision += 1
        return self._note(Event.CONFIGURE, 0, self.revision)

    def model(self, checksum: int) -> 'array[int]':
        """Return the row of a model file with this CRC-32."""
        return self._note(Event.MODEL, 0, checksum)

    def finish(self) -> 'array[int]':
        """Return the row of the end."""
        return self._note(Event.FINISH, 0, 0)

    def _note(self, event: Event, stamp_ns: int, value: int) -> 'array[int]':
        row = self.row
        row[0], row[1], row[2] = self._number, event, stamp_ns
        row[3], row[4] = self._references, value
        self._number += 1
        return row


def parameters_to_json(revision: int, parameters: Mapping[str, Value]) -> str:
    """Return the JSON text of ``controller/parameters``: a revision and its parameters by name."""
    return json.dumps({'revision': revision, 'parameters': dict(parameters)})


def parameters_from_json(text: str) -> tuple[int, dict[str, object]]:
    """Return the revision and the parameters of a text of :func:`parameters_to_json`.

    Raises
    ------
    ValueError
        The text is something else.
    """
    try:
        content = json.loads(text)
        return int(content['revision']), dict(content['parameters'])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f'no revision of parameters: {text[:60]!r}') from error
