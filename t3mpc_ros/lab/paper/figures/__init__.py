# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's figures and a few more, from runs and from the table of results."""
