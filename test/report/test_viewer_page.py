# SPDX-License-Identifier: Apache-2.0
"""The report in a browser: it loads from a file, and does what a person asks of it."""

from __future__ import annotations

import asyncio
import base64
import json
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

import chromium
import numpy as np
import pytest
from made_runs import made_run
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets

from rlml_slam.cli.view.server import Browsers, application
from rlml_slam.report.outputs import write_outputs
from rlml_slam.report.page import page as page_of
from rlml_slam.report.viewer import columns, viewer_page
from rlml_slam.report.viewer.figures import PLOTS

pytestmark = pytest.mark.skipif(
    chromium.executable() is None, reason='needs Chromium: apt-get install chromium'
)


@pytest.fixture(scope='module')
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp('report')
    run = made_run(name='</script> & a "circle"')
    for stamp in run.frames.stamps:
        angles = np.linspace(0.0, 2 * np.pi, 90)
        points = 2.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        run.frames.scans.add(stamp, points)
    write_outputs(run, folder)
    with chromium.browser() as page:
        page.open((folder / 'report.html').as_uri())
        yield page
        assert not page.problems
        assert {urlsplit(url).scheme for url in page.requests} <= {'file', 'data', 'blob'}


def data(page, source, column):
    return json.loads(
        page.evaluate(f'JSON.stringify([...viewer.source({source!r}).data.{column}])')
    )


def place(page, figure):
    """Left, top, width and height of a figure in the window."""
    page.evaluate(f'viewer.element({figure!r}).scrollIntoView({{block: "center"}})')
    page.settle()
    return page.evaluate(
        f'(r => [r.left, r.top, r.width, r.height])'
        f'(viewer.element({figure!r}).getBoundingClientRect())'
    )


def test_page_is_drawn(page):
    assert page.evaluate('document.title').startswith('</script> & a "circle"')
    assert page.evaluate('document.querySelector("h1").textContent') == '</script> & a "circle"'
    drawn = set(page.evaluate('viewer.figures()'))
    assert drawn == {'map', 'health', *(p.key for p in PLOTS)}
    for name in drawn:
        assert place(page, name)[2] > 800


def test_slider_moves_robot_scan_cursors_and_readout(page):
    page.evaluate(
        '(s => { s.value = 25; s.dispatchEvent(new Event("input")); })'
        '(document.getElementById("slider"))'
    )
    text = page.evaluate('document.getElementById("now").textContent')
    assert '25.00 s' in text
    assert 'DEGRADED' in text
    assert 'saw 0 of 4' in text
    assert '3.00 cm' in text
    x, y = (data(page, 'frames', c)[25] for c in 'xy')
    scan = np.array([data(page, 'scan', 'x'), data(page, 'scan', 'y')])
    assert np.allclose(np.hypot(scan[0] - x, scan[1] - y), 2.0, atol=0.01)
    robot = np.array([data(page, 'robot', 'x'), data(page, 'robot', 'y')])
    assert np.hypot(robot[0] - x, robot[1] - y).max() < 0.5
    assert set(page.evaluate('viewer.cursors().map(c => c.location)')) == {25.0}


def test_address_says_at_what_time_it_opens(page):
    address = page.evaluate('location.href')
    with chromium.browser() as other:
        other.open(f'{address}#t=25')
        assert '25.00 s' in other.evaluate('document.getElementById("now").textContent')


def test_layers_are_switched(page):
    for name in ('grid', 'truth', 'live', 'path', 'closures', 'keyframes', 'reflectors', 'scan'):
        box = f'document.querySelector("[data-layer={name}]")'
        seen = f'viewer.map.renderers.filter(r => r.name === "{name}").map(r => r.visible)'
        before = page.evaluate(f'{box}.checked')
        page.evaluate(f'{box}.click()')
        assert set(page.evaluate(seen)) == {not before}
        page.evaluate(f'{box}.click()')
        assert set(page.evaluate(seen)) == {before}


def test_ellipses_are_enlarged(page):
    before = data(page, 'ellipses', 'width')
    page.evaluate(
        '(s => { s.value = 3; s.dispatchEvent(new Event("input")); })'
        '(document.getElementById("size"))'
    )
    assert np.allclose(data(page, 'ellipses', 'width'), 10.0 * np.array(before))
    assert page.evaluate('document.getElementById("times").textContent') == '10'


def test_map_is_to_scale_zooms_and_resets(page):
    left, top, width, height = place(page, 'map')
    metres = (
        'const m = viewer.map; [(m.x_range.end - m.x_range.start) / m.inner_width, '
        '(m.y_range.end - m.y_range.start) / m.inner_height]'
    )
    metres = f'(() => {{ {metres.replace("[(", "return [(", 1)} }})()'
    before = page.evaluate(metres)
    assert before[0] == pytest.approx(before[1], rel=1e-3)
    page.move(left + width / 2, top + height / 2)
    page.move(left + width / 2, top + height / 2, 'mouseWheel', deltaX=0, deltaY=-400)
    page.settle()
    after = page.evaluate(metres)
    assert after[0] < 0.9 * before[0]
    assert after[0] == pytest.approx(after[1], rel=1e-3)


