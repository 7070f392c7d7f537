# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pages whose figures are drawn, but not rendered: that takes most of their time."""

import pytest

from t3mpc_ros.evaluation import plotting


def draw_only(draw, subject):
    """Return an empty PNG file in place of the figure, None where there is nothing to draw."""
    return None if draw(subject) is None else b'\x89PNG'


@pytest.fixture
def unrendered(monkeypatch):
    """Draw figures without rendering them."""
    monkeypatch.setattr(plotting, 'png_of', draw_only)
