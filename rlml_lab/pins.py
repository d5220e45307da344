# SPDX-License-Identifier: Apache-2.0
"""Digests of all that replays write: proof that a change of the code changes no result.

Two trees on one machine with one Python: the same digests mean the same bytes. Those of another
processor or of other versions of numpy and Numba may differ, for kernels are compiled for the
machine that they run on.

    pins.py --tree OLD --out WORK --write pins.json
    pins.py --tree NEW --out WORK --check pins.json

Not pinned: texts for people (words in tables and maps), names of the arrays of a map, its
description, pictures, times. Of two runs with one ``--out`` and trees of one name, one waits.
"""

from __future__ import annotations

import argparse
import csv
import fcntl
import hashlib
import io
import json
import math
import os
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

PACKAGE = 'rlml_slam'
LAB = 'rlml_lab'
BYTES = ('trajectory.tum', 'front_end.tum', 'map.pgm', 'map.yaml', 'reflectors.csv')
NUMBERS = ('closures.csv', 'reflector_states.csv')
MAP, METRICS = 'map.rlml', 'metrics.json'
HEADER = 64  # bytes before the zip archive of a map
SHIFT, TURN = (10.0, 20.0), 0.5  # where the survey's frame is in that of the map [m, rad]
SETS = ('intel', 'fr079')
ROBOTS = range(1, 6)

Pin = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A replay: its bag, its options, and the cases whose results these options need.

    ``bag`` is the name of a converted bag, or of one of the tree's samples. In the options,
    ``{NAME}`` is the folder that the case NAME wrote.
    """

    bag: str
    options: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    relations: str = ''


@dataclass(frozen=True)
class Places:
    """Where everything is; ``runs`` has a folder for each case."""

    python: str
    tree: Path
    data: Path
    bags: Path
    runs: Path


class PinError(Exception):
    """Nothing can be compared."""


def cases() -> dict[str, Case]:
    """All of them, each after those that it needs; the long ones last."""
    out: dict[str, Case] = {}
    for name in ('hall', 'room'):
        out[name] = Case(name)
        out[f'{name}_ekf'] = Case(name, ('--system', 'ekf'))
        out[f'{name}_map'] = Case(name, ('--map', f'{{{name}}}/{MAP}'), (name,))
        out[f'{name}_continue'] = Case(name, ('--continue', f'{{{name}}}/{MAP}'), (name,))
    survey = ('--survey', '{hall}/survey.csv')
    out['hall_survey'] = Case('hall', survey, ('hall',))
    out['room_no_odometry'] = Case('room', ('--no-odometry',))
    for robot in ROBOTS:
        for name in (f'mrclam6_{robot}', f'mrclam6_{robot}_no_ids'):
            out[name] = Case(name)
    for name in reversed(SETS):
        out[name] = Case(name, relations=name)
    out['intel_continue'] = Case('intel', ('--continue', f'{{intel}}/{MAP}'), ('intel',), 'intel')
    return out


def conversions(data: Path) -> dict[str, tuple[str | Path, ...]]:
    """What ``convert`` of rlml or rlml-lab is given for each bag, without the bag's own name."""
    out: dict[str, tuple[str | Path, ...]] = {
        name: ('carmen', _benchmark(data, name, 'rebuilt.log.xz')) for name in SETS
    }
    for robot in ROBOTS:
        command = ('mrclam', data / 'mrclam' / 'dataset6', '--robot', str(robot))
        out[f'mrclam6_{robot}'] = command
        out[f'mrclam6_{robot}_no_ids'] = (*command, '--no-ids')
    return out


def _benchmark(data: Path, name: str, suffix: str) -> Path:
    return data / 'slam-benchmark' / name / f'{name}.{suffix}'


def rlml(places: Places, *args: str | Path) -> subprocess.CompletedProcess[str]:
    """The command ``rlml`` of the tree."""
    return _python(places, '-m', PACKAGE, *args)


