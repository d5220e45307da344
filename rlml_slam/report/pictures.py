# SPDX-License-Identifier: Apache-2.0
"""Pictures of a run as PNG: map, errors, health and timing."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.transforms import Affine2D

from rlml_slam import se2
from rlml_slam.evaluation.metrics import RunErrors
from rlml_slam.evaluation.run_record import Run
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.se2 import Array
from rlml_slam.types import Level

# one colour per thing, the same in every picture; distinct in grey and for the colour-blind
PATH, LIVE, TRUTH, CLOSURE, REFLECTOR = '#1f5fbf', '#e08a1e', '#3b3b3b', '#2a9d63', '#c2185b'
LEVELS = {Level.OK: '#8fcfa8', Level.DEGRADED: '#f2c14e', Level.LOST: '#d9534f'}
GRID_MAP = LinearSegmentedColormap.from_list('grid', ['#ffffff', '#20242a'])
UNKNOWN_COLOUR = '#e9ebee'
INK, SOFT, FAINT = '#24292f', '#98a1ab', '#d5d9de'
CHI2_95 = 5.991  # of two degrees of freedom: the 95 % ellipse
DPI = 150


def draw(run: Run, errors: RunErrors | None) -> dict[str, bytes]:
    """PNG by name: ``map``, ``health``, ``timing``, and ``errors`` where the truth is known."""
    pictures = {'map': map_picture(run)}
    if errors is not None:
        pictures['errors'] = error_picture(run, errors)
    if run.frames.stamps:
        pictures['health'] = health_picture(run)
    if run.frames.wall_ms:
        pictures['timing'] = timing_picture(run)
    return pictures


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(out, format='png', dpi=DPI, facecolor='white', metadata={'Software': None})
    return out.getvalue()


def dress(axes: Any, x: str = '', y: str = '') -> None:
    """The look that all axes share."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.tick_params(colors=INK, labelsize=8, length=3)
    axes.grid(True, color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
    for side in ('left', 'bottom'):
        axes.spines[side].set_color(FAINT)


def legend_above(axes: Any, **which: Any) -> None:
    """The legend in one line above the axes, at the right: off the data."""
    axes.legend(
        loc='lower right', bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, ncols=3, frameon=False,
        fontsize=8, **which,
    )  # fmt: skip


def map_picture(run: Run) -> bytes:
    """The map with trajectory, reflectors with 95 % ellipses and closures, to scale."""
    xy = run.trajectory.poses[:, :2]
    low, high = _extent(run)
    width, height = high - low
    scale = 9.0 / max(width, height)
    size = (max(4.5, width * scale) + 0.6, max(3.5, height * scale) + 0.9)
    figure = Figure(figsize=size, layout='constrained')
    axes = figure.add_subplot()
    dress(axes, 'x [m]', 'y [m]')
    axes.grid(False)
    if run.grid is not None:
        draw_grid(axes, run.grid)
    handles: list[Any] = []
    if run.truth is not None and run.truth.is_map:
        true = run.truth.trajectory.poses
        handles += axes.plot(
            true[:, 0], true[:, 1], color=TRUTH, linewidth=2.4, alpha=0.35, label='ground truth'
        )
    if run.frames.stamps:
        live = np.array(run.frames.poses)
        handles += axes.plot(
            live[:, 0], live[:, 1], color=LIVE, linewidth=0.8, label='published live'
        )
    handles += axes.plot(xy[:, 0], xy[:, 1], color=PATH, linewidth=1.1, label='optimised')
    if len(run.closures):
        # hundreds of closures must not hide the path
        alpha = float(np.clip(40.0 / len(run.closures), 0.12, 0.9))
        lines = LineCollection(
            list(run.closures), colors=CLOSURE, linewidths=0.7, alpha=alpha, zorder=1
        )
        axes.add_collection(lines)
        label = f'{len(run.closures)} loop closures'
        handles.append(Line2D([], [], color=CLOSURE, linewidth=1.2, label=label))
    if len(run.reflectors):
        handles.append(_draw_reflectors(axes, run))
    if len(xy):
        handles += axes.plot(*xy[0], 'o', color='white', mec=PATH, ms=5, zorder=6, label='start')
    axes.set_aspect('equal')
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    figure.legend(
        handles=handles, loc='outside lower center', ncols=len(handles), frameon=False, fontsize=8
    )
    return png(figure)


def _extent(run: Run) -> tuple[Array, Array]:
    """Corners of the area that anything is known of."""
    points = [run.trajectory.poses[:, :2], run.reflectors.points]
    if run.grid is not None:
        rows, columns = np.nonzero(run.grid.cells >= 0)
        if len(rows):
            sides = [(np.min(v), np.max(v) + 1) for v in (columns, rows)]
            corners = np.array(list(itertools.product(*sides))) * run.grid.resolution
            points.append(se2.transform(run.grid.T_map_grid, corners))
    every = np.concatenate([*points, np.zeros((1, 2))])
    low, high = every.min(axis=0), every.max(axis=0)
    margin = 0.03 * float((high - low).max()) + 0.2
    return low - margin, high + margin


def draw_grid(axes: Any, grid: OccupancyGrid) -> None:
    """The grid below all else, unknown cells in grey."""
    cells = np.ma.masked_less(grid.cells, 0)
    rows, columns = grid.cells.shape
    (x, y), r = grid.origin, grid.resolution
    axes.set_facecolor(UNKNOWN_COLOUR)
    image = axes.imshow(
        cells, cmap=GRID_MAP, vmin=0, vmax=100, origin='lower', interpolation='antialiased',
        extent=(x, x + columns * r, y, y + rows * r), zorder=0,
    )  # fmt: skip
    if grid.yaw:
        image.set_transform(Affine2D().rotate_around(x, y, grid.yaw) + axes.transData)


def _draw_reflectors(axes: Any, run: Run) -> Any:
    """Points with their 95 % ellipses; true positions as rings."""
    r = run.reflectors
    if run.truth is not None and run.truth.is_map and len(run.truth.reflectors):
        axes.plot(*run.truth.reflectors.T, 'o', ms=8, mfc='none', mec=TRUTH, mew=0.8, zorder=4)
    axes.add_collection(
        PatchCollection(
            [ellipse(p, c) for p, c in zip(r.points, r.cov, strict=True)],
            facecolors=REFLECTOR, edgecolors=REFLECTOR, alpha=0.35, zorder=4,
        )
    )  # fmt: skip
    axes.plot(*r.points.T, 'D', color=REFLECTOR, mec='white', mew=0.5, ms=4.5, zorder=5)
    label = f'{len(r)} reflectors, 95 % ellipses'
    return Line2D([], [], color=REFLECTOR, marker='D', linestyle='', ms=4.5, label=label)


def ellipse(point: Array, cov: Array) -> Ellipse:
    """The 95 % ellipse of a position (2,) with covariance (2, 2)."""
    values, vectors = np.linalg.eigh(cov)
    axes = 2.0 * np.sqrt(np.maximum(values, 0.0) * CHI2_95)
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    return Ellipse(tuple(point), axes[1], axes[0], angle=float(angle))


def error_picture(run: Run, errors: RunErrors) -> bytes:
    """Errors over time of the live poses with their 3 sigma bands, and of the optimised ones."""
    start = run.frames.stamps[0]
    live, optimized = errors.live, errors.optimized
    R = np.eye(3)
    R[:2, :2] = se2.rotation(live.T_truth_map[2])
    covs = R @ np.array(run.frames.covs)[live.indices] @ R.T
    sigmas = np.sqrt(np.maximum(np.einsum('nii->ni', covs), 0.0))
    known = 3 if np.isfinite(live.errors[:, 2]).any() else 2
    figure = Figure(figsize=(9.0, 1.9 * known + 0.5), layout='constrained')
    panels = figure.subplots(known, 1, sharex=True, squeeze=False)[:, 0]
    names = (('x error [cm]', 100.0), ('y error [cm]', 100.0), ('heading error [°]', 57.29578))
    for k, axes in enumerate(panels):
        label, unit = names[k]
        dress(axes, 'time [s]' if k == known - 1 else '', label)
        t = (live.stamps - start) * 1e-9
        band = 3.0 * unit * sigmas[:, k]
        axes.fill_between(
            t, -band, band, color=LIVE, alpha=0.18, linewidth=0, label='3σ as published'
        )
        axes.plot(t, unit * live.errors[:, k], color=LIVE, linewidth=0.8, label='published live')
        axes.plot(
            (optimized.stamps - start) * 1e-9, unit * optimized.errors[:, k],
            color=PATH, linewidth=0.8, label='optimised',
        )  # fmt: skip
        axes.axhline(0.0, color=INK, linewidth=0.5)
        # a wide band at a moment of blindness must not hide the errors
        reach = max(np.nanmax(np.abs(live.errors[:, k])) * unit, np.nanpercentile(band, 90))
        axes.set_ylim(-1.15 * reach - 1e-6, 1.15 * reach + 1e-6)
        axes.margins(x=0.005)
    figure.align_ylabels()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=3, frameon=False, fontsize=8)
    return png(figure)


