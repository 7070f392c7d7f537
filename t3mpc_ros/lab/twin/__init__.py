# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The controller and the digital twin in one closed loop, without a ROS graph."""