def _python(places: Places, *args: str | Path) -> subprocess.CompletedProcess[str]:
    # Python looks for modules where it is started first: so not in a tree
    path = os.pathsep.join(filter(None, (str(places.tree), os.environ.get('PYTHONPATH'))))
    return subprocess.run(
        [places.python, *map(str, args)], cwd=places.runs, env=os.environ | {'PYTHONPATH': path},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def check_tree(places: Places) -> None:
    """Raises PinError if the interpreter would run other code than that of the tree."""
    printed = _python(places, '-c', f'import {PACKAGE}; print({PACKAGE}.__file__)')
    wanted = places.tree / PACKAGE / '__init__.py'
    if printed.returncode or Path(printed.stdout.strip()).resolve() != wanted.resolve():
        why = printed.stdout.strip() or printed.stderr.strip()
        raise PinError(f'{places.python} does not run {wanted}: {why}')


def bag_of(places: Places, name: str) -> Path:
    """A sample of the tree, or a bag that is converted unless that was done before."""
    command = conversions(places.data).get(name)
    if command is None:
        return places.tree / 'bags' / name
    bag = places.bags / name
    if not bag.exists():
        unfinished = places.bags / f'.unfinished-{os.getpid()}'
        unfinished.mkdir(parents=True, exist_ok=True)
        try:
            module = PACKAGE if command[0] == 'carmen' else LAB
            done = _python(places, '-m', module, 'convert', *command, unfinished / name)
            if done.returncode:
                raise PinError(f'{name} is not converted: {done.stderr.strip()}')
            os.rename(unfinished / name, bag)
        finally:
            shutil.rmtree(unfinished)
    return bag


def write_survey(source: Path, survey: Path) -> None:
    """The reflectors of a map, as if surveyed in a frame that is shifted and turned."""
    c, s = math.cos(TURN), math.sin(TURN)
    lines = ['id,x,y']
    with source.open(encoding='utf-8', newline='') as f:
        for row in csv.DictReader(f):
            x, y = float(row['x_m']), float(row['y_m'])
            there = (c * x - s * y + SHIFT[0], s * x + c * y + SHIFT[1])
            lines.append(f'{row["id"]},{there[0]:.6f},{there[1]:.6f}')
    survey.write_text('\n'.join(lines) + '\n', encoding='utf-8')


def run_case(places: Places, name: str, case: Case) -> Pin:
    """Replay, and the pin: the exit code, digests of the files, and figures."""
    bag, out = bag_of(places, case.bag), places.runs / name
    shutil.rmtree(out, ignore_errors=True)
    folders = {need: places.runs / need for need in case.needs}
    options = [option.format_map(folders) for option in case.options]
    began = time.perf_counter()
    done = rlml(places, 'replay', bag, '--out', out, '--json', *options)
    seconds = time.perf_counter() - began
    if name == 'hall' and not done.returncode:
        write_survey(out / 'reflectors.csv', out / 'survey.csv')
    found = figures(places, case, out) | {'process_s': round(seconds, 1)}
    if done.stderr.strip():
        found['said'] = done.stderr.strip().splitlines()[-1]
    return {'exit': done.returncode, 'files': digests(out), 'figures': found}


def digests(folder: Path) -> dict[str, Any]:
    """Of each file that is there."""
    kinds: dict[str, Callable[[Path], Any]] = {
        **dict.fromkeys(BYTES, digest_of_bytes),
        **dict.fromkeys(NUMBERS, digest_of_numbers),
        MAP: digests_of_arrays,
    }
    return {n: digest(folder / n) for n, digest in kinds.items() if (folder / n).exists()}


def digest_of_bytes(path: Path) -> str:
    """SHA-256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def digest_of_numbers(path: Path) -> Pin:
    """Of a table: the number of rows, and the digest of all numbers, row by row."""
    with path.open(encoding='utf-8', newline='') as f:
        rows = list(csv.reader(f))
    seen, count = hashlib.sha256(), 0
    for row in rows:
        values = [value for cell in row for value in numbers(cell)]
        count += len(values)
        seen.update((' '.join(map(repr, values)) + '\n').encode())
    return {'rows': len(rows), 'numbers': count, 'sha256': seen.hexdigest()}


def numbers(cell: str) -> list[float]:
    """Those of a cell: a number, or several as ``a:b c:d``; none where there are words."""
    try:
        return [float(part) for word in cell.split() for part in word.split(':')]
    except ValueError:
        return []


def digests_of_arrays(path: Path) -> list[str]:
    """Of each array of a map ``type shape digest``, sorted; of texts, type and shape alone."""
    out = []
    with zipfile.ZipFile(io.BytesIO(path.read_bytes()[HEADER:])) as archive:
        for name in archive.namelist():
            if name.endswith('.npy'):
                with archive.open(name) as f:
                    array = npy.read_array(f, allow_pickle=False)
                out.append(_told(array))
    return sorted(out)


def _told(array: np.ndarray[Any, Any]) -> str:
    shape = 'x'.join(map(str, array.shape)) or 'one'
    if array.dtype.kind in 'SU':
        return f'text {shape}'
    content = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return f'{array.dtype.str} {shape} {content}'


def figures(places: Places, case: Case, folder: Path) -> dict[str, Any]:
    """What is printed beside the digests; it is not compared."""
    out: dict[str, Any] = {}
    if (folder / METRICS).exists():
        f = json.loads((folder / METRICS).read_text(encoding='utf-8'))
        out = {
            'closures': f['closures']['accepted'], 'reflectors': f['reflectors'],
            'wall_s': f['wall_s'], 'ate_m': f.get('ate_rmse_m'),
        }  # fmt: skip
    path = folder / 'trajectory.tum'
    if case.relations and path.exists():
        relations = _benchmark(places.data, case.relations, 'relations')
        done = rlml(places, 'evaluate', 'relations', path, relations, '--json')
        if done.returncode:
            return out | {'relations': done.stderr.strip()}
        f = json.loads(done.stdout)
        for name, unit in (('trans', 'm'), ('rot', 'deg')):
            for kind in ('mean', 'std'):
                out[f'{name}_{kind}_{unit}'] = f[f'{name}_{kind}_{unit}']
    return out


def differences(old: Pin, new: Pin) -> list[str]:
    """What differs between two pins of a case, a line each."""
    out = []
    if old['exit'] != new['exit']:
        out.append(f'exit code {new["exit"]} instead of {old["exit"]}')
    for name in sorted(old['files'].keys() | new['files'].keys()):
        a, b = (pin['files'].get(name) for pin in (old, new))
        if a is None or b is None:
            out.append(f'{name} is {"new" if a is None else "missing"}')
        elif a != b:
            out.append(f'{name} differs{_how(a, b)}')
    return out


def _how(a: Any, b: Any) -> str:
    """Which arrays, or how many rows and numbers."""
    if isinstance(a, dict):
        old, new = (f'{pin["rows"]} rows, {pin["numbers"]} numbers' for pin in (a, b))
        return f': {new}' if old == new else f': {new} instead of {old}'
    if isinstance(a, list):
        missing, come = _without(a, b), _without(b, a)
        kinds = ', '.join(' '.join(line.split()[:2]) for line in come)
        counts = f'{len(missing)} of {len(a)} arrays changed or missing, {len(come)} others'
        return f': {counts}: {kinds}'
    return ''


def _without(a: Sequence[str], b: Iterable[str]) -> list[str]:
    """What is in a and not in b; what is there twice counts twice."""
    out = list(a)
    for line in b:
        if line in out:
            out.remove(line)
    return out


def row(name: str, pin: Pin) -> str:
    """The figures of a case."""
    f = pin['figures']

    def line(key: str, form: str) -> str:
        value = f.get(key)
        return '-' if value is None else format(value, form)

    cells = (
        line('trans_mean_m', '.4f'), line('trans_std_m', '.4f'), line('rot_mean_deg', '.3f'),
        line('rot_std_deg', '.3f'), line('ate_m', '.4f'), line('closures', 'd'),
        line('reflectors', 'd'), line('wall_s', '.1f'), line('process_s', '.1f'),
    )  # fmt: skip
    said = ''.join(f'  {f[key]}' for key in ('said', 'relations') if key in f)
    return _line(name, cells, f'{pin["exit"]}') + said


def _line(name: str, cells: Iterable[str], last: str) -> str:
    return f'{name:<20}' + ''.join(f'{cell:>10}' for cell in cells) + f'{last:>6}'


HEAD = _line(
    'case',
    ('trans m', 'std', 'rot deg', 'std', 'ATE m', 'closures', 'reflect.', 'wall s', 'process'),
    'exit',
)


def chosen(only: Sequence[str]) -> dict[str, Case]:
    """The cases of these names and those that they need; all where there are none."""
    every = cases()
    unknown = set(only) - every.keys()
    if unknown:
        raise PinError(f'no case {", ".join(sorted(unknown))}; there are {", ".join(every)}')
    wanted = set(only) or set(every)
    wanted |= {need for name in wanted for need in every[name].needs}
    return {name: case for name, case in every.items() if name in wanted}


def compare(old: Mapping[str, Pin], new: Mapping[str, Pin], partly: bool) -> int:
    """Say what differs; the number of cases that do."""
    wrong = 0
    for name in dict.fromkeys([*new, *([] if partly else old)]):
        if name not in old or name not in new:
            lines = ['not in the pins' if name in new else 'no longer a case']
        else:
            lines = differences(old[name], new[name])
        if lines:
            wrong += 1
            print(f'{name}:', *lines, sep='\n  ')
            if name in old and name in new:
                print(f'  was  {row(name, old[name])}\n  is   {row(name, new[name])}')
    return wrong


def main() -> int:
    """Run the cases; write the pins, or say what differs from them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    here = Path(__file__).resolve().parents[1]
    parser.add_argument('--python', metavar='EXE', default=sys.executable)
    parser.add_argument('--tree', metavar='DIR', type=Path, default=here, help='%(default)s')
    parser.add_argument(
        '--data', metavar='DIR', type=Path, help='default: ../shared/data, as seen from the tree'
    )
    parser.add_argument(
        '--out', metavar='DIR', type=Path, required=True,
        help='work folder: bags/ is used again, runs/NAME-OF-THE-TREE/ has the last results',
    )  # fmt: skip
    parser.add_argument(
        '--only', metavar='NAME', nargs='+', default=[], help='these cases and what they need'
    )
    parser.add_argument(
        '--write', metavar='FILE', type=Path,
        help='the pins, as JSON; with --only, other cases that are in it stay',
    )  # fmt: skip
    parser.add_argument('--check', metavar='FILE', type=Path, help='say what differs from these')
    args = parser.parse_args()
    try:
        return run(args)
    except (PinError, OSError) as e:
        print(f'pins: {e}', file=sys.stderr)
        return 2


def run(args: argparse.Namespace) -> int:
    """As main, with the options given."""
    tree, out = args.tree.resolve(), args.out.resolve()
    data = args.data or tree.parent / 'shared' / 'data'
    # where it is as it was given: an environment's interpreter is a link to another one
    python = os.path.abspath(args.python) if os.sep in args.python else args.python
    places = Places(python, tree, data.resolve(), out / 'bags', out / 'runs' / tree.name)
    selected = chosen(args.only)
    old = json.loads(args.check.read_text(encoding='utf-8')) if args.check else {}
    places.runs.mkdir(parents=True, exist_ok=True)
    with (places.runs / '.lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        check_tree(places)
        began = time.perf_counter()
        print(HEAD, flush=True)
        new = {}
        for name, case in selected.items():
            new[name] = run_case(places, name, case)
            print(row(name, new[name]), flush=True)
        print(f'{len(new)} cases in {time.perf_counter() - began:.0f} s')
    if args.write:
        known = {}
        if args.only and args.write.exists():
            known = json.loads(args.write.read_text(encoding='utf-8'))
        args.write.write_text(json.dumps(known | new, indent=1) + '\n', encoding='utf-8')
    wrong = compare(old, new, bool(args.only)) if args.check else 0
    if args.check:
        print(f'{wrong} of {len(new)} cases differ' if wrong else 'nothing differs')
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