def health_picture(run: Run) -> bytes:
    """Level of health, sigma of the position and detections over time."""
    frames = run.frames
    t = (np.array(frames.stamps) - frames.stamps[0]) * 1e-9
    has_reflectors = any(frames.seen)
    heights = [0.35, 1.5, 1.2] if has_reflectors else [0.35, 1.5]
    figure = Figure(figsize=(9.0, 1.3 * sum(heights) + 0.6), layout='constrained')
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    health_strip(panels[0], t, frames.levels)
    dress(panels[1], '', 'position σ [cm]')
    covs = np.array(frames.covs)
    sigma = 100.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(covs[:, :2, :2])[:, 1], 0.0))
    panels[1].plot(t, sigma, color=LIVE, linewidth=0.9)
    panels[1].set_ylim(0.0, max(1.05 * float(np.max(sigma)), 0.1))
    if has_reflectors:
        dress(panels[2], '', 'reflectors')
        panels[2].plot(t, frames.seen, color=SOFT, linewidth=0.8, label='seen')
        panels[2].plot(t, frames.used, color=REFLECTOR, linewidth=0.8, label='used')
        panels[2].set_ylim(bottom=0)
        legend_above(panels[2])
    panels[-1].set_xlabel('time [s]', color=INK)
    panels[-1].margins(x=0.005)
    figure.align_ylabels()
    return png(figure)


