# SPDX-License-Identifier: Apache-2.0
"""The viewer as HTML: what goes into the head of a page, and its sections."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.embed import components
from bokeh.models import Range1d
from bokeh.resources import Resources

from rlml_slam.report.page import section
from rlml_slam.report.viewer import figures
from rlml_slam.report.viewer.columns import SOURCES, Columns, empty
from rlml_slam.report.viewer.figures import HEALTH_WHAT, LAYERS, LEVELS, MAP_WHAT, NEEDS, PLOTS

HERE = Path(__file__).parent


def head() -> str:
    """Style of the viewer, and Bokeh, inside the page: nothing is loaded."""
    style = (HERE / 'viewer.css').read_text(encoding='utf-8')
    return f'<style>{style}</style>{Resources(mode="inline", components=["bokeh"]).render_js()}'


def parts(of: Mapping[str, Columns] | None = None) -> list[str]:
    """Sections: map with layers, plots, and the bar of time. Without columns, a live page's."""
    is_live, columns = of is None, empty() if of is None else of
    by = figures.sources(columns)
    t = columns['frames']['t']
    x_range: Any = Range1d(0.0, float(t[-1]) if len(t) and t[-1] > 0.0 else 1.0, bounds=None)
    shown = [p for p in PLOTS if is_live or _has_numbers(columns, p)]
    drawn = {'map': figures.map_figure(columns, by)}
    drawn |= {p.key: figures.plot(p, by, x_range) for p in shown}
    drawn['health'] = figures.health_strip(by, x_range)
    script, divs = components(drawn)
    live = ' data-live="1"' if is_live else ''
    state = '<p id="state">Waiting for the nodes.</p>' if is_live else ''
    boxes = [_plot(p, divs[p.key]) for p in shown]
    levels = ''.join(_key(level.name, colour) for level, colour in LEVELS.items())
    boxes.append(
        f'<div><h2>Health</h2><p class="what">{escape(HEALTH_WHAT)}</p>'
        f'<div class="legend">{levels}</div>{divs["health"]}</div>'
    )
    return [
        section(
            'Map',
            f'{state}<div class="viewer" id="viewer"{live}><div class="map">{divs["map"]}</div>'
            f'<div class="layers">{_layers()}</div></div>',
            what=MAP_WHAT,
        ),
        f'<section><div class="plots">{"".join(boxes)}</div></section>',
        _time_bar(),
        script,
        f'<script>{(HERE / "viewer.js").read_text(encoding="utf-8")}</script>',
    ]


def _has_numbers(columns: Mapping[str, Columns], plot: figures.Plot) -> bool:
    """Whether the plot's own column has any number."""
    values = np.asarray(columns['frames'][plot.main.column], dtype=np.float64)
    return bool(np.isfinite(values).any())


def _plot(of: figures.Plot, div: str) -> str:
    legend = ''.join(_key(s.name, s.colour, s.dash != 'solid') for s in of.series)
    return (
        f'<div data-needs="frames.{of.main.column}"><h2>{escape(of.title)}</h2>'
        f'<p class="what">{escape(of.what)}</p><div class="legend">{legend}</div>{div}</div>'
    )


def _key(name: str, colour: str, is_dashed: bool = False) -> str:
    kind = ' class="dash"' if is_dashed else ''
    return f'<span><i{kind} style="--c:{colour}"></i>{escape(name)}</span>'


def _layers() -> str:
    rows = [
        f'<label data-needs="{(source := NEEDS.get(name, name))}.{SOURCES[source][0]}">'
        f'<input type="checkbox" data-layer="{name}"{" checked" if is_shown else ""}>'
        f'<i style="--c:{colour}"></i>{escape(title)}</label>'
        for name, title, colour, is_shown in LAYERS
    ]
    return (
        ''.join(rows) + '<label class="size" data-needs="reflectors.x">ellipses enlarged '
        '<output id="times">1</output>×<input id="size" type="range" min="0" max="5" value="0" '
        'aria-label="how much the ellipses are enlarged"></label>'
    )


def _time_bar() -> str:
    return (
        '<div class="time"><button id="play">Play</button><input id="slider" type="range" min="0" '
        'max="0" value="0" aria-label="time"><div class="now" id="now"></div></div>'
    )
