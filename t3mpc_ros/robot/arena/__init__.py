# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What stands around the robot: a world from a file, what is seen of it, and what it pushes."""

from t3mpc_ros.robot.arena.contact import BumperSettings
from t3mpc_ros.robot.arena.world import World, WorldError, load_world

__all__ = ['BumperSettings', 'World', 'WorldError', 'load_world']
