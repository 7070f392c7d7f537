# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameter tables: specification, validation, command-line input, provenance."""
