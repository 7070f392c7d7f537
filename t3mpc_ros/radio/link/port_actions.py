# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Port actions and link states."""

from enum import Enum
from typing import NamedTuple


class Open(NamedTuple):
    """Open the port, then call ``port_opened`` or ``port_failed``."""


class Write(NamedTuple):
    """Write these bytes now; call ``port_failed`` if that is not possible."""

    data: bytes


class Close(NamedTuple):
    """Close the port if it is open."""


class Wait(NamedTuple):
    """Call ``step`` again at this instant, or earlier when bytes arrive."""

    until_ns: int


PortAction = Open | Write | Close | Wait


class LinkState(Enum):
    """State of the connection; the value is its text in diagnostics."""

    CLOSED = 'port closed'
    OPEN = 'opening the port'
    PING = 'searching for the dongle'
    CFG = 'configuring the radio'
    HELLO = 'searching for the robot'
    INFO = 'requesting robot information'
    PARAMS = 'writing board parameters'
    RUN = 'running'
    STOP = 'stopping'
    DONE = 'shut down'
