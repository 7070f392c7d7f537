# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Port actions and link states."""

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


PortAction = Open | Write | Close | Wait


class LinkState(Enum):
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
DONGLE_STARTING = 'the dongle does not answer yet: it takes 1.5 s to start'
DONGLE_TIMEOUT = 'the dongle has fallen silent: was it restarted?'
NO_DONGLE = 'nothing on the port answers like a dongle: is it the right port?'
NO_CHIP = 'the radio chip of the dongle does not answer: check its wiring and supply'
RADIO_NOT_CONFIGURED = 'the dongle does not take the settings of the radio'
HOST_KEY_MISSING = 'the robot wants signed commands: give the host the key'
ROBOT_KEY_MISSING = (
    'the robot has no key to check our signature with: store it there, or use none here'
)
KEY_MISMATCH = (
    'the robot does not accept our HELLO: the keys differ, or its own is damaged '
    '(t3mpc robot key state)'
)
HELLO_REJECTED = 'the robot does not accept our HELLO'
COMMANDS_REJECTED = 'the robot hears commands but takes none of them'
DRIVES_DISABLED = 'the drives of the robot are not enabled yet'
TTL_EXPIRED = 'no command reached the robot in time: it stopped by itself'
ROBOT_ESTOP = 'the emergency stop of the robot is latched'
ESTOP_BUTTON_HELD = 'the robot keeps its emergency stop latched: is the button still pressed?'
SHUT_DOWN = 'the link is shut down'
