# SPDX-License-Identifier: Apache-2.0
"""The files of a plan: plan.json, maps as PNG, and a page in the style of the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rlml_slam.maps import survey_writer
from rlml_slam.maps.atomic_file import set_aside, write_atomically
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.maps.survey import Survey
from rlml_slam.planning import site_file
from rlml_slam.planning.plan import Plan, figures, scan_sigma
from rlml_slam.planning.suggest import Suggestion
from rlml_slam.report.outputs import make_folder, write_json
from rlml_slam.report.page import headed_table, heading, page, picture, section
from rlml_slam.report.pictures import LIVE, REFLECTOR, draw_grid, dress, png
from rlml_slam.report.viewer.columns import coarser
from rlml_slam.se2 import Array
from rlml_slam.simulation.world import Geometry

PIXELS = 700  # of a side of the grid that is drawn
MANY = 20_000  # places from which they are drawn as an image
NEIGHBOURS = 2_000  # places by which their spacing is known
FAST = 2  # compression of pictures
SIDES = 24  # of a pillar in a drawing
MARGINS = (0.6, 1.2, 0.5, 0.15)  # [inch] left, right, below, above
LABELS = {'view': 'reflectors', 'unique': 'unique'}
LOWEST = 1.0  # [inch] a picture, even of a corridor
LEGEND = 'White line: the goal. Red: not held.'
SUGGESTED = (
    'In the pictures, suggested reflectors are orange. Shares of this table are of the places at '
    'which mounts were compared; those of all places may differ by tenths of a percent.'
)
CAPTIONS = {
    'view': 'Reflectors in view',
    'reflectors': 'Position sigma of one scan, by reflectors alone',
    'scan': 'Position sigma of one scan, by the scan alone',
    'both': 'Position sigma of one scan, by reflectors and scan',
    'driving': 'Position sigma while driving',
    'one_hidden': 'Position sigma while driving with the worst reflector hidden',
    'two_hidden': 'Position sigma while driving with the worst two reflectors hidden',
    'unique': 'Where reflectors alone find a lost robot (1: one pose fits)',
}


def write_plan(
    plan: Plan, name: str, folder: Path, suggestion: Suggestion | None = None
) -> dict[str, Any]:
    """Write plan.json, site, pictures and plan.html, each whole or not at all; the figures.

    With a suggestion, whose mounts are the plan's last reflectors, the layout as well.
    """
    folder, found = make_folder(folder), figures(plan)
    added = 0
    set_aside(*(folder / f'layout.{kind}' for kind in ('csv', 'imk', 'dxf')))
    if suggestion is not None:
        r, added = plan.site.reflectors, len(suggestion.mounts)
        found['suggested'] = _suggested(suggestion, r.ids[len(r) - added :].tolist())
        layout = Survey(r.ids, r.points, r.widths)
        survey_writer.save(layout, outlines(plan.site.walls), len(r) - added, folder)
    grid, raster = _coarse(plan.site.grid), _Raster.of(plan.places)
    pictures = {k: _map(plan, k, v, added, grid, raster) for k, v in _values(plan).items()}
    for key, image in pictures.items():
        write_atomically(folder / f'{key}.png', image)
    site_file.save(plan.site, folder)
    write_json(folder / 'plan.json', found)
    write_atomically(folder / 'plan.html', _page(name, found, pictures).encode())
    return found


def _values(plan: Plan) -> dict[str, Array]:
    hidden = plan.driving.hidden
    return {
        'view': plan.in_view.astype(np.float64), 'driving': plan.driving.position,
        'reflectors': plan.reflectors.position, 'scan': scan_sigma(plan),
        'both': plan.both.position,
        'one_hidden': hidden[:, 0], 'two_hidden': hidden[:, 1],
        'unique': plan.is_unique.astype(np.float64),
    }  # fmt: skip


def _suggested(suggestion: Suggestion, ids: list[int]) -> dict[str, Any]:
    """What each mount brings to the places that were compared, in this order."""
    steps = [{'goal_share': s.goal_share, 'sigma_m': s.sigma if np.isfinite(s.sigma) else None,
              'unique_share': s.unique_share} for s in suggestion.steps]  # fmt: skip
    mounts = [{'id': k, 'x_m': x, 'y_m': y, **step} for k, (x, y), step
              in zip(ids, suggestion.mounts.tolist(), steps[1:], strict=True)]  # fmt: skip
    return {'before': steps[0], 'mounts': mounts, 'at_least': suggestion.at_least,
            'is_complete': suggestion.is_complete, 'is_fewest': suggestion.is_fewest}  # fmt: skip


def suggestion_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """A row per suggested reflector, with what is reached with it and those before."""
    rows: list[tuple[str, ...]] = [('add', 'x [m]', 'y [m]', 'goal', 'worst [cm]', 'unique')]
    for row in [found['suggested']['before'], *found['suggested']['mounts']]:
        place = [f'{row[k]:.2f}' if k in row else '' for k in ('x_m', 'y_m')]
        unique = '' if row['unique_share'] is None else f'{row["unique_share"]:.1%}'
        rows.append((str(row.get('id', 'none')), *place, f'{row["goal_share"]:.1%}',
                     cm(row['sigma_m']), unique))  # fmt: skip
    return rows


def suggestion_notes(found: Mapping[str, Any]) -> list[str]:
    """Whether the fewest are known, and whether the goal can be reached at all."""
    s = found['suggested']
    if not s['is_fewest']:
        return []
    if s['at_least'] is None:
        return ['no more reflectors at the places that were tried reach it']
    count = len(s['mounts'])
    if s['at_least'] >= count:
        return [f'no fewer than {count} reach the goal']
    least = f'; fewer than {s["at_least"]} do not' if s['at_least'] else ''
    return [f'{count} reach the goal{least}']


def outlines(walls: Geometry) -> Array:
    """Walls and pillars as lines (s, 4)."""
    turn = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    around = np.stack([np.cos(turn), np.sin(turn)], -1)
    x, y, radius = walls.discs[:, :3].T[..., None, None]
    corners = np.concatenate([x, y], -1) + radius * around
    lines = np.concatenate([corners[:, :-1], corners[:, 1:]], -1).reshape(-1, 4)
    return np.concatenate([walls.segments[:, :4], lines])


@dataclass(frozen=True)
class _Raster:
    """Many places as the pixels ``cell`` (n, 2) of an image with the ``extent`` of its sides."""

    cell: NDArray[np.int64]
    extent: tuple[float, float, float, float]

    @staticmethod
    def of(places: Array) -> _Raster:
        gap = cKDTree(places).query(places[:NEIGHBOURS], k=min(2, len(places)))[0]
        side, low = float(np.median(gap.reshape(len(gap), -1)[:, -1])) or 1.0, places.min(axis=0)
        cell = np.rint((places - low) / side).astype(np.int64)
        corner = low - 0.5 * side
        far = corner + side * (cell.max(axis=0) + 1)
        return _Raster(cell, (corner[0], far[0], corner[1], far[1]))

    def image(self, values: Array) -> Any:
        """Values (n,), open ones masked, -1 where there is no place."""
        wide, high = self.cell.max(axis=0) + 1
        image = np.full((high, wide), -1.0)
        image[self.cell[:, 1], self.cell[:, 0]] = values
        return np.ma.masked_invalid(image)


def _map(
    plan: Plan, key: str, values: Array, added: int, grid: OccupancyGrid, raster: _Raster
) -> bytes:
    """The places, coloured by a value; sigmas in cm up to three goals. The ``added`` in orange."""
    places = plan.places[plan.sampled] if key == 'unique' else plan.places
    low, high = plan.places.min(axis=0) - 1.5, plan.places.max(axis=0) + 1.5
    width, height = high - low
    scale = min(8.0 / width, 9.0 / height)  # inch per metre
    more = np.maximum(LOWEST / scale - (high - low), 0.0)
    low, high = low - 0.5 * more, high + 0.5 * more
    width, height = high - low
    size = (width * scale + sum(MARGINS[:2]), height * scale + sum(MARGINS[2:]))
    figure = Figure(figsize=size)
    axes = figure.add_axes((MARGINS[0] / size[0], MARGINS[2] / size[1],
                            width * scale / size[0], height * scale / size[1]))  # fmt: skip
    dress(axes, 'x [m]', 'y [m]')
    axes.grid(False)
    draw_grid(axes, grid)
    is_sigma = key not in ('view', 'unique')
    colours = colormaps['viridis_r' if is_sigma else 'viridis'].with_extremes(
        bad='#d9534f', under=(0.0, 0.0, 0.0, 0.0)
    )
    most = 300.0 * plan.goal.sigma if is_sigma else max(float(values.max()), 1.0)
    limits: Any = {'cmap': colours, 'vmin': 0.0, 'vmax': most, 'zorder': 2}
    values = 100.0 * values if is_sigma else values
    if len(places) > MANY:
        drawn: Any = axes.imshow(
            raster.image(values), origin='lower', extent=raster.extent, interpolation='nearest',
            **limits,
        )  # fmt: skip
    else:
        # the side of a marker in points, so that markers of neighbours touch
        side = 72.0 * scale * np.sqrt(width * height / len(places))
        limits |= {'s': min(side, 12.0) ** 2, 'marker': 's', 'linewidths': 0.0}
        drawn = axes.scatter(places[:, 0], places[:, 1], c=values, plotnonfinite=True, **limits)
    points = plan.site.reflectors.points
    for part, colour in ((points[: len(points) - added], REFLECTOR),
                         (points[len(points) - added :], LIVE)):  # fmt: skip
        axes.plot(*part.T, 'D', color=colour, mec='white', ms=6, zorder=3)
    axes.set(aspect='equal', xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    beside = axes.inset_axes((1.0 + 0.2 / (width * scale), 0.0, 0.2 / (width * scale), 1.0))
    bar = figure.colorbar(
        drawn, cax=beside, label=LABELS.get(key, 'sigma [cm]'),
        extend='max' if is_sigma else 'neither',
    )  # fmt: skip
    if is_sigma:
        bar.ax.axhline(100.0 * plan.goal.sigma, color='white', linewidth=2.0)
    return png(figure, FAST)


def _coarse(grid: OccupancyGrid) -> OccupancyGrid:
    """A grid of at most PIXELS cells a side: faster to draw."""
    cells, k = coarser(grid.cells, PIXELS)
    return replace(grid, resolution=grid.resolution * k, cells=cells)


def cm(value: float | None) -> str:
    """A sigma for people."""
    return 'open' if value is None else f'{100.0 * value:.2f}'


HEADER = ('area', 'in view', 'reflectors [cm]', 'scan [cm]', 'both [cm]', 'driving [cm]',
          'one hidden [cm]', 'two hidden [cm]', 'goal', 'unique')  # fmt: skip

SIGMAS = ('reflectors', 'scan', 'both', 'driving', 'one_hidden', 'two_hidden')


def table_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The table: the whole, then each area; largest sigmas."""
    rows: list[tuple[str, ...]] = [HEADER]
    for row in [{'area': 'all', **found}, *found['areas']]:
        sigmas = [cm(row[f'{k}_sigma_m']['max']) for k in SIGMAS]
        unique = '' if row['unique_share'] is None else f'{row["unique_share"]:.0%}'
        view = f'{row["in_view_min"]} to {row["in_view_median"]:g}'
        rows.append((row['area'], view, *sigmas, f'{row["goal_share"]:.1%}', unique))
    return rows


def _page(name: str, found: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    goal, share = 100.0 * found['goal_m'], found['goal_share']
    parts = [
        heading(
            f'Layout of {name}',
            f'{found["reflectors"]} reflectors, {found["places"]} places; {goal:g} cm reached at '
            f'{share:.1%}',
        )
    ]
    if found['notes']:
        parts.append(section('Notes', _paragraphs(found['notes']), 'problem'))
    if 'suggested' in found:
        notes = _paragraphs([*suggestion_notes(found), SUGGESTED])
        parts.append(section('Suggested reflectors', headed_table(suggestion_rows(found)) + notes))
    for key, image in pictures.items():
        legend = '' if key in LABELS else f'<p class="sub">{LEGEND}</p>'
        parts.append(section(CAPTIONS[key], legend + picture(image, CAPTIONS[key])))
    title = f'Areas of {found["area_size_m"]:g} m, largest sigmas'
    parts.append(section(title, headed_table(table_rows(found))))
    return page(f'Layout of {name}', parts)


def _paragraphs(lines: Iterable[str]) -> str:
    return ''.join(f'<p>{escape(line)}</p>' for line in lines)
