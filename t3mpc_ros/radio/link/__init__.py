# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Host side of the radio link: handshake, transactions, setpoints, telemetry."""
