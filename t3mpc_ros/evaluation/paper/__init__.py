# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reproduction of the paper: experiments, tables, figures, claims."""
