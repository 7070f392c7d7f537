# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The closed loop as fast as the kernels allow: scenarios, runs, what they left, statistics."""
