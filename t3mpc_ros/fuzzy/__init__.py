# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Non-singleton type-3 fuzzy sets, inference and adaptive estimators."""
