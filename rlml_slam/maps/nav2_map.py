# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids as maps of nav2: a description (YAML) and an image.

Cells are those that nav2's map_server makes of the same files. With the shade s of a pixel in
0 .. 1, black to white (the mean of red, green and blue; in trinary mode of an image with
transparency, of these and the opacity), and p = s where ``negate``, else 1 - s:

    trinary    100 where p > occupied_thresh, 0 where p < free_thresh, else -1
    scale      the same, but 100 (p - free) / (occupied - free) in between, -1 if not opaque
    raw        255 s where that is at most 100, else -1
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rlml_slam.errors import FileFormatError, MapError
from rlml_slam.maps.atomic_file import set_aside, write_atomically
from rlml_slam.maps.occupancy import UNKNOWN, OccupancyGrid
from rlml_slam.plain_yaml import parse_yaml

if TYPE_CHECKING:
    from PIL import Image

OCCUPIED_THRESH = 0.65
FREE_THRESH = 0.196  # below the 50/255 of an unknown pixel, which 0.25 would read as free
PGM_OCCUPIED, PGM_UNKNOWN, PGM_FREE = 0, 205, 254
MODES = ('trinary', 'scale', 'raw')
FORMATS = ('PPM', 'PNG', 'BMP', 'JPEG')  # PPM is PGM, too
MAX_DESCRIPTION = 1 << 16  # bytes: a description has ten lines


@dataclass(frozen=True)
class Description:
    """The YAML file; ``origin`` (x, y, yaw) [m, m, rad] is the pose of the lower left corner."""

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    occupied_thresh: float
    free_thresh: float
    negate: bool = False
    mode: str = 'trinary'


def save(grid: OccupancyGrid, path: str | Path) -> tuple[Path, Path]:
    """Write ``path``.pgm and ``path``.yaml, trinary; the two paths.

    Each file appears whole or not at all. A cell of 65 or more is occupied, of 19 or less free.
    Raises MapError if the folder cannot be written.
    """
    base = Path(path)
    pgm, meta = base.with_name(base.name + '.pgm'), base.with_name(base.name + '.yaml')
    image = np.full(grid.cells.shape, PGM_UNKNOWN, dtype=np.uint8)
    image[(grid.cells >= 0) & (grid.cells <= 100 * FREE_THRESH)] = PGM_FREE
    image[grid.cells >= 100 * OCCUPIED_THRESH] = PGM_OCCUPIED
    rows = len(image)
    columns = image.size // max(rows, 1)
    header = f'P5\n# resolution {grid.resolution:g} m\n{columns} {rows}\n255\n'.encode()
    name = json.dumps(pgm.name, ensure_ascii=False)  # which is YAML, whatever the name has in it
    text = (
        f'image: {name}\nmode: trinary\nresolution: {grid.resolution!r}\n'
        f'origin: [{grid.origin[0]!r}, {grid.origin[1]!r}, {grid.yaw!r}]\nnegate: 0\n'
        f'occupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n'
    )
    write_atomically(pgm, header + image[::-1].tobytes())
    write_atomically(meta, text.encode())
    return pgm, meta


def load(path: str | Path) -> OccupancyGrid:
    """The grid of a map; ``path`` is the .yaml file.

    Raises MapError if a file is missing, FileFormatError naming what is wrong in which file.
    """
    d = describe(path)
    shades, white, opaque = _shades(d.image, d.mode)
    s = np.arange(white + 1) / white
    p = s if d.negate else 1.0 - s
    if d.mode == 'raw':
        value = np.where(np.rint(255.0 * s) <= 100.0, np.rint(255.0 * s), UNKNOWN)
    else:
        between: Any = UNKNOWN
        if d.mode == 'scale':
            between = np.rint(100.0 * (p - d.free_thresh) / (d.occupied_thresh - d.free_thresh))
        value = np.where(p > d.occupied_thresh, 100, np.where(p < d.free_thresh, 0, between))
    cells = value.astype(np.int8)[shades]
    if d.mode == 'scale' and opaque is not None:
        cells[~opaque] = UNKNOWN
    x, y, yaw = d.origin
    return OccupancyGrid(d.resolution, (x, y), np.ascontiguousarray(cells[::-1]), yaw)


