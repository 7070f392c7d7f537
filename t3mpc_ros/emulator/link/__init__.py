# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Emulated link from the host to the robot board: serial line, dongle, radio channel."""
