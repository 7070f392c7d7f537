# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One decorator for every compiled function: ``from t3mpc_ros.kernels import kernel``."""

from t3mpc_ros.kernels.compile import kernel

__all__ = ['kernel']
