# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Settings as one declarative table: see :mod:`t3mpc_ros.settings.table`."""

from t3mpc_ros.settings.table import Row, SettingError, Settings, nested, setting

__all__ = ['Row', 'SettingError', 'Settings', 'nested', 'setting']
