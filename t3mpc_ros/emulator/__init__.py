# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Dongle and robot in one process, byte by byte as the real ones, behind a serial port."""
