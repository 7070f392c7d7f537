# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The digital twin put to the test: motors, sensors and odometry, in pictures and figures."""
