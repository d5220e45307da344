# SPDX-License-Identifier: Apache-2.0
"""The figures of the viewer: a map, and plots over one time axis, by Bokeh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    PanTool,
    Range1d,
    ResetTool,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure

from rlml_slam.report.viewer.columns import SOURCES, Columns, extent
from rlml_slam.types import Level

# one colour per thing, the same in every figure; distinct in grey and for the colour-blind, and
# on light and dark paper
PATH, LIVE, TRUTH, CLOSURE, REFLECTOR = '#2f73d6', '#e08a1e', '#808b99', '#2a9d63', '#d02c72'
SCAN = '#12a5a5'
LEVELS = {Level.OK: '#6fbf8f', Level.DEGRADED: '#e9b53f', Level.LOST: '#d9534f'}
TEXT, FAINT = '#808b99', '#808b9933'
HEIGHT = 170  # pixels of a plot


@dataclass(frozen=True)
class Series:
    """One line of a plot: a column of a source, its name for the legend, and its look."""

    column: str
    name: str
    colour: str
    source: str = 'frames'
    dash: str = 'solid'
    is_step: bool = False


@dataclass(frozen=True)
class Plot:
    """One plot over time: title, explanation, unit and lines."""

    key: str
    title: str
    what: str
    unit: str
    series: tuple[Series, ...]

    @property
    def main(self) -> Series:
        """The line that the plot is about: the last one of the frames."""
        return next(s for s in reversed(self.series) if s.source == 'frames')


PLOTS = (
    Plot(
        'error', 'Position error',
        'Distance from the ground truth. The published 3σ (along its worst direction) should lie '
        'above the live error nearly always.',
        'cm',
        (
            Series('bound', '3σ as published', TRUTH, dash='dashed'),
            Series('error', 'published live', LIVE),
            Series('error', 'optimised', PATH, 'path_error'),
        ),
    ),
    Plot(
        'heading', 'Heading error',
        'Heading minus that of the ground truth.',
        '°',
        (
            Series('bound_theta', '3σ as published', TRUTH, dash='dashed'),
            Series('error_theta', 'published live', LIVE),
            Series('error_theta', 'optimised', PATH, 'path_error'),
        ),
    ),
    Plot(
        'sigma', 'Uncertainty of the position',
        'Standard deviation of the published position along its worst direction.',
        'cm',
        (Series('sigma', 'σ', LIVE),),
    ),
    Plot(
        'reflectors', 'Reflectors in each scan',
        'Detections, and how many of them were associated and used. A gap between both is '
        'reflectors that are new, moved or false.',
        '',
        (
            Series('seen', 'seen', TRUTH, is_step=True),
            Series('used', 'used', REFLECTOR, is_step=True),
        ),
    ),
    Plot(
        'time', 'Time per scan',
        'Time that the front end computed for each scan. It has to stay below the time between '
        'two scans.',
        'ms',
        (Series('ms', 'front end', LIVE),),
    ),
)  # fmt: skip
HEALTH_WHAT = (
    'OK, DEGRADED (the pose is usable, but less is known than usual) or LOST (do not drive by '
    'it). Hover for the reasons.'
)
MAP_WHAT = (
    'Drag to move, turn the wheel or pinch to zoom. The arrow is the robot as published at the '
    'cursor, with its scan. A click on a path moves the cursor there.'
)
# layers of the map: name, what it is called, colour, whether it is shown at first
LAYERS = (
    ('grid', 'grid', '#667180', True),
    ('truth', 'ground truth', TRUTH, True),
    ('live', 'published live', LIVE, True),
    ('path', 'optimised', PATH, True),
    ('closures', 'loop closures', CLOSURE, True),
    ('keyframes', 'keyframes', PATH, False),
    ('true_reflectors', 'true reflectors', TRUTH, True),
    ('reflectors', 'reflectors, 95 % ellipses', REFLECTOR, True),
    ('scan', 'scan at the cursor', SCAN, True),
)
NEEDS = {'live': 'frames', 'scan': 'scans'}  # source of a layer that has another name


def sources(of: Mapping[str, Columns]) -> dict[str, ColumnDataSource]:
    """One source by name of each set of columns, and those that follow the cursor."""
    made = {name: ColumnDataSource(dict(of[name]), name=name) for name in SOURCES}
    for name in ('scan', 'robot', 'heading'):
        made[name] = ColumnDataSource({'x': [], 'y': []}, name=name)
    made['ellipses'] = ColumnDataSource(
        {k: list(of['reflectors'][k]) for k in ('x', 'y', 'width', 'height', 'angle')},
        name='ellipses',
    )
    return made


def map_figure(of: Mapping[str, Columns], by: Mapping[str, ColumnDataSource]) -> Any:
    """The map, to scale; each layer is a renderer, or several, of the layer's name."""
    low, high = extent(of)
    pan, wheel = PanTool(), WheelZoomTool()
    f = figure(
        name='map', sizing_mode='stretch_both', min_height=300,
        x_range=Range1d(low[0], high[0]), y_range=Range1d(low[1], high[1]),
        x_axis_label='x [m]', y_axis_label='y [m]', tools=[pan, wheel, BoxZoomTool(
            match_aspect=True), ResetTool()], active_drag=pan, active_scroll=wheel,
        output_backend='canvas',
    )  # fmt: skip
    f.tags = list(by.values())  # where the page finds all, also those that no figure draws
    _dress(f)
    f.grid.grid_line_color = None
    f.image_url(
        url='light', x='x', y='y', w='width', h='height', angle='angle', anchor='center',
        source=by['grid'], name='grid',
    )  # fmt: skip
    truth = f.line('x', 'y', source=by['truth'], color=TRUTH, line_width=4, alpha=0.45,
                   name='truth')  # fmt: skip
    alpha = min(max(40.0 / max(len(of['closures']['xs']), 1), 0.15), 0.9)
    f.multi_line('xs', 'ys', source=by['closures'], color=CLOSURE, alpha=alpha, name='closures')
    live = f.line('x', 'y', source=by['frames'], color=LIVE, line_width=1.5, name='live')
    path = f.line('x', 'y', source=by['path'], color=PATH, line_width=1.7, name='path')
    f.scatter('x', 'y', source=by['keyframes'], color=PATH, size=5, name='keyframes')
    f.scatter('x', 'y', source=by['scan'], color=SCAN, size=2.6, name='scan')
    known = f.scatter('x', 'y', source=by['true_reflectors'], fill_alpha=0, line_color=TRUTH,
                      size=13, name='true_reflectors')  # fmt: skip
    f.ellipse('x', 'y', width='width', height='height', angle='angle', source=by['ellipses'],
              color=REFLECTOR, fill_alpha=0.25, name='reflectors')  # fmt: skip
    mapped = f.scatter('x', 'y', source=by['reflectors'], marker='diamond', color=REFLECTOR,
                       size=9, line_color='white', line_width=0.7, name='reflectors')  # fmt: skip
    f.patch('x', 'y', source=by['robot'], fill_color=LIVE, line_color='white', line_width=1.2,
            name='robot')  # fmt: skip
    pose = [('time', '@t{0.00} s'), ('x, y', '@x{0.000} m, @y{0.000} m')]
    for renderers, tips in (
        ([live], [('published live', '@t{0.00} s'), pose[1], ('heading', '@theta{0.00}°'),
                  ('σ', '@sigma{0.00} cm')]),
        ([path], [('optimised', '@t{0.00} s'), pose[1]]),
        ([truth], [('ground truth', '@t{0.00} s'), pose[1]]),
        ([mapped], [('reflector', '@name'), pose[1], ('largest σ', '@sigma{0.00} cm'),
                    ('sightings', '@sightings')]),
        ([known], [('true reflector', '@name'), pose[1]]),
    ):  # fmt: skip
        f.add_tools(
            HoverTool(renderers=renderers, tooltips=tips, line_policy='nearest', visible=False)
        )
    return f


