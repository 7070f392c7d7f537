# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The ``bag`` program: what can be done with a recording without a ROS graph."""
