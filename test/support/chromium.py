# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, driven by its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

from tornado.websocket import websocket_connect

NAMES = ('chromium', 'chromium-browser', 'google-chrome')
TIMEOUT = 30.0  # [s] of everything: the machine may be busy


def executable():
    """Its path, None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """A page; what it complains of is in ``problems``, and what it loads in ``requests``."""

    def __init__(self, loop, socket):
        self._loop, self._socket = loop, socket
        self._answers, self._next = {}, 0
        self.problems, self.requests = [], []
        asyncio.run_coroutine_threadsafe(self._listen(), loop)
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self.call(f'{domain}.enable')

    async def _listen(self):
        while (text := await self._socket.read_message()) is not None:
            message = json.loads(text)
            if 'id' in message:
                self._answers.pop(message['id']).set_result(message)
                continue
            self._note(message['method'], message['params'])

    def _note(self, method, params):
        if method == 'Runtime.exceptionThrown':
            detail = params['exceptionDetails']
            self.problems.append(detail.get('exception', {}).get('description', detail['text']))
        elif method == 'Runtime.consoleAPICalled' and params['type'] in ('error', 'warning'):
            self.problems.append(str([a.get('value') for a in params['args']]))
        elif method == 'Log.entryAdded' and params['entry']['level'] in ('error', 'warning'):
            self.problems.append(params['entry']['text'])
        elif method == 'Network.requestWillBeSent':
            self.requests.append(params['request']['url'])

    async def _call(self, method, params):
        self._next += 1
        answer = self._loop.create_future()
        self._answers[self._next] = answer
        await self._socket.write_message(
            json.dumps({'id': self._next, 'method': method, 'params': params})
        )
        return await asyncio.wait_for(answer, TIMEOUT)

    def call(self, method, **params):
        """One command of the protocol."""
        asked = asyncio.run_coroutine_threadsafe(self._call(method, params), self._loop)
        answer = asked.result(TIMEOUT)
        assert 'error' not in answer, answer
        return answer['result']

    def evaluate(self, script):
        """The value of an expression of JavaScript."""
        found = self.call(
            'Runtime.evaluate', expression=script, returnByValue=True, awaitPromise=True
        )
        assert 'exceptionDetails' not in found, found
        return found['result'].get('value')

    def wait_for(self, script):
        """Until the expression is true; its value."""
        deadline = time.monotonic() + TIMEOUT
        while not (value := self.evaluate(script)):
            assert time.monotonic() < deadline, (script, self.problems)
            time.sleep(0.02)
        return value

    def open(self, url):
        """Go there, and wait until the viewer has begun."""
        self.call('Page.navigate', url=url)
        self.wait_for('Boolean(window.viewer && window.viewer.ready)')
        self.settle()

    def settle(self):
        """Until what was changed has been drawn."""
        self.evaluate('new Promise(r => setTimeout(() => requestAnimationFrame(() => '
                      'requestAnimationFrame(() => r(1))), 250))')  # fmt: skip

    def resize(self, width, height, mobile=False, scale=1):
        """The window, in CSS pixels."""
        self.call('Emulation.setDeviceMetricsOverride', width=width, height=height, mobile=mobile,
                  deviceScaleFactor=scale)  # fmt: skip
        self.call('Emulation.setTouchEmulationEnabled', enabled=mobile)

    def dark(self, is_dark):
        """The colours that the user prefers."""
        value = 'dark' if is_dark else 'light'
        self.call(
            'Emulation.setEmulatedMedia',
            features=[{'name': 'prefers-color-scheme', 'value': value}],
        )

    def move(self, x, y, kind='mouseMoved', **more):
        """The mouse, at a place of the window."""
        self.call('Input.dispatchMouseEvent', type=kind, x=x, y=y, **more)

    def click(self, x, y):
        """Press and release the left button."""
        self.move(x, y)
        for kind in ('mousePressed', 'mouseReleased'):
            self.move(x, y, kind, button='left', clickCount=1)

    def picture(self, path, whole=False):
        """A screenshot as PNG, of the window or of the whole page."""
        data = self.call('Page.captureScreenshot', captureBeyondViewport=whole)['data']
        Path(path).write_bytes(base64.b64decode(data))


@contextmanager
def browser(width=1280, height=900):
    """A page of a Chromium of its own, without network."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    with tempfile.TemporaryDirectory(prefix='chromium_', ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [
                executable(), '--headless=new', '--no-sandbox', '--disable-gpu', '--no-first-run',
                '--disable-dev-shm-usage', '--disable-background-networking',
                '--remote-debugging-port=0', f'--user-data-dir={profile}',
                '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1', 'about:blank',
            ],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        thread.start()
        socket = None
        try:
            port = _port(Path(profile) / 'DevToolsActivePort', process)
            socket = asyncio.run_coroutine_threadsafe(_connect(port), loop).result(TIMEOUT)
            page = Page(loop, socket)
            page.resize(width, height)
            yield page
        finally:
            process.terminate()
            process.wait(TIMEOUT)
            if socket is not None:
                loop.call_soon_threadsafe(socket.close)
            loop.call_soon_threadsafe(loop.stop)
            thread.join(TIMEOUT)
            loop.close()


def _port(file, process):
    """Where it listens, which it writes when it has begun."""
    deadline = time.monotonic() + TIMEOUT
    while not (file.exists() and file.read_text().count('\n')):
        assert process.poll() is None, 'Chromium has ended'
        assert time.monotonic() < deadline, 'Chromium did not begin'
        time.sleep(0.02)
    return int(file.read_text().split('\n')[0])


async def _connect(port):
    from tornado.httpclient import AsyncHTTPClient

    client = AsyncHTTPClient()
    targets = json.loads((await client.fetch(f'http://127.0.0.1:{port}/json/list')).body)
    url = next(t['webSocketDebuggerUrl'] for t in targets if t['type'] == 'page')
    return await websocket_connect(url, max_message_size=1 << 28)