def test_click_on_a_plot_moves_the_cursor(page):
    left, top, width, height = place(page, 'error')
    page.click(left + 0.5 * width, top + 0.5 * height)
    page.settle()
    now = page.evaluate('+document.getElementById("slider").value')
    assert 25 <= now <= 35


def test_hover_says_numbers_and_units(page):
    left, top, width, height = place(page, 'error')
    page.move(left + 0.4 * width, top + 0.6 * height)
    page.move(left + 0.5 * width, top + 0.6 * height)
    page.settle()
    page.wait_for('viewer.tooltips().includes("published live")')
    assert '3.000 cm' in page.evaluate('viewer.tooltips()')


@pytest.mark.parametrize('width', [360, 390])
def test_phone_has_no_sideways_scrolling(page, width):
    page.resize(width, 780, mobile=True)
    page.settle()
    assert page.evaluate('document.documentElement.scrollWidth') <= width
    # the map is as wide as the page allows, and the bar of time is in view
    assert place(page, 'map')[2] > 0.75 * width
    bar = page.evaluate('document.querySelector(".time").getBoundingClientRect().bottom')
    assert bar <= 780
    page.resize(1280, 900)
    page.settle()


def test_dark_page_has_another_map(page):
    url = 'viewer.map.renderers.find(r => r.name === "grid").glyph.url.field'
    assert page.evaluate(url) == 'light'
    page.dark(True)
    page.settle()
    assert page.evaluate(url) == 'dark'
    page.dark(False)


def test_page_prints(page):
    pdf = base64.b64decode(page.call('Page.printToPDF', printBackground=True)['data'])
    assert pdf.startswith(b'%PDF')
    assert len(pdf) > 20_000


@asynccontextmanager
async def served():
    """Address of the page of `rlml view`, without nodes."""
    html = page_of('Live', viewer_page.parts(), {}, viewer_page.head())
    browsers = Browsers(lambda: {'start': True, 'replace': {}})
    sockets = bind_sockets(0, '127.0.0.1')
    server = HTTPServer(application(html, browsers, '127.0.0.1'))
    server.add_sockets(sockets)
    yield f'http://127.0.0.1:{sockets[0].getsockname()[1]}/', browsers
    server.stop()
    await server.close_all_connections()


@pytest.mark.parametrize('has_truth', [False, True])
def test_live_page_says_nothing_in_the_console(has_truth):
    made = columns.frames(made_run().frames, 0)
    if has_truth:
        made['error'] = made['error_theta'] = np.zeros(len(made['t']))
    message = {'stream': {'frames': columns.as_lists(made)}, 'state': ''}

    async def look():
        async with served() as (url, browsers):
            await asyncio.to_thread(page.open, url)
            while not browsers.open:
                await asyncio.sleep(0.01)
            browsers.send(message)
            await asyncio.to_thread(page.wait_for, 'viewer.messages === 2')
            await asyncio.to_thread(page.settle)
            return list(page.problems)

    with chromium.browser() as page:
        assert not asyncio.run(look())


def test_live_page_takes_messages(tmp_path):
    """The page of `rlml view`, whose messages are put into it by hand: nobody serves it here."""
    frames = columns.frames(made_run().frames, made_run().frames.stamps[0])
    first = {'start': True, 'replace': {'frames': columns.as_lists(frames)}}
    scan = {'t': 60.0, 'x': [100, 0], 'y': [0, 100]}
    more = {c: [v[-1]] for c, v in columns.as_lists(frames).items()} | {'t': [60.0], 'level': [2]}
    html = page_of('Live', viewer_page.parts(), {}, viewer_page.head())
    (tmp_path / 'live.html').write_text(html)
    with chromium.browser() as page:
        page.open((tmp_path / 'live.html').as_uri())
        page.evaluate(f'viewer.take({json.dumps(first)})')
        assert page.evaluate('document.getElementById("slider").value') == '59'
        page.evaluate(f'viewer.take({json.dumps({"stream": {"frames": more}, "scan": scan})})')
        page.settle()
        text = page.evaluate('document.getElementById("now").textContent')
        assert '60.00 s' in text
        assert 'LOST' in text
        assert data(page, 'health', 'name') == ['OK', 'DEGRADED', 'OK', 'LOST']
        assert len(data(page, 'scan', 'x')) == 2
        # nothing is known of a truth: its plots and its layers are hidden
        for layer, is_shown in (('truth', False), ('grid', False), ('scan', True), ('live', True)):
            label = f'document.querySelector("[data-layer={layer}]").parentElement'
            assert (page.evaluate(f'getComputedStyle({label}).display') != 'none') is is_shown
        hidden = 'document.querySelector("[data-needs=\'frames.error\']").hidden'
        assert page.evaluate(hidden)
        page.evaluate('document.getElementById("play").click()')
        page.evaluate(f'viewer.take({json.dumps({"stream": {"frames": more | {"t": [61.0]}}})})')
        assert '60.00 s' in page.evaluate('document.getElementById("now").textContent')
