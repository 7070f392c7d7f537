# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``radio_tool``: what is done at the bench: the key, the radio, the first turn of a wheel."""
