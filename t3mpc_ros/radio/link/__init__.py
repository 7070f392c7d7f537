# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The host's end of the link, as a pure function of time and bytes: :class:`Link`."""

from t3mpc_ros.radio.link.machine import Link
from t3mpc_ros.radio.link.settings import LinkSettings
from t3mpc_ros.radio.link.telemetry import Telemetry

__all__ = ['Link', 'LinkSettings', 'Telemetry']
