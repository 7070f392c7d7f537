# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the link asks of whoever holds the port, and what it calls where it stands."""

from enum import Enum
from typing import NamedTuple


class Open(NamedTuple):
    """Open the port, then call ``opened`` or ``failed``."""


class Write(NamedTuple):
    """Send these bytes now; call ``failed`` if that is not possible."""

    data: bytes


class Close(NamedTuple):
    """Close the port, if it is open."""


class Wait(NamedTuple):
    """Nothing is to be done before then, unless bytes arrive."""

    until_ns: int


Deed = Open | Write | Close | Wait


class Phase(Enum):
    """How far the link has come."""

    CLOSED = 'port closed'
    OPEN = 'opening the port'
    PING = 'looking for the dongle'
    CFG = 'setting the radio'
    HELLO = 'looking for the robot'
    INFO = 'asking the robot who it is'
    PARAMS = 'writing parameters'
    RUN = 'running'
    STOP = 'stopping'
    DONE = 'stopped for good'


NO_COMMAND = 'no command yet'
STARTING = 'the dongle does not answer yet: it takes 1.5 s to start'
FELL_SILENT = 'the dongle has fallen silent: was it restarted?'
NO_DONGLE = 'nothing on the port answers like a dongle: is it the right port?'
NO_CHIP = 'the radio chip of the dongle does not answer: check its wiring and supply'
NOT_SET = 'the dongle does not take the settings of the radio'
NO_KEY_HERE = 'the robot wants signed commands: give the host the key'
NO_KEY_THERE = 'the robot has no key to check our signature with: store it there, or use none here'
WRONG_KEY = (
    'the robot does not accept our HELLO: the keys differ, or its own is damaged '
    '(radio_tool key state)'
)
NO_SESSION = 'the robot does not accept our HELLO'
NOT_TAKEN = 'the robot hears commands but takes none of them'
DISABLED = 'the drives of the robot are not enabled yet'
EXPIRED = 'no command reached the robot in time: it stopped by itself'
ESTOP_THERE = 'the emergency stop of the robot is latched'
BUTTON = 'the robot keeps its emergency stop latched: is the button still pressed?'
STOPPED = 'the link is shut down'
