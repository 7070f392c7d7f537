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
"""Pages whose figures are drawn, but not rendered: that takes most of their time."""

import pytest

from t3mpc_ros.evaluation import figure_style


def draw_only(draw, subject):
    """Return a figure that is not laid out, None where there is nothing to draw."""
    return draw(subject)


@pytest.fixture
def unrendered(monkeypatch):
    """Draw figures without rendering them."""
    monkeypatch.setattr(figure_style, 'drawing', draw_only)
    monkeypatch.setattr(figure_style, 'file_of', lambda figure, kind: kind.encode())
