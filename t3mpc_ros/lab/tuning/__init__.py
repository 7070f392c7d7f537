# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every method of a comparison tuned by the same search, with equally many evaluations."""
