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
"""Entry points of the node executables; the import installs the signal handlers.

Only the executables import this module, before all others: those take one to two seconds, in which
SIGINT would end the process with a traceback.
"""

from functools import partial

from t3mpc_ros.stop_signal import StopSignal

_STOP = StopSignal().install()
_STOP.exit_at_once = True  # no robot moves yet, and no file is open


def _main(name: str) -> None:
    """Run the executable of a node and end the process."""
    from t3mpc_ros.nodes.node_main import main

    main(name, _STOP)


reference_generator = partial(_main, 'reference_generator')
controller = partial(_main, 'controller')
sim_robot = partial(_main, 'sim_robot')
radio_bridge = partial(_main, 'radio_bridge')
recorder = partial(_main, 'recorder')
player = partial(_main, 'player')
localizer = partial(_main, 'localizer')
composed = partial(_main, 'composed')
