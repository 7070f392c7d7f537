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
"""Metadata of a recording: provenance, parameters of nodes, attached files, lost messages."""

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


LOSSES = 'losses'
"""Name of the metadata record of :func:`message_loss_record`; begin of that of a recovery."""
DAMAGED = 'damaged'
"""Cause of the messages that a recovery could not read."""
_SPAN = 'span'
UNDISCOVERED = 'undiscovered'
"""Cause of the messages that a recorder misses while it starts."""
LOSS_CAUSES = {
    'dropped': 'dropped because the disk was too slow',
    'lost': 'lost by the middleware',
    UNDISCOVERED: 'published before the recorder had discovered their publisher',
    DAMAGED: 'lost in damaged parts of the file',
}
"""Why messages are missing in a bag, by key of its loss record."""


def message_loss_record(
    dropped: Mapping[str, int], lost: Mapping[str, int], undiscovered: Mapping[str, int]
) -> dict[str, str]:
    """Return the metadata record of missing messages, by cause (:data:`LOSS_CAUSES`) and topic."""
    return _record_of({'dropped': dropped, 'lost': lost, UNDISCOVERED: undiscovered})


def damage_record(lost: Mapping[str, int], spans: Iterable[tuple[int, int]]) -> dict[str, str]:
    """Return the metadata record of the messages that a recovery could not read, by topic.

    Those are of some spans of receive times, ns.
    """
    times = {f'{_SPAN} {k}': f'{low} {high}' for k, (low, high) in enumerate(spans)}
    return _record_of({DAMAGED: lost}) | times


def _record_of(causes: Mapping[str, Mapping[str, int]]) -> dict[str, str]:
    """Return the sum of each cause, and the number of each cause and topic."""
    table = {cause: str(sum(counts.values())) for cause, counts in causes.items()}
    for cause, counts in causes.items():
        table |= {f'{cause} {topic}': str(count) for topic, count in sorted(counts.items())}
    return table


def is_loss_record(title: str) -> bool:
    """Whether a metadata record, by its name, is one of missing messages."""
    return title.split(' ')[0] == LOSSES


def lost_spans(tables: Mapping[str, Mapping[str, str]]) -> list[tuple[int, int]]:
    """Return the receive times (ns) between which a recovery could not read messages."""
    found = []
    for table in _loss_tables(tables):
        for key, text in table.items():
            low, _, high = text.partition(' ')
            if key.startswith(f'{_SPAN} ') and low.isdecimal() and high.isdecimal():
                found.append((int(low), int(high)))
    return sorted(found)


def _loss_tables(tables: Mapping[str, Mapping[str, str]]) -> list[Mapping[str, str]]:
    return [table for title, table in tables.items() if is_loss_record(title)]


def message_losses(tables: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, int]]:
    """Return the number of missing messages by cause and topic, by the records of a bag."""
    found: dict[str, dict[str, int]] = {cause: {} for cause in LOSS_CAUSES}
    for table in _loss_tables(tables):
        for key, count in table.items():
            cause, _, topic = key.partition(' ')
            if topic and cause in found and count.isdecimal():
                found[cause][topic] = found[cause].get(topic, 0) + int(count)
    return found


def message_loss_notes(tables: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return a sentence for each topic and cause of :func:`message_losses`."""
    return [
        f'{count} messages of {topic} are missing: {LOSS_CAUSES[cause]}.'
        for cause, topics in message_losses(tables).items()
        for topic, count in topics.items()
    ]
