# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Words everybody uses: poses, twists, wheel speeds, unicycle kinematics."""

from t3mpc_ros.motion.kinematics import Geometry
from t3mpc_ros.motion.words import BodyTwist, Motion, Pose, WheelSpeeds

__all__ = ['BodyTwist', 'Geometry', 'Motion', 'Pose', 'WheelSpeeds']
