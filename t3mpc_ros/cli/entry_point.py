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
"""Entry point of the executable ``t3mpc``; the import lets Ctrl-C end it without a traceback."""

import os
import signal

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))


def t3mpc() -> int:
    """Return the exit code of the command line of this process."""
    from t3mpc_ros.cli.main import main

    signal.signal(signal.SIGINT, signal.default_int_handler)
    return main()
