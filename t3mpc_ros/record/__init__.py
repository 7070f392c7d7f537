# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bags: ROS 2 schemas, the MCAP writer and metadata, and the reader."""
