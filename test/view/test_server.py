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
"""The server of the live page: what it serves, and whom it refuses."""

from contextlib import closing
from http.client import HTTPConnection
import json
import math
import re
import socket
import threading
import time

import pytest

from t3mpc_ros.view.live_data import Cursor, LiveData
from t3mpc_ros.view.server import ADDRESS, MAX_BODY, PageServer


class Page:
    """A server, its commands, and requests as a browser sends them."""

    def __init__(self, server, done):
        self.server, self.done = server, done
        self.host = f'{ADDRESS}:{server.port}'

    def request(self, method, path, body=None, **headers):
        """Return status, headers and text of an answer; ``x_token`` sets X-Token."""
        sent = {'Host': self.host} | {
            name.replace('_', '-').title(): value for name, value in headers.items()
        }
        with closing(HTTPConnection(ADDRESS, self.server.port, timeout=20)) as connection:
            connection.request(method, path, body, sent)
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read().decode()

    def command(self, body=b'{"command": "e_stop", "arguments": {"on": true}}', **headers):
        """Return status and answer of a command of the page itself, but for the headers."""
        own = {'x_token': self.server.token, 'origin': f'http://{self.host}'}
        status, _, text = self.request('POST', '/command', body, **own | headers)
        return status, json.loads(text)

    def events(self, last=''):
        """Return the id and the news of an answer."""
        status, _, text = self.request('GET', f'/events?last={last}')
        assert status == 200
        news = json.loads(text)
        return news.pop('id'), news


@pytest.fixture
def page():
    done = []

    def command(name, arguments, asked):
        if name == 'fail':
            raise RuntimeError('no node offers it')
        done.append((name, arguments, asked))
        return 'latched'

    with PageServer(LiveData(), command, 0, time.monotonic) as server:
        yield Page(server, done)


def test_page_and_scripts_are_served_and_nothing_else(page):
    status, headers, text = page.request('GET', '/')
    assert status == 200
    assert page.server.token in text
    assert "default-src 'none'" in headers['Content-Security-Policy']
    names = {*re.findall(r'(?:src|href)="([^":]+)"', text)}
    assert page.request('GET', '/report')[0] == 404, 'nothing has been recorded'
    for name in names - {'report'}:
        assert page.request('GET', f'/{name}')[0] == 200, name
    for path in ('/server.py', '/../server.py', '/page/view.js', '/view.html/x', '/%2e%2e/x'):
        assert page.request('GET', path)[0] == 404, path
    # A page that works offline loads nothing from elsewhere.
    for name in ('view.html', 'view.js', 'pictures.js', 'charts.js', 'view.css'):
        assert not re.search(r'https?://(?!www\.w3\.org)', page.request('GET', f'/{name}')[2])


def test_a_command_of_the_page_is_executed(page):
    assert page.command() == (200, {'done': 'latched'})
    assert page.done == [('e_stop', {'on': True}, -math.inf)]
    assert page.command(b'{"command": "reset", "asked": 12.5}')[0] == 200
    assert page.done[-1] == ('reset', {}, 12.5)
    assert page.command(b'{"command": "fail"}') == (409, {'error': 'no node offers it'})


@pytest.mark.parametrize(
    ('headers', 'status', 'words'),
    [
        ({'host': 'evil.example'}, 403, 'is served as'),
        ({'host': 'evil.example:80', 'origin': 'http://evil.example:80'}, 403, 'is served as'),
        ({'origin': 'http://evil.example'}, 403, 'commands from http://evil.example'),
        ({'origin': 'null'}, 403, 'commands from null'),
        ({'x_token': ''}, 403, 'load the page again'),
        ({'x_token': 'x' * 32}, 403, 'load the page again'),
        ({'x_token': 'é'}, 403, 'load the page again'),
        ({'content_length': str(MAX_BODY + 1)}, 413, f'at most {MAX_BODY} bytes'),
        ({'content_length': '-1'}, 413, 'at most'),
    ],
)
def test_commands_of_others_are_refused(headers, status, words, page):
    found, answer = page.command(**headers)
    assert found == status
    assert words in answer['error']
    assert page.done == []


def test_a_foreign_host_reads_nothing(page):
    for path in ('/', '/events', '/view.js'):
        assert page.request('GET', path, host='evil.example')[0] == 403


@pytest.mark.parametrize(
    'body',
    [
        b'',
        b'[]',
        b'{"command": 1}',
        b'{"command": "x", "arguments": 3}',
        b'{"command": "x", "asked": "now"}',
        b'[' * 3000,
        b'\xff',
    ],
)
def test_a_malformed_command_is_refused(body, page):
    status, answer = page.command(body)
    assert status == 400
    assert 'a command must be' in answer['error']


