# SPDX-License-Identifier: Apache-2.0
"""Maps of nav2 as other programs write them: the walls of a simulated world, drawn ten ways."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from rlml_slam import se2
from rlml_slam.simulation.world import World

STEP = 0.01  # [m] between the points of a wall that are drawn
# name of the image: resolution, yaw of the origin, what differs in the description, kind of pixels
VARIANTS = {
    'plain.pgm': (0.05, 0.0, {}, 'L'),
    'negated.pgm': (0.05, 0.0, {'negate': 1}, 'L'),
    'bitmap.bmp': (0.05, 0.0, {'negate': False}, 'RGB'),
    'scale.png': (0.05, 0.0, {'mode': 'scale'}, 'LA'),
    'scale_negated.png': (0.05, 0.0, {'mode': 'scale', 'negate': True}, 'RGBA'),
    'raw.pgm': (0.05, 0.0, {'mode': 'raw'}, 'L'),
    'turned.png': (0.05, 0.7, {}, 'L'),
    'turned_back.bmp': (0.04, -2.5, {'negate': 1}, 'L'),
    'edited.png': (0.05, 0.0, {'occupied_thresh': 0.5, 'free_thresh': 0.3}, 'P'),
    'fine.png': (0.025, 1.6, {'mode': 'trinary'}, 'RGBA'),
}


def wall_points(world: World) -> np.ndarray:
    """Points (n, 2) on all that stands, world frame, STEP apart."""
    g = world.without_movers().geometry(0.0)
    out = []
    for x0, y0, x1, y1 in g.segments[:, :4]:
        n = max(2, int(np.hypot(x1 - x0, y1 - y0) / STEP))
        out.append(np.linspace((x0, y0), (x1, y1), n))
    for x, y, r in g.discs[:, :3]:
        a = np.linspace(0.0, 2.0 * np.pi, 60)
        out.append(np.stack([x + r * np.cos(a), y + r * np.sin(a)], -1))
    return np.concatenate(out)


def write(folder: Path, name: str, points: np.ndarray) -> Path:
    """Draw the walls (n, 2), map frame, as one of the variants; the path of its description."""
    resolution, yaw, changed, kind = VARIANTS[name]
    rest = np.array([0.013, -0.017])  # the origins of others are no multiples of the resolution
    turned = se2.transform(np.array([0.0, 0.0, -yaw]), points)
    low = turned.min(axis=0) - 0.5 + rest
    cells = np.floor((turned - low) / resolution).astype(int)
    occupied = np.zeros(cells.max(axis=0)[::-1] + int(0.5 / resolution), dtype=bool)
    occupied[cells[:, 1], cells[:, 0]] = True
    unknown = np.zeros_like(occupied)
    unknown[: int(0.3 / resolution)] = True
    meta = {
        'image': name, 'resolution': resolution, 'negate': 0,
        'origin': [*se2.transform(np.array([0.0, 0.0, yaw]), low[None])[0].tolist(), yaw],
        'occupied_thresh': 0.65, 'free_thresh': 0.196,
    } | changed  # fmt: skip
    shades = [0, 254, 150] if meta.get('mode') != 'raw' else [100, 0, 255]
    if meta['negate']:
        shades = [255 - shades[0], 255 - shades[1], 255 - shades[2]]
    image = np.full(occupied.shape, shades[1], dtype=np.uint8)
    image[occupied] = shades[0]
    image[unknown] = shades[2]
    picture = Image.fromarray(image[::-1]).convert(kind)
    if meta.get('mode') == 'scale':  # nothing is known where it is transparent
        picture.putalpha(Image.fromarray(np.where(unknown, 0, 255).astype(np.uint8)[::-1]))
    picture.save(folder / name)
    path = (folder / name).with_suffix('.yaml')
    path.write_text(yaml.safe_dump(meta))
    return path
