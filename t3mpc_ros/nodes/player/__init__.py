# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The player node: publishers, playback thread, keyboard and progress line."""
