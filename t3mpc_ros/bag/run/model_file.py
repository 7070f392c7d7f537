# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Model files: trained weights of a controller with the parameters they were trained under."""

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any
import zipfile

import numpy as np
from numpy.typing import NDArray

import t3mpc_ros

FORMAT = 1
"""Raised whenever the meaning of an array changes."""

_HEADER = 'header'


class ModelError(RuntimeError):
    """A model file that cannot be written, read or used."""


def save_model(
    path: Path,
    arrays: Mapping[str, NDArray[np.float64]],
    parameters: Mapping[str, object],
    origin: Mapping[str, object] | None = None,
) -> None:
    """Write what was learnt, with the settings it was learnt under.

    Parameters
    ----------
    path
        The file.
    arrays
        What was learnt.
    settings
        By flat name.
    origin
        Where it comes from, as plain data for JSON: bags and their hashes, say.

    Raises
    ------
    ModelError
        The file cannot be written; the text names it and the reason.
    """
    header = json.dumps(
        {
            'format': FORMAT,
            'version': t3mpc_ros.__version__,
            'parameters': dict(parameters),
            'origin': dict(origin or {}),
        }
    )
    try:
        with path.open('wb') as target:
            content: dict[str, Any] = {_HEADER: np.array(header), **arrays}
            np.savez_compressed(target, **content)
    except OSError as error:
        raise ModelError(f'cannot write the model file {path}: {error.strerror}') from error


def load_model(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of a model file.

    Raises
    ------
    ModelError
        The file cannot be read, is no model, or is of another format; the text says which.
    """
    return _read(path)[1]


def read_model_header(path: Path) -> dict[str, Any]:
    """Return what a model file says of itself: format, version, settings, and its origin.

    Raises
    ------
    ModelError
        As :func:`load_model`.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[np.float64]]]:
    try:
        with np.load(path, allow_pickle=False) as content:
            header = json.loads(str(content[_HEADER]))
            arrays = {name: np.array(content[name]) for name in content.files if name != _HEADER}
    except OSError as error:
        raise ModelError(
            f'cannot read the model file {path}: {error.strerror or error}'
        ) from error
    except (KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ModelError(f'{path} is not a model file of t3mpc_ros') from error
    found = header.get('format') if isinstance(header, dict) else None
    if found != FORMAT:
        raise ModelError(
            f'{path} has model format {found}, this is format {FORMAT}: train or save it anew'
        )
    return header, arrays
