# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From a bag alone: figures, figures of merit, and a page that shows them."""

from t3mpc_ros.lab.report.merit import ReportFigures
from t3mpc_ros.lab.report.page import write_report
from t3mpc_ros.lab.report.topics import ReportError, Wanted

__all__ = ['ReportError', 'ReportFigures', 'Wanted', 'write_report']
