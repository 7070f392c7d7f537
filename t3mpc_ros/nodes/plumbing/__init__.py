# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What every node shares: parameters, messages, QoS, diagnostics, life cycle."""