def describe(path: str | Path) -> Description:
    """The description alone. Raises MapError or FileFormatError, as :func:`load`."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_DESCRIPTION:
            raise FileFormatError(f'{path}: too large to be the description of a map')
        meta = parse_yaml(path.read_text(encoding='utf-8'), f'{path}: not a map description')
    except OSError as e:
        raise MapError(f'{path}: cannot be read: {e.strerror}') from e
    except UnicodeDecodeError as e:
        raise FileFormatError(f'{path}: not a map description: {e}') from e
    if not isinstance(meta, dict):
        raise FileFormatError(f'{path}: not a map description: no "name: value" lines')
    try:
        origin = [_number(meta, 'origin', k) for k in range(len(meta['origin']))]
        if len(origin) != 3:
            raise ValueError(f'origin has {len(origin)} values, 3 are needed: x, y, yaw')
        found = Description(
            path.parent / _text(meta['image']),
            _number(meta, 'resolution'),
            (origin[0], origin[1], origin[2]),
            _number(meta, 'occupied_thresh'),
            _number(meta, 'free_thresh'),
            bool(_number(meta, 'negate')) if 'negate' in meta else False,
            str(meta.get('mode', 'trinary')),
        )
        _check(found)
    except KeyError as e:
        raise FileFormatError(f'{path}: {e.args[0]} is missing') from e
    except (TypeError, ValueError) as e:
        raise FileFormatError(f'{path}: {e}') from e
    return found


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value or '\0' in value:
        raise ValueError('image is not the name of a file')
    return value


def _number(meta: Any, name: str, k: int | None = None) -> float:
    """A finite number of the description, or entry k of a list there."""
    value = meta[name] if k is None else meta[name][k]
    if isinstance(value, (int, float, str)):
        try:
            number = float(value)
        except (ValueError, OverflowError):
            number = math.nan
        if math.isfinite(number):
            return number
    raise ValueError(f'{name} is not a finite number')


def _check(d: Description) -> None:
    """Raise ValueError where a value cannot be meant."""
    if not 1e-4 <= d.resolution <= 1e2:
        raise ValueError(f'resolution {d.resolution:g} m is not that of a map')
    if max(abs(d.origin[0]), abs(d.origin[1])) > 1e9:
        raise ValueError(f'origin {d.origin[:2]} is not on earth')
    if d.mode not in MODES:
        raise ValueError(f'mode {d.mode!r} is none of {", ".join(MODES)}')
    if d.mode != 'raw' and not 0.0 <= d.free_thresh < d.occupied_thresh <= 1.0:
        raise ValueError(
            f'free_thresh {d.free_thresh:g} and occupied_thresh {d.occupied_thresh:g}: '
            f'0 <= free_thresh < occupied_thresh <= 1 is needed'
        )


def _shades(path: Path, mode: str) -> tuple[NDArray[np.uint16], int, NDArray[np.bool_] | None]:
    """Shade of each pixel, rows from the top; the shade of white; where it is opaque, if known.

    Raises MapError or FileFormatError.
    """
    if not path.is_file():
        raise MapError(f'{path}: cannot be read: no such file')
    from PIL import Image, UnidentifiedImageError  # 8 MB that a node without such a map saves

    try:
        with warnings.catch_warnings():
            warnings.simplefilter('error', Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                return _decoded(image, mode)
    except UnidentifiedImageError as e:
        raise FileFormatError(f'{path}: not an image: PGM, PNG, BMP and JPEG are read') from e
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as e:
        raise FileFormatError(
            f'{path}: more than {Image.MAX_IMAGE_PIXELS} pixels: too large for a map'
        ) from e
    # what Pillow raises for damaged images depends on the format
    except (
        OSError, SyntaxError, ValueError, EOFError, OverflowError, IndexError, MemoryError
    ) as e:  # fmt: skip
        raise FileFormatError(f'{path}: damaged image: {e}') from e


def _decoded(
    image: Image.Image, mode: str
) -> tuple[NDArray[np.uint16], int, NDArray[np.bool_] | None]:
    if image.mode.startswith('I'):  # 16 bits
        return np.clip(np.asarray(image), 0, 65535).astype(np.uint16), 65535, None
    if image.mode in ('1', 'L'):
        return np.asarray(image.convert('L')).astype(np.uint16), 255, None
    if image.has_transparency_data:
        rgba = np.asarray(image.convert('RGBA'))
        used = rgba if mode == 'trinary' else rgba[..., :3]
        return used.sum(axis=-1, dtype=np.uint16), 255 * used.shape[-1], rgba[..., 3] == 255
    return np.asarray(image.convert('RGB')).sum(axis=-1, dtype=np.uint16), 765, None


def save_grid(grid: OccupancyGrid | None, folder: Path) -> list[str]:
    """Write map.pgm and map.yaml of a folder, whose names are returned.

    Without a grid, those of an older map are set aside. Raises MapError.
    """
    if grid is not None:
        return [path.name for path in save(grid, folder / 'map')]
    set_aside(folder / 'map.pgm', folder / 'map.yaml')
    return []
