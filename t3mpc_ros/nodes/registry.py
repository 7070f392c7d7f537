# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Registry of the nodes: module and parameter class by executable name, parameter tables.

Node modules are imported on request only: an entry point installs its signal handlers first, and
one node does not load the code of the others.
"""

from importlib import import_module
from pathlib import Path
import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from t3mpc_ros.parameters.table import Parameters

_NODES = {
    'reference_generator': ('reference_generator', 'ReferenceGeneratorParameters'),
    'controller': ('controller', 'ControllerNodeParameters'),
    'sim_robot': ('sim_robot', 'SimRobotParameters'),
    'radio_bridge': ('radio_bridge', 'RadioBridgeParameters'),
    'recorder': ('recorder.node', 'RecordingParameters'),
    'player': ('player.node', 'PlayerParameters'),
    'composed': ('composed', 'ComposedParameters'),
}

NODES = tuple(_NODES)
"""Names of the nodes, which are those of their executables."""

MARK = '<!-- generated from here on: python -m t3mpc_ros.nodes.registry docs/nodes.md -->'
"""First line of the generated part of ``docs/nodes.md``."""


def node_module(node: str) -> ModuleType:
    """Return the module of a node."""
    return import_module(f't3mpc_ros.nodes.{_NODES[node][0]}')


def parameter_class(node: str) -> 'type[Parameters]':
    """Return the parameter class of a node."""
    found: type[Parameters] = getattr(node_module(node), _NODES[node][1])
    return found


def parameters_section() -> str:
    """Return the generated end of ``docs/nodes.md``: the parameters of all nodes."""
    lines = [
        MARK,
        '',
        '## Parameters',
        '',
        '*Dynamic* parameters can be set while the node runs (`ros2 param set`), the others are '
        'read-only after start. Defaults that neither the paper nor a data sheet gives are '
        '*assumed*.',
    ]
    for node in NODES:
        lines += ['', f'### {node}', '']
        lines += ['| parameter | default | range | dynamic | description | source |']
        lines += ['|---|---|---|---|---|---|']
        for spec in parameter_class(node).specs():
            default = ', '.join(map(str, spec.default)) if spec.many else str(spec.default)  # type: ignore[arg-type]
            unit = f' {spec.unit}' if spec.unit else ''
            cells = (
                f'`{spec.name}`',
                f'{default}{unit}' if default else '*(empty)*',
                spec.bounds(),
                'dynamic' if spec.dynamic else '',
                spec.text,
                spec.source,
            )
            lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(lines) + '\n'


def with_parameters(page: str) -> str:
    """Return ``docs/nodes.md`` with the present parameters behind its mark."""
    return page[: page.index(MARK)] + parameters_section()


if __name__ == '__main__':
    path = Path(sys.argv[1])
    path.write_text(with_parameters(path.read_text(encoding='utf-8')), encoding='utf-8')
