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
"""Errors of bags: what a file, a topic, a type or a message is refused for."""


class BagError(RuntimeError):
    """Base class of all errors of this package."""


class UnknownTypeError(BagError):
    """No definition of a message type is available."""


class UnknownTopicError(BagError):
    """The topic was not added to, or is not in, the bag."""


class DataError(BagError):
    """A message, stamp or metadata record is invalid."""
