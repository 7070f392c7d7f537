# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Environments of Gymnasium: importing this module registers ``t3mpc_ros/Tracking-v0``.

``gymnasium.make('t3mpc_ros.gym:t3mpc_ros/Tracking-v0')`` imports it by itself. A policy is a
controller for ``t3mpc_ros.compare`` whose ``step`` returns ``accelerations_of`` its action for the
``vector_of`` an observation.
"""

from t3mpc_ros.missing_library import remedy

try:
    from gymnasium import register
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(remedy(error) or str(error), name=error.name) from error

from t3mpc_ros.evaluation.api.tracking_env import (
    TrackingEnv,
    accelerations_of,
    vector_of,
)

__all__ = ['TrackingEnv', 'accelerations_of', 'vector_of']
register('t3mpc_ros/Tracking-v0', 't3mpc_ros.evaluation.api.tracking_env:TrackingEnv')
