# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The real robot as the host sees it: behind the seam of every robot, and the serial port."""
