# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Comparison of the controller with every baseline on one robot, case by case."""
