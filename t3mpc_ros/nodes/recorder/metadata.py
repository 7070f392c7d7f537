# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Metadata and attachments of a recording: provenance, parameters of the nodes, model files."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from t3mpc_ros.bag.writer import Attachment, AttachmentError, read_attachment
from t3mpc_ros.nodes.node_parameters import PARAMETER_CLASSES
from t3mpc_ros.parameters.provenance import provenance

SEED_TABLE = 'seed_fingerprints'
"""Title of the table that says, for each reference, what its seed can be checked against."""


class RecordingMetadata:
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
        self.metadata_records: dict[str, dict[str, str]] = {'provenance': provenance()}
        """Tables of text by title."""
        self.attachments: dict[str, tuple[Attachment, int]] = {}
        """Files by name, with the time at which they were read."""
        for name in files:
            self._attach(read_attachment(Path(name), most_bytes), now_ns)

    def parameters(
        self, title: str, name: str, values: Mapping[str, str], now_ns: int
    ) -> tuple[list[Attachment], str]:
        """Take in the settings of a node; return new attachments, and what could not be one."""
        self.metadata_records[title] = dict(values)
        if name != 'controller' or not self._models:
            return [], ''
        if output := values.get('model_output', ''):
            self._outputs[title] = Path(output)
        if not (model := values.get('model', '')):
            return [], ''
        try:
            found = read_attachment(Path(model), self._most_bytes, _attachment_name(title, model))
        except AttachmentError as error:
            return [], str(error)
        self._attach(found, now_ns)
        return [found], ''

    def seed(self, node: str, fingerprint: str) -> bool:
        """Return whether the fingerprint of a node's seed is new; it is a detail from now on."""
        table = self.metadata_records.setdefault(SEED_TABLE, {})
        new = table.get(node) != fingerprint
        table[node] = fingerprint
        return new

    def saved_models(self, now_ns: int) -> list[Attachment]:
        """Return the model files that controllers have written since the recording began."""
        found = []
        for title, path in self._outputs.items():
            name = _attachment_name(title, f'saved_{path.name}')
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


def _attachment_name(title: str, path: str) -> str:
    return f'{title.strip("/")}/{Path(path).name}'


ParametersCallback = Callable[[str, str, Mapping[str, str]], None]
"""Called with a title for the bag, the name of the executable, and settings as text."""


class ParameterCollector:
    """Knows which nodes have been asked.

    Parameters
    ----------
    node
        Who asks.
    answered
        What to do with an answer.
    """

    def __init__(self, node: Node, answered: ParametersCallback) -> None:
        self._node = node
        self._answered = answered
        self._asked: set[str] = set()

    def ask(self) -> None:
        """Ask those that are new in the graph; one that left and came again is new."""
        present = set()
        for name, namespace in self._node.get_node_names_and_namespaces():
            full = f'{namespace.rstrip("/")}/{name}'
            present.add(full)
            if name not in PARAMETER_CLASSES or full in self._asked:
                continue
            lister = self._node.create_client(ListParameters, f'{full}/list_parameters')
            getter = self._node.create_client(GetParameters, f'{full}/get_parameters')
            if lister.service_is_ready() and getter.service_is_ready():
                self._asked.add(full)
                future = lister.call_async(ListParameters.Request())
                # One of another namespace has the same name but is another robot's.
                title = name if namespace == self._node.get_namespace() else full
                future.add_done_callback(partial(self._on_names, title, name, lister, getter))
            else:
                self._node.destroy_client(lister)
                self._node.destroy_client(getter)
        self._asked &= present

    def _on_names(
        self, title: str, name: str, lister: Client, getter: Client, future: Any
    ) -> None:
        names = list(future.result().result.names)
        self._node.destroy_client(lister)
        asked = getter.call_async(GetParameters.Request(names=names))
        asked.add_done_callback(partial(self._on_values, title, name, names, getter))

    def _on_values(
        self, title: str, name: str, names: list[str], getter: Client, future: Any
    ) -> None:
        values = {
            key: str(parameter_value_to_python(value))
            for key, value in zip(names, future.result().values, strict=True)
        }
        self._node.destroy_client(getter)
        self._answered(title, name, values)
