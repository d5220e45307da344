# SPDX-License-Identifier: Apache-2.0
"""The site of a plan as a file beside plan.json, so that an audit needs neither map nor layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.errors import FileFormatError
from rlml_slam.maps import map_container
from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.maps.map_container import Content
from rlml_slam.maps.occupancy import OccupancyGrid
from rlml_slam.planning.site import Site
from rlml_slam.simulation.world import Geometry, ReflectorSet

NAME = 'site.rlml'
SHAPES = {
    'segments': 's 6', 'discs': 'd 5', 'surface': 'o 4', 'points': 'm 2', 'widths': 'm',
    'normals': 'm', 'ids': 'm', 'cov': 'm 2 2', 'cells': 'r c', 'frame': '5',
}  # fmt: skip


def save(site: Site, folder: Path) -> None:
    """Write it into the folder of the plan."""
    g, frame = site.grid, [site.grid.resolution, *site.grid.origin, site.grid.yaw, site.oriented]
    arrays = vars(site.walls) | vars(site.reflectors) | {'cov': site.cov, 'cells': g.cells}
    content = Content(arrays | {'frame': np.array(frame, dtype=np.float64)}, {})
    write_atomically(folder / NAME, *map_container.pack(content))


def read_plan(folder: Path) -> tuple[Site, dict[str, Any]]:
    """The site and the figures of a plan. Raises MapError or FileFormatError if not there."""
    a = map_container.read(folder / NAME).arrays
    map_container.require(folder / NAME, a, SHAPES)
    try:
        plan = json.loads((folder / 'plan.json').read_text(encoding='utf-8'))
        areas = [(str(r['area']), float(r['x_m']), float(r['y_m'])) for r in plan['areas']]
        if not areas or not float(plan['area_size_m']) > 0.0:
            raise ValueError('no areas')
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise FileFormatError(f'{folder / "plan.json"}: not that of a plan: {e}') from e
    finite = [n for n in SHAPES if n != 'normals']  # NaN: a cylinder
    is_whole = len(a['surface']) == len(a['segments']) + len(a['discs']) and a['frame'][0] > 0.0
    if not is_whole or not all(np.isfinite(a[n]).all() for n in finite):
        raise FileFormatError(f'{folder / NAME}: not as a plan writes it')
    resolution, x, y, yaw, oriented = a['frame'].tolist()
    grid = OccupancyGrid(resolution, (x, y), a['cells'].astype(np.int8), yaw)
    walls = Geometry(a['segments'], a['discs'], a['surface'])
    reflectors = ReflectorSet(a['points'], a['widths'], a['normals'], a['ids'])
    return Site(walls, reflectors, a['cov'], grid, bool(oriented)), plan
