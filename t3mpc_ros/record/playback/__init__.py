# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags played back: what comes next and when, as a pure function of time."""
