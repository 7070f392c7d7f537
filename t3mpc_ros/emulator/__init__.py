# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Emulated dongle and robot board behind a pseudo terminal."""
