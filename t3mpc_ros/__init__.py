# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Type-3 fuzzy, Boltzmann-machine predictive control along chaotic references."""

__version__ = '0.1.0'
