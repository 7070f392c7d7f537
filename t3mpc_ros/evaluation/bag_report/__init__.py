# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Report of a recorded bag: metrics, figures, page."""
