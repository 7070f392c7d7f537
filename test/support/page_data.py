# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the live page gets, as a reader who has read all of it has it."""

from t3mpc_ros.view.live_data import Cursor


def read_all(data, cursor=None):
    """Return the news of all answers from a cursor on, as one, and the last cursor."""
    found, cursor = {}, cursor or Cursor()
    while True:
        news, cursor = data.read(cursor)
        more = news.pop('more', False)
        for stream, new in news.pop('streams', {}).items():
            known = found.setdefault('streams', {}).setdefault(
                stream, {'time': [], 'values': [[] for _ in new['values']]}
            )
            known['time'] += new['time']
            for column, values in zip(known['values'], new['values'], strict=True):
                column += values
        if events := news.pop('events', []):
            found.setdefault('events', []).extend(events)
        if facts := news.pop('facts', {}):
            found.setdefault('facts', {}).update(facts)
        assert not news
        if not more:
            return found, cursor
