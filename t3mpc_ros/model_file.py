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
"""Model files: learned weights of a controller and the parameters of their training."""

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any
import zipfile

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.version import PACKAGE_DIRECTORY, VERSION

FORMAT = 1
"""Version of the format; incremented if the meaning of an array changes."""

PACKAGED = PACKAGE_DIRECTORY / 'evaluation' / 'training'
"""Folder of the model files that come with the package."""

_HEADER = 'header'


class ModelError(RuntimeError):
    """A model file cannot be written, read or used."""


def save_model(
    path: Path,
    arrays: Mapping[str, NDArray[np.float64]],
    parameters: Mapping[str, object],
    origin: Mapping[str, object] | None = None,
) -> None:
    """Write a model file; after a :class:`ModelError` an existing one is unchanged.

    ``arrays`` are learned weights by name; ``origin`` is JSON data, such as bags and their hashes.
    """
    header = json.dumps(
        {
            'format': FORMAT,
            'version': VERSION,
            'parameters': dict(parameters),
            'origin': dict(origin or {}),
        }
    )
    from t3mpc_ros.atomic_file import atomic_file  # the start of a node does without it

    try:
        with atomic_file(path) as target:
            content: dict[str, Any] = {_HEADER: np.array(header), **arrays}
            np.savez_compressed(target, **content)
    except OSError as error:
        raise ModelError(f'cannot write the model file {path}: {error.strerror}') from error


def find_model(name: str) -> Path:
    """Return the file of a model: that of the package with this name, else ``name`` as a path."""
    packaged = PACKAGED / f'{name}.npz'
    return packaged if packaged.parent == PACKAGED and packaged.is_file() else Path(name)


def load_model(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of a model file; an unusable one raises :class:`ModelError`."""
    return read_model(path)[1]


def read_model(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[np.float64]]]:
    """Return header (format, version, parameters and origin) and arrays of a model file."""
    try:
        # Of a file that it cannot read, numpy leaves the archive to the garbage collector.
        with path.open('rb') as file, np.load(file, allow_pickle=False) as content:
            header = json.loads(str(content[_HEADER]))
            arrays = {name: np.array(content[name]) for name in content.files if name != _HEADER}
    except OSError as error:
        raise ModelError(
            f'cannot read the model file {path}: {error.strerror or error}'
        ) from error
    except (EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ModelError(f'{path} is not a model file of t3mpc_ros') from error
    found = header.get('format') if isinstance(header, dict) else None
    if found != FORMAT:
        raise ModelError(
            f'{path} has model format {found}, this is format {FORMAT}: train or save it again'
        )
    return header, arrays
