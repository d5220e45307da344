# SPDX-License-Identifier: Apache-2.0
"""The server of `rlml view`: who may ask, and what becomes of a browser that hangs."""

from __future__ import annotations

import asyncio
import json
import socket
from contextlib import asynccontextmanager

import pytest
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.httpserver import HTTPServer
from tornado.iostream import IOStream
from tornado.netutil import bind_sockets
from tornado.websocket import websocket_connect

from rlml_slam.cli.main import main
from rlml_slam.cli.view import server
from rlml_slam.cli.view.server import Browsers, application, as_json

SNAPSHOT = {'start': True, 'replace': {}}


@asynccontextmanager
async def serving():
    """(port, browsers) of a server."""
    browsers = Browsers(lambda: SNAPSHOT)
    sockets = bind_sockets(0, '127.0.0.1')
    running = HTTPServer(application('<p>page</p>', browsers, '127.0.0.1'))
    running.add_sockets(sockets)
    try:
        yield sockets[0].getsockname()[1], browsers
    finally:
        running.stop()
        await running.close_all_connections()


async def fetch(port, path='/', method='GET', **headers):
    """Status, body and headers."""
    request = HTTPRequest(
        f'http://127.0.0.1:{port}{path}', method, headers, allow_nonstandard_methods=True
    )
    try:
        answer = await AsyncHTTPClient().fetch(request)
    except HTTPClientError as e:
        return e.code, '', {}
    return answer.code, answer.body.decode(), answer.headers


def test_page_is_served_with_a_strict_policy():
    async def ask():
        async with serving() as (port, _):
            return await fetch(port)

    code, body, headers = asyncio.run(ask())
    assert (code, body) == (200, '<p>page</p>')
    assert "default-src 'none'" in headers['Content-Security-Policy']
    assert headers['X-Content-Type-Options'] == 'nosniff'
    assert 'Access-Control-Allow-Origin' not in headers


@pytest.mark.parametrize(
    ('host', 'code'),
    [
        ('127.0.0.1', 200), ('localhost', 200), ('[::1]', 200), ('192.168.1.7', 200),
        ('attacker.example', 403), ('127.0.0.1.attacker.example', 403), ('[::1', 403),
    ],
)  # fmt: skip
def test_foreign_host_names_are_refused(host, code):
    async def ask():
        async with serving() as (port, _):
            return (await fetch(port, Host=f'{host}:{port}'))[0]

    assert asyncio.run(ask()) in ((code,) if code == 200 else (code, 400))


@pytest.mark.parametrize('method', ['POST', 'PUT', 'DELETE', 'PATCH', 'OPTIONS'])
def test_nothing_can_be_written(method):
    async def ask():
        async with serving() as (port, _):
            return (await fetch(port, method=method))[0]

    assert asyncio.run(ask()) == 405


def test_page_of_another_origin_gets_no_messages():
    async def ask():
        async with serving() as (port, browsers):
            url = f'ws://127.0.0.1:{port}/messages'
            with pytest.raises(HTTPClientError, match='403'):
                await websocket_connect(
                    HTTPRequest(url, headers={'Origin': 'http://other.example'})
                )
            own = await websocket_connect(
                HTTPRequest(url, headers={'Origin': f'http://127.0.0.1:{port}'})
            )
            first = json.loads(await own.read_message())
            browsers.send({'state': 'x'})
            second = json.loads(await own.read_message())
            own.close()
            return first, second

    assert asyncio.run(ask()) == (SNAPSHOT, {'state': 'x'})


def test_browser_that_speaks_is_disconnected():
    async def ask():
        async with serving() as (port, browsers):
            page = await websocket_connect(f'ws://127.0.0.1:{port}/messages')
            await page.read_message()
            await page.write_message('anything')
            assert await page.read_message() is None
            while browsers.open:
                await asyncio.sleep(0.001)
            page.close()

    asyncio.run(asyncio.wait_for(ask(), 30.0))


def test_hanging_browser_is_dropped_and_others_get_all():
    async def ask():
        async with serving() as (port, browsers):
            good = await websocket_connect(f'ws://127.0.0.1:{port}/messages')
            await good.read_message()
            stream = IOStream(socket.socket())
            await stream.connect(('127.0.0.1', port))
            await stream.write(
                f'GET /messages HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n'
                'Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n'
                'Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n'.encode()
            )
            await stream.read_until(b'\r\n\r\n')
            while len(browsers.open) < 2:
                await asyncio.sleep(0.001)
            text, got = 'x' * 1_000_000, 0
            while browsers.dropped == 0:
                browsers.send({'state': text})
                await good.read_message()
                got += 1
                assert got < 200
            stream.close()
            good.close()
            return browsers.dropped, len(browsers.open)

    assert asyncio.run(ask()) == (1, 1)


def test_there_are_not_too_many_browsers(monkeypatch):
    monkeypatch.setattr(server, 'MAX_BROWSERS', 1)

    async def ask():
        async with serving() as (port, _):
            first = await websocket_connect(f'ws://127.0.0.1:{port}/messages')
            await first.read_message()
            with pytest.raises(HTTPClientError, match='503'):
                await websocket_connect(f'ws://127.0.0.1:{port}/messages')
            first.close()

    asyncio.run(ask())


def test_messages_are_json_without_nan():
    with pytest.raises(ValueError, match='Out of range'):
        as_json({'x': float('nan')})


def test_taken_port_is_one_line(capsys):
    pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')
    sockets = bind_sockets(0, '127.0.0.1')
    try:
        assert main(['view', '--port', str(sockets[0].getsockname()[1])]) == 1
    finally:
        for s in sockets:
            s.close()
    assert 'cannot be listened to' in capsys.readouterr().err
