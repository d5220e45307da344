# SPDX-License-Identifier: Apache-2.0
"""A layout as files: CSV, ``.imk`` of a SICK NAV scanner, and DXF (R12) for who mounts it.

R12 is plain pairs of a group code and a value, which every CAD program reads; a library for three
kinds of entities would be a dependency for 30 lines.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rlml_slam.maps.atomic_file import write_atomically
from rlml_slam.maps.survey import MM, Survey
from rlml_slam.se2 import Array

PRESENT, ADDED, WALLS = 'REFLECTORS', 'REFLECTORS_NEW', 'WALLS'
COLOURS = {PRESENT: '1', ADDED: '30', WALLS: '8'}  # of AutoCAD: red, orange, grey
TEXT = 0.25  # [m] height of a reflector's number


def save(survey: Survey, walls: Array, num_present: int, folder: Path) -> list[Path]:
    """Write layout.csv, layout.imk and layout.dxf, each whole or not at all.

    ``walls`` (s, 4) [m]. Those after the first ``num_present`` are on a layer of their own.
    """
    texts = {
        'layout.csv': csv(survey), 'layout.imk': imk(survey),
        'layout.dxf': dxf(survey, walls, num_present),
    }  # fmt: skip
    for name, text in texts.items():
        write_atomically(folder / name, text.encode('ascii'))
    return [folder / name for name in texts]


def csv(survey: Survey) -> str:
    """Id, place and diameter [m], as :mod:`~rlml_slam.maps.survey` reads them."""
    rows = [f'{k},{x:.4f},{y:.4f},{d:.4f}' for k, x, y, d in _rows(survey)]
    return '\n'.join(['id,x_m,y_m,diameter_m', *rows, ''])


def imk(survey: Survey) -> str:
    """Cylinders (type and subtype 1) of layer 1, in mm."""
    rows = [f'{k} {x / MM:.0f} {y / MM:.0f} 1 1 {d / MM:.0f} 1' for k, x, y, d in _rows(survey)]
    return '\n'.join(['globID x/mm y/mm type subtype size/mm layer1', *rows, ''])


def dxf(survey: Survey, walls: Array, num_present: int) -> str:
    """Reflectors as circles with their numbers, and walls as lines; units are metres."""
    pairs: list[tuple[int, str | float]] = [(0, 'SECTION'), (2, 'TABLES')]
    pairs += [(0, 'TABLE'), (2, 'LTYPE'), (70, '1'), (0, 'LTYPE'), (2, 'CONTINUOUS'), (70, '0'),
              (3, 'Solid line'), (72, '65'), (73, '0'), (40, 0.0), (0, 'ENDTAB')]  # fmt: skip
    pairs += [(0, 'TABLE'), (2, 'LAYER'), (70, str(len(COLOURS)))]
    for layer, colour in COLOURS.items():
        pairs += [(0, 'LAYER'), (2, layer), (70, '0'), (62, colour), (6, 'CONTINUOUS')]
    pairs += [(0, 'ENDTAB'), (0, 'ENDSEC'), (0, 'SECTION'), (2, 'ENTITIES')]
    for x0, y0, x1, y1 in walls.tolist():
        pairs += [(0, 'LINE'), (8, WALLS), (10, x0), (20, y0), (11, x1), (21, y1)]
    for n, (k, x, y, d) in enumerate(_rows(survey)):
        layer = PRESENT if n < num_present else ADDED
        pairs += [(0, 'CIRCLE'), (8, layer), (10, x), (20, y), (40, 0.5 * d)]
        pairs += [(0, 'TEXT'), (8, layer), (10, x + d), (20, y + d), (40, TEXT), (1, str(k))]
    pairs += [(0, 'ENDSEC'), (0, 'EOF')]
    return ''.join(f'{code:3d}\n{v if isinstance(v, str) else f"{v:.4f}"}\n' for code, v in pairs)


def _rows(survey: Survey) -> Iterable[tuple[int, float, float, float]]:
    ids, points, diameters = (part.tolist() for part in survey)
    return [(k, x, y, d) for k, (x, y), d in zip(ids, points, diameters, strict=True)]
