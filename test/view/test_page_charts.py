# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Charts of the live page: titles, units, labels, and the columns that they are drawn of."""

import re

from t3mpc_ros.page.page_files import PAGE_FILES
from t3mpc_ros.view import server

SCRIPT = (server.files('t3mpc_ros.view') / 'page' / 'view.js').read_text(encoding='utf-8')
MOTION = ('right', 'left', 'x', 'y', 'yaw')
"""Columns of the streams of motion, as ``recorded_run`` and the viewer fill them."""


def test_charts_have_the_units_of_their_quantities():
    assert 'uplot.js' in PAGE_FILES
    charts = re.findall(
        r"made\.(\w+) = charts\.add\('([^']*)', '([^']*)',\s(.*?)\);", SCRIPT, re.S
    )
    assert [chart[:3] for chart in charts] == [
        ('right', 'Right wheel', 'rad/s'),
        ('left', 'Left wheel', 'rad/s'),
        ('error', 'Error', 'rad/s'),
        ('terms', 'Terms of the control law, right wheel', 'rad/s²'),
    ]
    labels = [re.findall(r"label: '(\w+)'", lines) for *_, lines in charts]
    assert labels == [[], [], ['right', 'left'], []]
    assert [re.findall(r"wheel\('(\w+)'\)", lines) for *_, lines in charts[:2]] == [
        ['right'],
        ['left'],
    ]
    of_wheel = re.search(r'const wheel = .*?\];', SCRIPT, re.S)[0]
    assert re.findall(r"label: '(\w+)'", of_wheel) == ['reference', 'measured', 'command']


def test_charts_show_the_columns_of_their_labels():
    (order,) = re.findall(r'for \(const \[i, name\] of \[(.*?)\]\.entries', SCRIPT)
    assert re.findall(r'\w+', order) == [*MOTION[:2]]
    (drawn,) = re.findall(r'charts\.set\(made\[name\], \[(.*?)\]\);', SCRIPT)
    assert re.findall(r"table\('(\w+)', i\)", drawn) == ['reference', 'odometry', 'command']
    # Error is measured less reference, of right and left; terms are those of the right wheel.
    assert "[time, ...measured] = table('odometry', 0, 1)" in SCRIPT
    assert "[at, ...wanted] = table('reference', 0, 1)" in SCRIPT
    assert 'value - expected[k]' in SCRIPT
    assert "table('terms', ...facts.terms.map((_, i) => 2 * i))" in SCRIPT
    assert "last('truth', 2, 3)" in SCRIPT
    assert MOTION[2:] == ('x', 'y', 'yaw')
