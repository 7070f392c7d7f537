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
"""The workers of a Dask cluster."""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from t3mpc_ros.script_error import ScriptError


@contextmanager
def cluster(address: str, timeout: float = 10.0) -> Iterator[Executor]:
    """Enter the executor of a Dask scheduler, tcp://HOST:PORT, that answers within some s."""
    import distributed

    try:
        client = distributed.Client(address, timeout=timeout)
    except (OSError, TimeoutError, ValueError) as error:
        raise ScriptError(
            f'no Dask scheduler answers at {address}; start one with "dask scheduler" and '
            f'workers with "dask worker ADDRESS": {error}'
        ) from None
    with client:
        found = client.get_executor(pure=False)
        assert isinstance(found, Executor)
        yield found
