# SPDX-License-Identifier: Apache-2.0
"""Imports point one way, and the core needs no ROS."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'rlml_slam'
LAB = ROOT / 'rlml_lab'
# what a tier may import of the package; nodes and commands are shells over the other two
ALLOWED = {
    'core': {'core'},
    'ros': {'core', 'ros'},
    'nodes': {'core', 'ros', 'nodes'},
    'cli': {'core', 'ros', 'cli'},
}
# readers of data sets, figures and reports stand beside the commands; api is a façade over both
CLI = ('cli', 'datasets', 'evaluation', 'recordings', 'report', 'api', '__init__')
# third-party modules of the core: numbers, and YAML for parameters, worlds and maps; llvmlite is
# what numba itself is made with
CORE_NEEDS = {'llvmlite', 'PIL', 'numba', 'numpy', 'scipy', 'yaml'}
# what an offline command must work without
ROS_MODULES = ('rclpy', 'tf2_msgs', 'sensor_msgs', 'nav_msgs', 'geometry_msgs', 'std_msgs')
MODULES = sorted(PACKAGE.rglob('*.py'))


def tier(module: str) -> str:
    part = module.split('.')[1] if '.' in module else ''
    if part == '__main__' or part in CLI:
        return 'cli'  # python -m rlml_slam is the command
    return part if part in ('ros', 'nodes') else 'core'


def name_of(path: Path) -> str:
    return '.'.join(path.relative_to(ROOT).with_suffix('').parts)


class Facts(NamedTuple):
    """What the tests ask of a file."""

    imports: frozenset[str]
    calls: frozenset[str]  # names of the functions
    classes: dict[str, int]  # lines
    arguments: list[int]  # of each function


@functools.cache
def facts(path: Path) -> Facts:
    """Of a file, which is parsed once."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))
    calls = {n.func.id for n in nodes if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
    classes = [n for n in nodes if isinstance(n, ast.ClassDef)]
    arguments = [n.args for n in nodes if isinstance(n, ast.FunctionDef)]
    return Facts(
        frozenset(imports_of(path, nodes)),
        frozenset(calls),
        {f'{n.name} in line {n.lineno}': n.end_lineno - n.lineno + 1 for n in classes},
        [len(a.posonlyargs + a.args + a.kwonlyargs) for a in arguments],
    )


def imports(path: Path) -> frozenset[str]:
    """Every module that a file imports, at its top or inside of a function."""
    return facts(path).imports


def imports_of(path: Path, nodes: list[ast.AST]) -> set[str]:
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            assert node.module is not None
            found.add(node.module)
            if '.' in node.module:  # a package's own file
                found.add(f'{node.module}.__init__')
            # `from rlml_slam.ros import convert` imports a module as well
            if (ROOT / node.module.replace('.', '/')).is_dir():
                found |= {f'{node.module}.{alias.name}' for alias in node.names}
    return found


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_imports_point_one_way(path):
    name = name_of(path)
    for imported in imports(path):
        if imported == 'rlml_slam' or not imported.startswith('rlml_slam.'):
            continue
        assert tier(imported) in ALLOWED[tier(name)], f'{name} imports {imported}'


@pytest.mark.parametrize(
    'path', [p for p in MODULES if p.parent != PACKAGE and 'cli' not in p.parts], ids=name_of
)
def test_commands_are_a_shell(path):
    """What a command does can be called without it."""
    assert not any(m.startswith('rlml_slam.cli') for m in imports(path))


@pytest.mark.parametrize(
    'path', [p for p in MODULES if tier(name_of(p)) == 'core'],
    ids=name_of,
)  # fmt: skip
def test_core_needs_only_numbers(path):
    needs = {m.split('.')[0] for m in imports(path)} - {'rlml_slam'} - sys.stdlib_module_names
    assert needs <= CORE_NEEDS


@pytest.mark.parametrize(
    'path', [p for p in MODULES if tier(name_of(p)) == 'core'], ids=name_of
)  # fmt: skip
def test_core_neither_prints_nor_logs(path):
    assert 'print' not in facts(path).calls
    assert 'logging' not in imports(path)


@pytest.mark.parametrize('path', [p for p in MODULES if tier(name_of(p)) == 'ros'], ids=name_of)
def test_tf2_msgs_is_known_in_one_place(path):
    if path.name != 'tf.py':
        assert not any(m.startswith('tf2_msgs') for m in imports(path))


@pytest.mark.parametrize('path', sorted((PACKAGE / 'nodes').glob('*.py')), ids=name_of)
def test_nodes_are_thin(path):
    assert len(path.read_text(encoding='utf-8').splitlines()) <= 100


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_every_file_names_its_licence(path):
    assert path.read_text(encoding='utf-8').startswith('# SPDX-License-Identifier: Apache-2.0\n')


def test_folders_import_one_way_at_every_level():
    """No arrow back and no circle between the files and folders of any folder."""
    modules = {name_of(p): p for top in (PACKAGE, LAB) for p in top.rglob('*.py')}
    below: dict[str, dict[str, set[str]]] = {}
    for name, path in modules.items():
        for imported in imports(path) & modules.keys():
            a, b = name.split('.'), imported.split('.')
            n = next((k for k in range(min(len(a), len(b))) if a[k] != b[k]), None)
            if n is not None:
                level = '.'.join(a[:n])
                below.setdefault(level, {}).setdefault(a[n], set()).add(b[n])
    for level, graph in below.items():
        try:
            tuple(TopologicalSorter(graph).static_order())
        except CycleError as e:
            pytest.fail(f'{level or "top"}: {" imports ".join(e.args[1])}')


GRAPH = {name_of(p) for p in MODULES if PACKAGE / 'graph' in p.parents}


@pytest.mark.parametrize(
    'path', [p for p in MODULES if PACKAGE / 'graph' not in p.parents], ids=name_of
)
def test_graph_is_used_through_its_facade(path):
    assert imports(path) & GRAPH <= {'rlml_slam.graph.__init__'}


@pytest.mark.parametrize(
    'folder', sorted({p.parent for top in (PACKAGE, LAB) for p in top.rglob('*.py')}), ids=str
)
def test_folder_has_at_most_15_files(folder):
    files = [p for p in folder.glob('*.py') if p.name != '__init__.py']
    assert len(files) <= 15, 'put files that belong together into a folder below'


# --- a ratchet: lower these limits as the code gets better; a feature may raise MAX_LINES -----

MAX_CLASS = 250  # lines
# of the installed package; the goal is 40 000. Raised for journal, guard, nav2, devices, motion
# hypotheses, gaps, kernels, help and progress, bounded search, odometry from TF, intensities,
# shadow, shapes of reflectors, rlml check, plan of a layout, bounds of YAML, replays as MCAP,
# suggestions and audit of a layout, sites of many sessions, lifecycle, comparison of runs,
# sizes of reflectors, noise of a sweep, stamps ahead of their stream, maps that go on after gaps,
# sensors that share a topic, robots that are found after gaps, odometry that is late, gyros and
# sweeps that cannot be, robots that move sideways, recordings that were not closed, noise of
# intensities, ids that repeat, sensors that are placed late, closures decided at the end,
# scans thinned alike from both sides, ids that count the rows of a message, scale errors of
# odometry that is late, sides of walls, an EKF that is lost, checks of the Python API, maps of one
# drive, where a robot turns, rays that graze walls, robots that are carried to a place like their
# own, commands on a machine that is too slow, markers of a graph in a file of their own, turns
# that begin within a sweep, errors that all poses after a gap have in common
MAX_LINES = 59_820
MAX_LONG_LISTS = 3
MAX_WORDS = 30  # in code and docs, the changelog aside
# tests that need a study's scenes, drives or graphs; a new one belongs into test/lab
TESTS_WITH_A_STUDY = {
    'cli/test_doctor.py', 'cli/test_main.py',
    'deformable/test_deformable_slam.py', 'deformable/test_deformable_window.py',
    'graph/test_incremental_solver.py', 'graph/test_initialization.py', 'graph/test_solver.py',
    'nodes/test_deformable_node.py', 'sensing/test_reflector_detector.py',
    'slam/front_end/test_constant_velocity.py', 'slam/front_end/test_degeneracy.py',
    'test_config.py', 'test_documentation.py',
}  # fmt: skip
PLAIN = re.compile(r'\bt(?:ell(?:s|ing)?|old)\b|\bg(?:one)\b|\ba(?:new)\b', re.IGNORECASE)


def test_classes_are_small():
    for path in MODULES:
        for name, lines in facts(path).classes.items():
            assert lines <= MAX_CLASS, name


def test_argument_lists_are_short():
    long = [n for path in MODULES for n in facts(path).arguments if n > 8]
    assert len(long) <= MAX_LONG_LISTS


def test_package_is_small():
    lines = sum(len(p.read_text(encoding='utf-8').splitlines()) for p in MODULES)
    assert lines <= MAX_LINES, 'shorten, or see CONTRIBUTING.md, Rules'


def test_words_are_plain():
    folders = ('rlml_slam', 'rlml_lab', 'test', 'docs', 'bags', 'config')
    files = [p for f in folders for kind in ('*.py', '*.md') for p in (ROOT / f).rglob(kind)]
    hits = {p.name: len(PLAIN.findall(p.read_text(encoding='utf-8'))) for p in files}
    assert sum(hits.values()) <= MAX_WORDS, max(hits, key=lambda name: hits[name])


def test_tests_of_the_package_import_no_study():
    tests = ROOT / 'test'
    found = {
        str(p.relative_to(tests))
        for p in tests.rglob('*.py')
        if any(m.startswith('rlml_lab') for m in imports(p))
    }
    assert {t for t in found if not t.startswith('lab/')} <= TESTS_WITH_A_STUDY


def test_core_and_commands_import_without_ros():
    """A process in which every ROS module is missing can still do all that is offline."""
    code = f"""
import sys
for name in {ROS_MODULES!r}:
    sys.modules[name] = None
from rlml_slam import warm_up
warm_up.import_core()
import rlml_slam.ros.bags.bag, rlml_slam.ros.codecs.decode, rlml_slam.ros.sensor_input
import rlml_slam.ros.codecs.frame_messages
from rlml_slam.cli.main import main
sys.exit(main(['replay', '--help']))
"""
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert 'replay' in done.stdout


def test_nodes_need_no_rosbags():
    """A stock ROS 2 has no rosbags; only bags need it."""
    for name in (
        'front_end', 'back_end', 'slam', 'simulator', 'deformable_slam',
    ):  # fmt: skip
        seen, todo = set(), [f'rlml_slam.nodes.{name}']
        while todo:
            module = todo.pop()
            seen.add(module)
            path = ROOT / (module.replace('.', '/') + '.py')
            if not path.exists():
                path = ROOT / module.replace('.', '/') / '__init__.py'
            if path.exists():
                top = [n for n in ast.parse(path.read_text()).body
                       if isinstance(n, ast.Import | ast.ImportFrom)]  # fmt: skip
                for node in top:
                    if isinstance(node, ast.Import):
                        names = {alias.name for alias in node.names}
                    else:
                        names = {node.module} | {f'{node.module}.{a.name}' for a in node.names}
                    todo += [n for n in names if n.startswith('rlml_slam') and n not in seen]
                    seen |= names
        assert not [m for m in seen if m.startswith('rosbags')], name
