# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Damaged MCAP files of any writer: what they still hold, written anew as a whole bag."""
