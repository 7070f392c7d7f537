# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fractional-order hyperchaos, its memory, and the switching reference it drives."""
