# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Decides what is recorded, what waits, what is kept for a snapshot, and when files are split."""
