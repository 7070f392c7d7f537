# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parts that all nodes share: base node, QoS, conversions, entry points."""
