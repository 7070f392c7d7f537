# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How a robot answers its commands: of any robot with odometry and commands."""
