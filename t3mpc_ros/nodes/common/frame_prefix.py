# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Prefix of the frames of a robot in a namespace."""

from dataclasses import dataclass

from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class FrameParameters(Parameters):
    """Prefix of frames, with the parameters of diff_drive_controller.

    Topics are separated by the namespace, transforms are not: two robots need two names for each
    frame.
    """

    tf_frame_prefix_enable: bool = parameter(True, 'whether frames get a prefix')
    tf_frame_prefix: str = parameter('', 'prefix of the frames; empty: the namespace of the node')

    def prefixed(self, frame: str, namespace: str) -> str:
        """Return a frame with the prefix that a node in this namespace uses."""
        prefix = (self.tf_frame_prefix or namespace).strip('/')
        if not (self.tf_frame_prefix_enable and prefix) or frame.startswith(f'{prefix}/'):
            return frame
        return f'{prefix}/{frame}'
