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
"""Files that the live page and the reports share."""

from functools import cache
from importlib.resources import files

PAGE_FILES = ('style.css', 'charts.js', 'uplot.js', 'uplot.css')
"""Names of the files; uPlot's licence is beside them."""


@cache
def page_file(name: str) -> str:
    """Return the text of one of :data:`PAGE_FILES`."""
    if name not in PAGE_FILES:
        raise ValueError(f'name must be one of {", ".join(PAGE_FILES)}: got {name}')
    return (files('t3mpc_ros.page') / name).read_text(encoding='utf-8')
