# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The digital twin of a small stepper robot: every part of it that can surprise a controller."""