def test_a_read_only_page_has_no_token_and_takes_no_command():
    with PageServer(LiveData(), None, 0, time.monotonic) as server:
        page = Page(server, [])
        assert server.token not in page.request('GET', '/')[2]
        status, answer = page.command()
        assert (status, '--read-only' in answer['error']) == (403, True)


@pytest.mark.parametrize('token', ['0123456789', 'x-y_-z0-9-'])
def test_events_go_on_where_a_page_has_stopped(page, token):
    """With a hyphen in the token, as in one of eight, all events came again."""
    page.server.token = token
    data = page.server.data
    data.add('a', 0.0, [1.0])
    last, news = page.events()
    assert news['streams']['a']['values'] == [[1.0]]
    data.add('a', 1.0, [2.0])
    assert page.events(last)[1]['streams']['a']['values'] == [[2.0]]
    # The page of an earlier start has seen nothing of this one.
    for other in ('other-7-0', f'{token[:8]}-7', f'{token[:8]}-x-0', '-', ''):
        assert page.events(other)[1]['streams']['a']['values'] == [[1.0, 2.0]]


def test_pages_that_share_answers_get_every_change_once(page):
    """A text is encoded once for all pages that have read as far, until anything changes."""
    data, pages = page.server.data, [{'last': '', 'events': [], 'facts': []} for _ in range(3)]

    def ask(reader):
        reader['last'], news = page.events(reader['last'])
        reader['events'] += [event['text'] for event in news.get('events', ())]
        reader['facts'] += [news['facts']['n']] if 'facts' in news else []

    for k in range(12):
        if k % 2:
            data.set('n', k)
        else:
            data.report(float(k), 'note', str(k))
        for i, reader in enumerate(pages):
            if k % (i + 1) == 0:
                ask(reader)
    for reader in pages:
        ask(reader)
        assert reader['events'] == [str(k) for k in range(0, 12, 2)]
        assert reader['facts'][-1] == 11


def test_pages_that_load_at_once_are_encoded_one_by_one(page, monkeypatch):
    """Ten pages that were loaded again and again kept a stop from being executed for 3 s."""
    data, at_once = page.server.data, []
    read, guard = data.read, threading.Semaphore(1)

    def contested(cursor):
        at_once.append(not guard.acquire(blocking=False))
        time.sleep(0.01)  # another thread may begin
        guard.release()
        return read(cursor)

    monkeypatch.setattr(data, 'read', contested)
    loads = [threading.Thread(target=page.server.news, args=(Cursor(k),)) for k in range(5)]
    for each in loads:
        each.start()
    for each in loads:
        each.join()
    assert at_once == [False] * 5


def test_an_answer_without_news_comes_at_once_with_the_time(page):
    """No request waits: of the six connections of a browser one must be free for a stop."""
    before = time.monotonic()
    last, news = page.events()
    assert before <= news.pop('now') <= time.monotonic()
    assert news == {}
    assert page.events(last)[0] == last


def test_an_answer_is_sent_at_once(page):
    """Its head went first; the rest waited 40 ms for an acknowledgement, ten times a second."""
    with socket.create_connection((ADDRESS, page.server.port), timeout=20) as connection:
        for _ in range(3):
            connection.sendall(f'GET /events HTTP/1.1\r\nHost: {page.host}\r\n\r\n'.encode())
            head, _, body = connection.recv(65536).partition(b'\r\n\r\n')
            assert head.startswith(b'HTTP/1.1 200 OK\r\n')
            assert 'now' in json.loads(body)


def test_a_report_is_served_alone_and_cannot_command(page, tmp_path):
    """Its scripts are in it, made of what a bag says: a name there must not command a robot."""
    page.server.report = tmp_path / 'report.html'
    assert page.request('GET', '/report')[0] == 404
    page.server.report.write_text('<p>good run')
    status, headers, text = page.request('GET', '/report')
    assert (status, text) == (200, '<p>good run')
    policy = headers['Content-Security-Policy']
    assert 'sandbox allow-scripts allow-downloads;' in policy  # its origin is null
    assert 'connect-src' not in policy
    assert "default-src 'none'" in policy
    assert page.command(origin='null')[0] == 403


def test_a_port_in_use_is_an_error_with_a_remedy(page):
    with pytest.raises(OSError, match=r'port \d+ of 127.0.0.1 is not free .*--port'):
        PageServer(LiveData(), None, page.server.port, time.monotonic)
