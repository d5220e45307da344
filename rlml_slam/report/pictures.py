# SPDX-License-Identifier: Apache-2.0
"""What pictures of studies, plans and audits share: colours, axes, a grid, ellipses, PNG."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.transforms import Affine2D

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


def png(figure: Figure, compression: int = 6) -> bytes:
    """The figure as a PNG file; less ``compression`` is faster."""
    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(
        out, format='png', dpi=DPI, facecolor='white', metadata={'Software': None},
        pil_kwargs={'compress_level': compression},
    )  # fmt: skip
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


def ellipse(point: Array, cov: Array) -> Ellipse:
    """The 95 % ellipse of a position (2,) with covariance (2, 2)."""
    values, vectors = np.linalg.eigh(cov)
    axes = 2.0 * np.sqrt(np.maximum(values, 0.0) * CHI2_95)
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    return Ellipse(tuple(point), axes[1], axes[0], angle=float(angle))


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
