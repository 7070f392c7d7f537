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
