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
"""Web server of the live page, for this machine only.

The page asks ``/events`` several times a second for what is new, and sends commands to
``/command``. No request is kept waiting: a browser has six connections to a host, for all of its
tabs together, and the e-stop needs one at any time. A page of another origin can do neither:
requests with a foreign ``Host`` are refused (a name that another site lets point to this machine),
and so are commands with a foreign ``Origin`` or without the token that this start of the server
has written into its own page.
"""

from collections.abc import Callable, Mapping
from functools import cache
import hmac
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
import json
import math
from pathlib import Path
import secrets
from threading import Lock, Thread
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

from t3mpc_ros.page.assets import PAGE_FILES, page_file
from t3mpc_ros.view.live_data import Cursor, Json, LiveData

ADDRESS = '127.0.0.1'
MAX_BODY = 4096
"""Largest command, bytes."""

_TYPES = {'.html': 'text/html', '.js': 'text/javascript', '.css': 'text/css'}
_OWN = files('t3mpc_ros.view') / 'page'
_PAGE = {each.name for each in _OWN.iterdir() if each.name.endswith(tuple(_TYPES))} | {*PAGE_FILES}
"""Files that are served."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
_ALONE = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; base-uri 'none'"
)
"""A report has its scripts inside, made of what a bag says: its origin is none, and it asks for
nothing."""
_HEADERS = {
    'Cache-Control': 'no-store',
    'Cross-Origin-Opener-Policy': 'same-origin',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Referrer-Policy': 'no-referrer',
    'X-Content-Type-Options': 'nosniff',
}

Command = Callable[[str, Mapping[str, Json], float], str]
"""Executes a command: name, arguments, and the time of the click on the steady clock of this
program, s, -inf if the page does not know it; returns what was done, or raises RuntimeError."""


class RefusedError(Exception):
    """A request that is refused: HTTP status, and the reason for the sender."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class PageServer:
    """Serves the live page of one run, in threads of its own; a context manager.

    ``command`` runs in a thread of the server; None: the page shows only. ``port`` is a TCP port
    on :data:`ADDRESS`, 0 a free one; OSError if it is in use. ``clock`` is the steady clock on
    which the times of commands count, s.
    """

    def __init__(
        self, data: LiveData, command: Command | None, port: int, clock: Callable[[], float]
    ) -> None:
        self.data = data
        self.command = command
        self.clock = clock
        self.report: Path | None = None
        """Newest report of a recording, served as ``/report``."""
        self.token = secrets.token_urlsafe(24)
        self._texts: tuple[Cursor, dict[Cursor, str]] = Cursor(), {}
        """Newest change, and what was sent since then, by the cursor of the page."""
        self._encoding = Lock()
        try:
            self._server = _Server((ADDRESS, port), self)
        except OSError as error:
            raise OSError(
                error.errno, f'port {port} of {ADDRESS} is not free ({error.strerror}); choose '
                'another one with --port, 0 for any free port'
            ) from None  # fmt: skip
        self.port: int = self._server.server_address[1]
        self.url = f'http://{ADDRESS}:{self.port}/'
        self._thread = Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)

    def news(self, cursor: Cursor) -> str:
        """Return what has changed since the cursor in JSON, without the final bracket.

        Pages that ask between the same two changes get one text: most of the cost is its encoding.
        One thread encodes at a time: many would leave no time to the thread that executes a stop.
        """
        with self._encoding:
            newest, texts = self._texts
            if newest != (present := self.data.newest()):
                newest, texts = self._texts = present, {}
            if (text := texts.get(cursor)) is None:
                changes, end = self.data.read(cursor)
                changes['id'] = f'{self.token[:8]}-{end.change}-{end.fact}'
                text = json.dumps(changes, separators=(',', ':'), allow_nan=False)[:-1]
                texts[cursor] = text
            return text

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    # What a suspended program finds waiting; beyond it, a stop waits longer.
    request_queue_size = 128

    def __init__(self, address: tuple[str, int], page: PageServer) -> None:
        self.page = page
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore what a browser does when it closes a connection."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = 'HTTP/1.1'
    server: _Server
    timeout = 30.0

    def log_message(self, format: str, *values: Any) -> None:
        """Print nothing: a page asks often."""

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_POST(self) -> None:
        self._answer(self._post)

    def _answer(self, method: Callable[[], None]) -> None:
        try:
            self._check_host()
            method()
        except RefusedError as refusal:
            self.close_connection = True  # the rest of the request was not read
            self._send(json.dumps({'error': str(refusal)}), 'application/json', refusal.status)
        except (BrokenPipeError, ConnectionResetError, TimeoutError):
            self.close_connection = True

    def _check_host(self) -> None:
        port = self.server.page.port
        if self.headers.get('Host') not in (f'{ADDRESS}:{port}', f'localhost:{port}'):
            raise RefusedError(
                HTTPStatus.FORBIDDEN, f'this page is served as {self.server.page.url} only'
            )

    def _get(self) -> None:
        page, url = self.server.page, urlsplit(self.path)
        if url.path == '/events':
            self._events(url.query)
            return
        if url.path == '/report' and page.report is not None and page.report.exists():
            self._send(_text_of(page.report), 'text/html', policy=_ALONE)
            return
        name = url.path.removeprefix('/') or 'view.html'
        if name not in _PAGE:
            raise RefusedError(HTTPStatus.NOT_FOUND, f'there is no {url.path}')
        text = _file(name)
        if name == 'view.html':
            text = text.replace('{{ token }}', page.token if page.command else '')
        self._send(text, _TYPES[name[name.rindex('.') :]])

    def _events(self, query: str) -> None:
        """Send what is new since the last request of this page, and the time of this clock."""
        page = self.server.page
        self._send(f'{page.news(self._cursor(query))},"now":{page.clock()}}}', 'application/json')

    def _cursor(self, query: str) -> Cursor:
        """Return how far the page has read; a page of an earlier start has read nothing."""
        start, *read = parse_qs(query).get('last', [''])[0].rsplit('-', 2)  # start may contain one
        if start != self.server.page.token[:8] or len(read) != 2:
            return Cursor()
        return Cursor(*map(int, read)) if all(map(str.isdecimal, read)) else Cursor()

    def _post(self) -> None:
        page = self.server.page
        if urlsplit(self.path).path != '/command':
            raise RefusedError(HTTPStatus.NOT_FOUND, f'there is no {self.path}')
        if page.command is None:
            raise RefusedError(
                HTTPStatus.FORBIDDEN, 'this page was started with --read-only: commands are off'
            )
        command = self._read_command(page)
        try:
            done = page.command(*command)
        except RuntimeError as error:
            self._send(json.dumps({'error': str(error)}), 'application/json', HTTPStatus.CONFLICT)
        else:
            self._send(json.dumps({'done': done}), 'application/json')

    def _read_command(self, page: PageServer) -> tuple[str, Mapping[str, Json], float]:
        """Return name, arguments and time of a command of this very page."""
        origin = self.headers.get('Origin', f'http://{self.headers["Host"]}')
        if origin != f'http://{self.headers["Host"]}':
            raise RefusedError(HTTPStatus.FORBIDDEN, f'commands from {origin} are refused')
        if not hmac.compare_digest(self.headers.get('X-Token', '').encode(), page.token.encode()):
            raise RefusedError(
                HTTPStatus.FORBIDDEN, 'the token is not that of this start: load the page again'
            )
        length = self.headers.get('Content-Length', '')
        if not length.isdecimal() or int(length) > MAX_BODY:
            raise RefusedError(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f'a command must have at most {MAX_BODY} bytes: got {length or "no length"}',
            )
        try:
            content = json.loads(self.rfile.read(int(length)))
            name, arguments = content['command'], content.get('arguments', {})
            asked = float(content.get('asked', -math.inf))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            name = arguments = None
        if not isinstance(name, str) or not isinstance(arguments, dict):
            raise RefusedError(
                HTTPStatus.BAD_REQUEST,
                'a command must be {"command": NAME, "arguments": {…}, "asked": SECONDS} in JSON',
            )
        return name, arguments, asked

    def _send(
        self, text: str, kind: str, status: HTTPStatus = HTTPStatus.OK, policy: str = _POLICY
    ) -> None:
        """Send all of an answer at once: its second part would wait 40 ms for an acknowledgement.

        Without the date and the name of the server, which nobody reads.
        """
        content = text.encode()
        headers = {
            'Content-Type': f'{kind}; charset=utf-8',
            'Content-Length': len(content),
            'Connection': 'close' if self.close_connection else 'keep-alive',
            'Content-Security-Policy': policy,
            **_HEADERS,
        }
        lines = [f'HTTP/1.1 {status.value} {status.phrase}']
        lines += (f'{name}: {value}' for name, value in headers.items())
        self.wfile.write('\r\n'.join((*lines, '', '')).encode() + content)


def _text_of(file: Path) -> str:
    return file.read_text(encoding='utf-8')


@cache
def _file(name: str) -> str:
    if name in PAGE_FILES:
        return page_file(name)
    return (_OWN / name).read_text(encoding='utf-8')
