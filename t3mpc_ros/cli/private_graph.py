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
"""A ROS graph of its own for a demo or a test, in which no other robot is met.

Two processes of one machine meet if they use the same ``ROS_DOMAIN_ID``. A private graph has a
domain that is not the caller's, in which no participant of any ROS program runs, and that no other
private graph of the machine reserves.
"""

import os
from pathlib import Path
import random
import socket
from typing import Self

from t3mpc_ros.cli.process_group import installed_file
from t3mpc_ros.nodes.node_main import provide_log_directory

DOMAINS = range(1, 102)
"""Domains of private graphs: 0 is the default of all robots, those above use ephemeral ports."""
_PORT_BASE, _DOMAIN_PORTS = 7400, 250
"""UDP ports of a domain by the DDSI-RTPS specification (9.6.1.1)."""
_LOOPBACK_PROFILE = Path('share') / 't3mpc_ros' / 'config' / 'fastdds_loopback.xml'
_NETWORK_VARIABLES = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')


class NoDomainError(RuntimeError):
    """Every domain is in use on this machine."""


class PrivateGraph:
    """A reserved domain and the environment of its processes; a context manager.

    The reservation is a socket with an abstract name, which exists once per network of the
    machine, for all users and checkouts. It ends with the process at the latest. NoDomainError if
    every domain is reserved or in use.
    """

    def __init__(self) -> None:
        avoided = used_domains(Path('/proc/net'))
        of_caller = os.environ.get('ROS_DOMAIN_ID', '')  # in which a robot of the caller may run
        if of_caller.isdigit():
            avoided.add(int(of_caller))
        candidates = [domain for domain in DOMAINS if domain not in avoided]
        for domain in random.SystemRandom().sample(candidates, len(candidates)):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                self._socket.bind(f'\0t3mpc_ros_domain_{domain}')
            except OSError:
                self._socket.close()
                continue
            self.domain = domain
            return
        raise NoDomainError(
            'every ROS domain from 1 to 101 is in use on this machine; stop other ROS programs'
        )

    def environment(self) -> dict[str, str]:
        """Return the environment of the processes of this graph.

        Fast DDS uses UDP on loopback only: its shared memory may block a publisher for a third of
        a second when a subscriber joins (Fast-DDS issue 6535).
        """
        environment = {k: v for k, v in os.environ.items() if k not in _NETWORK_VARIABLES}
        provide_log_directory(environment)
        environment.setdefault('RCUTILS_COLORIZED_OUTPUT', '0')
        environment['ROS_DOMAIN_ID'] = str(self.domain)
        environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        environment.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
        if 'fastrtps' in environment.get('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp'):
            environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
            profile = str(installed_file(_LOOPBACK_PROFILE))
            environment['FASTRTPS_DEFAULT_PROFILES_FILE'] = profile
        return environment

    def close(self) -> None:
        """End the reservation."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def used_domains(tables: Path) -> set[int]:
    """Return the domains in which a participant runs: its UDP ports are bound on this machine.

    ``tables`` is the folder of the kernel's tables ``udp`` and ``udp6``, either of which may lack.
    """
    found = set()
    for table in (tables / 'udp', tables / 'udp6'):
        try:
            lines = table.read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            port = int(line.split()[1].rpartition(':')[2], 16)
            if port >= _PORT_BASE:
                found.add((port - _PORT_BASE) // _DOMAIN_PORTS)
    return found
