# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Emulated firmware of the robot board: protocol rules, motion, USB console."""
