# SPDX-License-Identifier: Apache-2.0
"""The page of a live viewer over HTTP, and its messages over WebSocket. It only sends.

Each browser has a bounded number of messages on their way; one that does not take them is
disconnected. Requests for another host name than this machine's (DNS rebinding) and from pages of
another origin are refused.
"""

from __future__ import annotations

import ipaddress
import json
import socket
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from tornado.httputil import HTTPServerRequest
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

MAX_BROWSERS = 30
MAX_PENDING = 20  # messages of a browser that are on their way: two seconds
PING = 10.0  # [s] between questions whether a browser is still there
HEADERS = {
    'Content-Security-Policy': (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
        "img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    'X-Content-Type-Options': 'nosniff',
    'Cross-Origin-Resource-Policy': 'same-origin',
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store',
}


class Browsers:
    """The pages that watch."""

    def __init__(self, snapshot: Callable[[], Mapping[str, Any]]) -> None:
        self.snapshot = snapshot
        self.open: set[Messages] = set()
        self.dropped = 0

    def send(self, message: Mapping[str, Any]) -> None:
        """Send to all; those that are behind are disconnected."""
        if self.open:
            text = as_json(message)
            for browser in tuple(self.open):
                browser.send(text)


class Checked(RequestHandler):
    """A request of this machine's own page."""

    def prepare(self) -> None:
        """Refuse foreign host names and origins."""
        if not is_own(self.request, self.settings['host']):
            raise HTTPError(403)

    def set_default_headers(self) -> None:
        """Nothing is loaded, framed or kept."""
        self.clear_header('Server')
        for name, value in HEADERS.items():
            self.set_header(name, value)


class Page(Checked):
    """The page itself."""

    def get(self) -> None:
        """The same for everybody."""
        self.write(self.settings['page'])


class Messages(Checked, WebSocketHandler):
    """One browser."""

    def initialize(self) -> None:
        """Nothing is on its way."""
        self._pending = 0

    @property
    def _browsers(self) -> Browsers:
        found: Browsers = self.settings['browsers']
        return found

    def prepare(self) -> None:
        """Refuse more browsers than a viewer is for."""
        super().prepare()
        if len(self._browsers.open) >= MAX_BROWSERS:
            raise HTTPError(503)

    def check_origin(self, origin: str) -> bool:
        """Whether it is the page of this server."""
        return urlsplit(origin).netloc == self.request.host

    def open(self, *args: str, **kwargs: str) -> None:
        """Everything so far."""
        self.set_nodelay(True)
        self.send(as_json(self._browsers.snapshot()))
        self._browsers.open.add(self)

    def on_message(self, message: str | bytes) -> None:
        """A browser has nothing to say."""
        self.close(1003)

    def on_close(self) -> None:
        """Forget it."""
        self._browsers.open.discard(self)

    def send(self, text: str) -> None:
        """One message; a browser that has not taken the earlier ones is disconnected."""
        if self._pending >= MAX_PENDING:
            self._drop()
            return
        try:
            sent = self.write_message(text)
        except WebSocketClosedError:
            self.on_close()
            return
        self._pending += 1
        sent.add_done_callback(self._on_sent)

    def _on_sent(self, sent: Any) -> None:
        self._pending -= 1
        if sent.exception() is not None:
            self.on_close()

    def _drop(self) -> None:
        """Disconnect at once: a closing handshake would wait behind what is not taken."""
        self._browsers.dropped += 1
        self.on_close()
        connection: Any = self.ws_connection
        if connection is not None:
            connection.stream.close()


def application(page: str, browsers: Browsers, host: str) -> Application:
    """The page at ``/`` and the messages at ``/messages``; nothing else."""
    return Application(
        [('/', Page), ('/messages', Messages)],
        page=page, browsers=browsers, host=host, websocket_ping_interval=PING,
        websocket_ping_timeout=PING, websocket_max_message_size=1024,
        log_function=lambda handler: None,
    )  # fmt: skip


def is_own(request: HTTPServerRequest, host: str) -> bool:
    """Whether host name and origin of a request are of this machine.

    A page of another site that has a name resolve to this machine (DNS rebinding) sends its name:
    only addresses and the machine's own names pass.
    """
    try:
        name = urlsplit(f'//{request.host}').hostname or ''
        origin = request.headers.get('Origin')
        if origin is not None and urlsplit(origin).netloc != request.host:
            return False
    except ValueError:
        return False
    return is_address(name) or name in {host.lower(), 'localhost', socket.gethostname().lower()}


def is_address(name: str) -> bool:
    """Whether a host is an IP address."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def as_json(message: Mapping[str, Any]) -> str:
    """Without NaN, which browsers do not read."""
    return json.dumps(message, separators=(',', ':'), allow_nan=False, default=_plain)


def _plain(value: Any) -> Any:
    """Numbers of NumPy."""
    return value.item()
