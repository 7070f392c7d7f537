# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The board of the robot: what its firmware does, as a function of time and payloads."""

from t3mpc_ros.emulator.board.hardware import Hardware, Registers
from t3mpc_ros.emulator.board.rules import Board

__all__ = ['Board', 'Hardware', 'Registers']