def plot(of: Plot, by: Mapping[str, ColumnDataSource], x_range: Any) -> Any:
    """One plot over time."""
    zoom = BoxZoomTool(dimensions='width')
    f = figure(
        name=of.key, height=HEIGHT, sizing_mode='stretch_width', x_range=x_range,
        y_range=DataRange1d(range_padding=0.08), y_axis_label=of.unit or None,
        tools=[zoom, PanTool(dimensions='width'), ResetTool()], active_drag=zoom,
    )  # fmt: skip
    _dress(f)
    if not len(by['frames'].data['t']):  # a range of nothing is an error in the console
        f.scatter(x=[0.0], y=[0.0], alpha=0.0, name='zero')
    lines = {}
    for s in of.series:
        draw = f.step if s.is_step else f.line
        more = {'mode': 'center'} if s.is_step else {}
        lines[s] = draw('t', s.column, source=by[s.source], color=s.colour, line_width=1.5,
                        line_dash=s.dash, name=f'{of.key} {s.name}', **more)  # fmt: skip
    value = f'{{0.000}} {of.unit}' if of.unit else '{0}'
    tips = [(s.name, f'@{s.column}{value}') for s in of.series if s.source == 'frames']
    f.add_tools(
        HoverTool(renderers=[lines[of.main]], mode='vline', visible=False,
                  tooltips=[('time', '@t{0.00} s'), *tips])
    )  # fmt: skip
    _cursor(f)
    return f


def health_strip(by: Mapping[str, ColumnDataSource], x_range: Any) -> Any:
    """A bar over time in the colour of each level."""
    source = by['health']
    source.data['colour'] = [LEVELS[Level(v)] for v in source.data['level']]
    f = figure(
        name='health', height=82, sizing_mode='stretch_width', x_range=x_range,
        y_range=Range1d(0.0, 1.0), tools=[ResetTool()], x_axis_label='time [s]',
    )  # fmt: skip
    _dress(f)
    f.yaxis.visible = False
    f.grid.grid_line_color = None
    bars = f.quad(left='left', right='right', bottom=0.0, top=1.0, color='colour', source=source)
    tips = [('health', '@name'), ('from', '@left{0.00} s'), ('to', '@right{0.00} s'),
            ('reasons', '@reason')]  # fmt: skip
    f.add_tools(HoverTool(renderers=[bars], tooltips=tips, visible=False))
    _cursor(f)
    return f


def _cursor(f: Any) -> None:
    """The line at the time of the cursor, which the page moves."""
    f.add_layout(Span(location=0.0, dimension='height', line_color=PATH, line_width=1.2,
                      line_alpha=0.9, tags=['cursor']))  # fmt: skip


def _dress(f: Any) -> None:
    """The look that all figures share, on light and on dark paper."""
    f.background_fill_color = f.border_fill_color = f.outline_line_color = None
    f.toolbar.logo = None
    f.toolbar.autohide = True
    f.toolbar_location = 'right'
    f.axis.axis_line_color = f.axis.major_tick_line_color = FAINT
    f.axis.minor_tick_line_color = None
    f.axis.major_label_text_color = f.axis.axis_label_text_color = TEXT
    f.axis.axis_label_text_font_style = 'normal'
    f.axis.major_label_text_font = f.axis.axis_label_text_font = 'system-ui, sans-serif'
    f.axis.major_label_text_font_size = f.axis.axis_label_text_font_size = '12px'
    f.grid.grid_line_color = FAINT
    f.min_border_left = 76  # so that the time axes of all plots are below each other
    f.min_border_top = 10
