# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Model files: what the controller starts with, learnt in simulated practice or from bags."""
