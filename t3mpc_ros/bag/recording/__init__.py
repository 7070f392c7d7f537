# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recording: message queue, split files, snapshots and the diagnostics monitor."""
