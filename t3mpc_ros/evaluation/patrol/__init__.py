# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How good a patrol is: coverage, entropy, divergence, predictability, against baselines."""
