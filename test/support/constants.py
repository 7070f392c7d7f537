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
"""Parameter tables with other values of their constants."""

from t3mpc_ros.parameters.table import Parameters


def with_constants(table: type[Parameters], **constants: object) -> type[Parameters]:
    """Return a subclass of a table in which some class variables have other values."""
    unknown = constants.keys() - table.class_constants().keys()
    assert not unknown, f'{table.__name__} has no constants {unknown}'
    return type(table.__name__, (table,), constants)


def split_constants(
    table: type[Parameters], values: dict[str, object]
) -> tuple[type[Parameters], dict[str, object]]:
    """Return the table with the constants among ``values``, and the other values."""
    constants = {name: value for name, value in values.items() if name in table.class_constants()}
    others = {name: value for name, value in values.items() if name not in constants}
    return with_constants(table, **constants), others
