# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Emulator of the dongle and the robot board in virtual time, behind a pseudo-terminal."""
