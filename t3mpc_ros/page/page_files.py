# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
