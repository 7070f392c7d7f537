# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the robot feels: inertial sensor, eight distance sensors, battery; each by its sheet."""
