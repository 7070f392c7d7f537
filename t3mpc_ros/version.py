# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Version of the package."""

VERSION = '0.1.0'
