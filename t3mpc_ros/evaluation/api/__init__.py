# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The scripting interface: what ``import t3mpc_ros as t3`` gives, and all that it rests on."""
