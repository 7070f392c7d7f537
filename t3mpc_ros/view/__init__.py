# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The live page: what a run shows in a browser, and the commands it takes."""