def health_strip(axes: Any, t: Array, levels: Sequence[int]) -> None:
    """A bar over time in the colour of each level."""
    dress(axes)
    axes.grid(False)
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)
    values = np.array(levels)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
    for a, b in itertools.pairwise(edges):
        end = t[b] if b < len(t) else t[-1]
        axes.axvspan(t[a], end, color=LEVELS[Level(int(values[a]))], linewidth=0)
    handles = [
        Line2D([], [], color=colour, linewidth=6, label=f'{level.name} {share:.1%}')
        for level, colour in LEVELS.items()
        if (share := float(np.mean(values == level))) > 0.0
    ]
    legend_above(axes, handles=handles)


def timing_picture(run: Run) -> bytes:
    """Histograms of the time per scan and per keyframe."""
    sets = [('front end, per scan', np.array(run.frames.wall_ms), LIVE)]
    if len(run.back_end_ms):
        sets.append(('back end, per keyframe', run.back_end_ms, PATH))
    figure = Figure(figsize=(9.0, 2.6), layout='constrained')
    panels = figure.subplots(1, len(sets), squeeze=False)[0]
    for axes, (title, ms, colour) in zip(panels, sets, strict=True):
        dress(axes, 'time [ms]', 'count')
        shown = np.maximum(ms, 1e-3)
        low, high = float(shown.min()), float(shown.max())
        bins = np.geomspace(0.95 * low, 1.05 * high + 1e-3, 60)
        axes.hist(shown, bins=bins, color=colour, alpha=0.85)
        axes.set_xscale('log')
        # plain numbers at 1, 2, 5: by default, powers are written over each other
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_formatter('{x:g}')
        axes.set_title(title, fontsize=9, color=INK, loc='left', pad=18)
        for share, style in ((50, '-'), (99, '--')):
            value = float(np.percentile(ms, share))
            name = 'median' if share == 50 else f'p{share}'
            axes.axvline(
                value, color=INK, linewidth=0.9, linestyle=style, label=f'{name} {value:.2f} ms'
            )
        legend_above(axes)
    return png(figure)
