# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files that travel inside a bag, such as the model that a controller started from."""

from dataclasses import dataclass
import mimetypes
from pathlib import Path

from mcap.reader import make_reader

from t3mpc_ros.record.schema import RecordError

_KINDS = {'.npz': 'application/zip', '.yaml': 'application/yaml', '.csv': 'text/csv'}
"""What ``mimetypes`` does not know everywhere; an npz file is a zip archive of arrays."""


class AttachmentError(RecordError):
    """A file that cannot be put into a bag."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """One file, as it was read."""

    name: str
    media_type: str
    data: bytes
    changed_ns: int = 0
    """When the file was last changed, nanoseconds since 1970; 0 = unknown."""


def read_attachment(path: Path, most_bytes: int, name: str = '') -> Attachment:
    """Return the file at ``path`` under ``name``, its own name by default.

    Raises
    ------
    AttachmentError
        There is no such file, it cannot be read, or it is larger than ``most_bytes``.
    """
    try:
        with path.open('rb') as file:
            data = file.read(most_bytes + 1)
        changed_ns = path.stat().st_mtime_ns
    except OSError as error:
        raise AttachmentError(f'{path} cannot be attached: {error.strerror or error}') from error
    if len(data) > most_bytes:
        raise AttachmentError(
            f'{path} must have at most {most_bytes} bytes to be attached (attach_bytes)'
        )
    kind = _KINDS.get(path.suffix) or mimetypes.guess_type(path.name)[0]
    return Attachment(name or path.name, kind or 'application/octet-stream', data, changed_ns)


def attached(path: Path) -> dict[str, Attachment]:
    """Return the files in a finished MCAP file by name; of one name the newest.

    Raises
    ------
    AttachmentError
        The file cannot be read, has no sound end, or an attachment is damaged.
    """
    try:
        with path.open('rb') as file:
            found = list(make_reader(file, validate_crcs=True).iter_attachments())
    except Exception as error:  # whatever a damaged file does to the library's parser
        raise AttachmentError(f'the attachments of {path} cannot be read: {error}') from error
    found.sort(key=lambda item: item.log_time)
    return {
        item.name: Attachment(item.name, item.media_type, bytes(item.data), item.create_time)
        for item in found
    }
