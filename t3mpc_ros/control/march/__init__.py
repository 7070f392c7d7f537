# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Many steps of the controller in one compiled call, for recorded runs."""
