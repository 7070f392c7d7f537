# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What every robot of the package tells the graph, whether it is simulated or real."""
