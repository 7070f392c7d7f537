# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 bags: recording, reading, playback and recovery of MCAP files."""
