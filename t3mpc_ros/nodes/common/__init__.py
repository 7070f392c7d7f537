# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Base node, QoS profiles, message conversions and publishers shared by the nodes."""
