# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the replayer is made of: publishers, the thread that publishes, keys and a line of text."""
