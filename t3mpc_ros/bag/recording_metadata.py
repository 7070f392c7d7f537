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
"""Metadata of a recording: provenance, parameters of nodes, attached files."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap.records import Attachment

from t3mpc_ros.bag.writer import AttachmentError, read_attachment
from t3mpc_ros.model_file import find_model
from t3mpc_ros.parameters.version_and_commit import provenance

SEED_RECORD = 'seed_fingerprints'
"""Name of the metadata record with the seed fingerprint of each reference generator."""


class RecordingMetadata:
    """The metadata records and attachments of a recording.

    ``files`` are attached at the start, and with ``models`` the model files of controllers, each
    of at most ``max_bytes``. A file that cannot be read raises :class:`AttachmentError`.
    """

    def __init__(self, files: Iterable[str], max_bytes: int, models: bool, now_ns: int) -> None:
        self._max_bytes = max_bytes
        self._models = models
        self._start_ns = now_ns
        self._model_outputs: dict[str, Path] = {}
        self.records: dict[str, dict[str, str]] = {'provenance': provenance()}
        self.attachments: dict[str, Attachment] = {}
        """Attached files by name."""
        for name in files:
            item = read_attachment(Path(name), max_bytes, now_ns)
            self.attachments[item.name] = item

    def add_parameters(
        self, record: str, node: str, values: Mapping[str, str], now_ns: int
    ) -> tuple[list[Attachment], str]:
        """Add the parameters of a node; return new attachments and the problem of a failed one."""
        self.records[record] = dict(values)
        if node != 'controller' or not self._models:
            return [], ''
        if output := values.get('model_output', ''):
            self._model_outputs[record] = Path(output)
        if not (model := values.get('model', '')):
            return [], ''
        path = find_model(model)
        try:
            name = _attachment_name(record, path.name)
            found = read_attachment(path, self._max_bytes, now_ns, name)
        except AttachmentError as error:
            return [], str(error)
        self.attachments[name] = found
        return [found], ''

    def add_seed(self, node: str, fingerprint: str) -> bool:
        """Add the seed fingerprint of a node; return whether it is new."""
        table = self.records.setdefault(SEED_RECORD, {})
        new = table.get(node) != fingerprint
        table[node] = fingerprint
        return new

    def saved_models(self, now_ns: int) -> list[Attachment]:
        """Return the model files that controllers saved during the recording."""
        found = []
        for record, path in self._model_outputs.items():
            name = _attachment_name(record, f'saved_{path.name}')
            try:
                if path.stat().st_mtime_ns < self._start_ns:
                    continue  # saved by an earlier run
                item = read_attachment(path, self._max_bytes, now_ns, name)
            except (OSError, AttachmentError):
                continue  # no model was saved, or not on this computer
            self.attachments[name] = item
            found.append(item)
        return found


def _attachment_name(record: str, path: str) -> str:
    return f'{record.strip("/")}/{Path(path).name}'
