# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How well the radio link worked, from what its bridge said in diagnostics."""
