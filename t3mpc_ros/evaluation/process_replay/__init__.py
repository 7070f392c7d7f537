# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recorded inputs replayed through the controller, and comparison with the recorded outputs."""
