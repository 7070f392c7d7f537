# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a bag says of itself: whence its numbers come, in tables and in attached files."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from t3mpc_ros.record.writing.attachment import Attachment, AttachmentError, read_attachment
from t3mpc_ros.settings.provenance import provenance

SEEDS = 'seed_fingerprints'
"""Title of the table that says, for each reference, what its seed can be checked against."""


class Provenance:
    """The details and attachments of a recording, and which of them are new.

    Parameters
    ----------
    files
        To attach from the begin.
    most_bytes
        Of one attached file.
    models
        Whether the models of controllers are attached.
    now_ns
        Nanoseconds since 1970.

    Raises
    ------
    AttachmentError
        One of ``files`` cannot be read, or is too large.
    """

    def __init__(self, files: Iterable[str], most_bytes: int, models: bool, now_ns: int) -> None:
        self._most_bytes = most_bytes
        self._models = models
        self._start_ns = now_ns
        self._outputs: dict[str, Path] = {}
        self.details: dict[str, dict[str, str]] = {'provenance': provenance()}
        """Tables of text by title."""
        self.attachments: dict[str, tuple[Attachment, int]] = {}
        """Files by name, with the time at which they were read."""
        for name in files:
            self._attach(read_attachment(Path(name), most_bytes), now_ns)

    def settings(
        self, title: str, name: str, values: Mapping[str, str], now_ns: int
    ) -> tuple[list[Attachment], str]:
        """Take in the settings of a node; return new attachments, and what could not be one."""
        self.details[title] = dict(values)
        if name != 'controller' or not self._models:
            return [], ''
        if output := values.get('model_output', ''):
            self._outputs[title] = Path(output)
        if not (model := values.get('model', '')):
            return [], ''
        try:
            found = read_attachment(Path(model), self._most_bytes, _named(title, model))
        except AttachmentError as error:
            return [], str(error)
        self._attach(found, now_ns)
        return [found], ''

    def seed(self, node: str, fingerprint: str) -> bool:
        """Return whether the fingerprint of a node's seed is new; it is a detail from now on."""
        table = self.details.setdefault(SEEDS, {})
        new = table.get(node) != fingerprint
        table[node] = fingerprint
        return new

    def saved_models(self, now_ns: int) -> list[Attachment]:
        """Return the model files that controllers have written since the recording began."""
        found = []
        for title, path in self._outputs.items():
            name = _named(title, f'saved_{path.name}')
            try:
                if path.stat().st_mtime_ns < self._start_ns:
                    continue  # of a run before
                item = read_attachment(path, self._most_bytes, name)
            except (OSError, AttachmentError):
                continue  # nobody has asked the controller to save one, or not here
            if name not in self.attachments or self.attachments[name][0] != item:
                self._attach(item, now_ns)
                found.append(item)
        return found

    def _attach(self, item: Attachment, now_ns: int) -> None:
        self.attachments[item.name] = item, now_ns


def _named(title: str, path: str) -> str:
    return f'{title.strip("/")}/{Path(path).name}'
