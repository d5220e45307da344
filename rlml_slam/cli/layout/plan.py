# SPDX-License-Identifier: Apache-2.0
"""``rlml plan``: what accuracy a layout of reflectors gives, and where it cannot work."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from rlml_slam.cli.main import between
from rlml_slam.cli.support.text_table import aligned
from rlml_slam.datasets.tum import read_tum
from rlml_slam.errors import FileFormatError, MapError, ParameterError, cause
from rlml_slam.maps import saved_map, survey
from rlml_slam.params import Parameters, SimulatorParameters, from_mapping, read_yaml
from rlml_slam.plain_yaml import parse_yaml
from rlml_slam.planning import site as sites
from rlml_slam.planning.mounts import NO_PATH, out_of_the_way, thin, wall_mounts
from rlml_slam.planning.plan import Goal, make_plan
from rlml_slam.planning.site import Site
from rlml_slam.planning.suggest import Wanted, suggested
from rlml_slam.report.plan_page import suggestion_notes, suggestion_rows, table_rows, write_plan
from rlml_slam.se2 import Array
from rlml_slam.simulation.world_file import load_world, world_names
from rlml_slam.slam.store import map_file

ERROR_CODE = 2  # 1: the goal is missed


def add_parser(subparsers: Any) -> None:
    """Declare ``rlml plan``."""
    parser = subparsers.add_parser(
        'plan',
        help='accuracy and uniqueness that a layout of reflectors gives',
        description='For each place of a map: reflectors in view, the bound of the position by '
        'reflectors, by the scan and by both, the same with one or two reflectors hidden, and '
        'whether a lost robot finds itself. Exit code 1 where the goal is missed, 2 for an error.',
    )
    parser.add_argument('map', metavar='MAP', help='.rlml, map of nav2 (.yaml) or world file')
    parser.add_argument('--reflectors', type=Path, metavar='FILE', help='.csv, .json or .imk in '
                        'the frame of the map; without it, those of the map')  # fmt: skip
    parser.add_argument('--out', type=Path, metavar='DIR', required=True, help='where files go')
    parser.add_argument(
        '--sensor', type=Path, metavar='YAML',
        help='parameters of front_end (noise) and simulator (laser, markers), or of one of them',
    )  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument('--area', metavar='POLYGON', help='"x,y x,y x,y …" [m]: places inside')
    where.add_argument('--path', type=Path, metavar='TUM', help='places along a trajectory')
    parser.add_argument(
        '--goal', type=float, default=0.01, help='position sigma while driving [m]'
    )
    parser.add_argument('--speed', type=float, default=1.0, help='of the drive [m/s]; 0: the goal '
                        'is for a single scan')  # fmt: skip
    parser.add_argument('--redundant', type=int, default=0, choices=(0, 1, 2), metavar='K',
                        help='the goal holds with the worst K reflectors hidden')  # fmt: skip
    parser.add_argument('--spacing', type=float, default=0.25, help='between places [m]')
    parser.add_argument('--clearance', type=between(0.0, 100.0), default=0.3,
                        help='half the width of robots [m]: places and ways are as far from walls '
                        'and posts')  # fmt: skip
    more = parser.add_mutually_exclusive_group()
    more.add_argument('--suggest', type=int, metavar='N', help='add N reflectors where they help '
                      'most; layout.csv, .imk and .dxf')  # fmt: skip
    more.add_argument('--minimum', action='store_true', help='add the fewest that reach the goal')
    parser.add_argument('--mountable', type=Path, metavar='FILE', help='.csv, .json or .imk of '
                        'poles; without it, all walls and pillars')  # fmt: skip
    parser.add_argument('--mount-spacing', type=float, default=1.0, metavar='M',
                        help='between places on walls that are tried [m]')  # fmt: skip
    parser.add_argument('--need', choices=('both', 'accuracy', 'unique'), default='both',
                        help='what suggestions reach (default: %(default)s)')  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print plan.json and no more')


def run(args: argparse.Namespace) -> int:
    """Plan, write, print; 1 where the goal is missed somewhere."""
    for name in ('goal', 'spacing'):
        if not 1e-4 < getattr(args, name) < 1e3:
            raise ParameterError(f'--{name} is not between 0.1 mm and 1 km')
    if args.suggest is not None and not 1 <= args.suggest <= 1000:
        raise ParameterError('--suggest is not between 1 and 1000')
    if not 0.05 <= args.mount_spacing <= 1e3:
        raise ParameterError('--mount-spacing is not between 5 cm and 1 km')
    if not 0.0 <= args.speed <= 100.0:
        raise ParameterError('--speed is not between 0 and 100 m/s')
    site = load_site(args.map)
    if args.reflectors is not None:
        site = site.with_reflectors(survey.load(args.reflectors))
        if not _is_world(args.map):
            site = sites.with_walls_of_grid(site)
    p, sensor = sensor_of(args.sensor)
    places, goal = _places(args, site), Goal(args.goal, args.speed, args.redundant)
    suggestion = None
    if args.suggest is None and not args.minimum:
        plan = make_plan(site, places, p, sensor, goal)
    else:
        wanted = Wanted(args.suggest, goal, args.need != 'unique', args.need != 'accuracy')
        suggestion, plan = suggested(site, _mounts(args, site), places, p, sensor, wanted)
    found = write_plan(plan, Path(args.map).stem, args.out, suggestion)
    if args.json:
        print(json.dumps(found))
    else:
        _print(found, args)
    return 0 if _is_reached(found, args) else 1


def _is_reached(found: dict[str, Any], args: argparse.Namespace) -> bool:
    """Whether the goal is; suggestions also make places unique, unless --need says otherwise."""
    is_unique = found['unique_share'] == 1.0
    if 'suggested' not in found:
        return bool(found['goal_share'] == 1.0)
    needs = {'accuracy': found['goal_share'] == 1.0, 'unique': is_unique}
    return all(needs.values()) if args.need == 'both' else bool(needs[args.need])


def _print(found: dict[str, Any], args: argparse.Namespace) -> None:
    print(aligned(table_rows(found)))
    for note in found['notes']:
        print(note)
    if 'suggested' in found:
        print(aligned(suggestion_rows(found)))
        for line in suggestion_notes(found):
            print(line)
    print(f'{args.goal:g} m is reached at {found["goal_share"]:.1%} of {found["places"]} '
          f'places; {args.out / "plan.html"}')  # fmt: skip


def _mounts(args: argparse.Namespace, site: Site) -> Array:
    """Where reflectors may be mounted (c, 2)."""
    path = NO_PATH if args.path is None else read_tum(args.path).poses[:, :2]
    if args.mountable is None:
        return wall_mounts(site, args.mount_spacing, args.clearance, path)
    poles = thin(survey.load(args.mountable).points, 0.0, site.reflectors.points)
    free = out_of_the_way(site, poles, args.clearance, path)
    if len(free) < len(poles):
        print(f'{len(poles) - len(free)} of {len(poles)} poles are in the way of robots: they are '
              'not used', file=sys.stderr)  # fmt: skip
    return free


def _is_world(name: str) -> bool:
    """Whether it is a world file and not the description of a map of nav2."""
    if name in world_names():
        return True
    path = Path(name)
    if path.suffix not in ('.yaml', '.yml'):
        return False
    try:
        tree = parse_yaml(path.read_text(encoding='utf-8'), name)
    except (OSError, UnicodeDecodeError) as e:
        raise MapError(f'{name}: cannot be read: {cause(e)}') from e
    return isinstance(tree, dict) and 'image' not in tree


def load_site(name: str) -> Site:
    """The site of a saved map, a map of nav2 or a world."""
    if _is_world(name):
        return sites.of_world(load_world(name))
    path = Path(name)
    is_whole = path.suffix == '.rlml'
    saved = map_file.saved_map(map_file.load(path)) if is_whole else saved_map.load(path)
    if saved.grid is None:
        raise MapError(f'{name}: there is no grid in it, which a plan needs')
    return sites.of_grid(saved.grid, saved.reflectors)


def sensor_of(path: Path | None) -> tuple[Parameters, SimulatorParameters]:
    """Noise of the front end, and laser and detector; defaults for a section that is not there."""
    if path is None:
        return Parameters(), SimulatorParameters()
    found: list[Any] = []
    errors = []
    for of in (Parameters, SimulatorParameters):
        try:
            found.append(from_mapping(read_yaml(path, of), of))
        except FileFormatError as e:
            errors.append(e)
            found.append(of())
    if len(errors) == 2:
        raise errors[0]
    return found[0], found[1]


def _places(args: argparse.Namespace, site: Site) -> Array:
    if args.path is not None:
        return sites.on_path(read_tum(args.path).poses, args.spacing)[:, :2]
    places = sites.places(site, args.spacing, args.clearance)
    if args.area is None:
        return places
    try:
        polygon = np.array([[float(v) for v in point.split(',')] for point in args.area.split()])
    except ValueError as e:
        raise FileFormatError(f'--area: {e}; "x,y x,y x,y" is expected') from e
    if polygon.shape[1:] != (2,) or len(polygon) < 3 or not np.isfinite(polygon).all():
        raise FileFormatError('--area: at least three points "x,y" are needed')
    return places[sites.inside(polygon, places)]
