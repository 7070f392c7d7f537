# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What every page of the package shares: style, charts, and the library that draws them."""
