# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The radio link to the real robot: frames, splitter, signatures, link state, port."""
