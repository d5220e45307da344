# SPDX-License-Identifier: Apache-2.0
"""What the documentation names exists: files, classes, commands, options, parameters, links."""

from __future__ import annotations

import argparse
import ast
import re
from functools import cache
from pathlib import Path

import pytest

from rlml_lab import results
from rlml_lab.carrier.carrier_parameters import CarrierParameters
from rlml_lab.main import COMMANDS as LAB
from rlml_slam.cli.main import COMMANDS, Group, build_parser
from rlml_slam.params import (
    DeformableParameters,
    DetectorParameters,
    EkfParameters,
    Parameters,
    PlayerParameters,
    SimulatorParameters,
    declarations,
)

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / 'docs'
TOP = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'CHANGELOG.md']
PAGES = [*TOP, *sorted(DOCS.glob('*.md'))]
CURRENT = [p for p in PAGES if p.name != 'CHANGELOG.md']  # which names what was, too
SETS = (
    Parameters, EkfParameters, DeformableParameters, DetectorParameters, SimulatorParameters,
    CarrierParameters, PlayerParameters,
)  # fmt: skip
PARAMETERS = {d.name for of in SETS for d in declarations(of)}
# what ROS, nav2 and other people's messages have
OTHERS = {
    'use_sim_time', 'transform_tolerance', 'map_url', 'load_namespace', 'time_increment',
    'AddDiagnostics', 'LaserScan', 'PointCloud2', 'PoseArray', 'TransformStamped', 'MapMetaData',
    'MarkerArray', 'PolygonStamped',
}  # fmt: skip


def text(page):
    return page.read_text(encoding='utf-8')


def code_of(page):
    """Everything in `code` and in code blocks of a page."""
    blocks = re.findall(r'^ *```\w*\n(.*?)^ *```', text(page), re.DOTALL | re.MULTILINE)
    rest = re.sub(r'^ *```.*?^ *```', '', text(page), flags=re.DOTALL | re.MULTILINE)
    return [line for block in blocks for line in block.splitlines()] + re.findall(
        r'`([^`\n]+)`', rest
    )


def anchors(page):
    """Anchors of a page: explicit ones, and those that mkdocs and GitHub make of headings."""
    found = set(re.findall(r'<a id="([^"]+)">', text(page)))
    for heading in re.findall(r'^#+ (.+)$', text(page), re.MULTILINE):
        plain = re.sub(r'<[^>]+>|`', '', heading).strip().lower()
        found.add(re.sub(r'[\s-]+', '-', re.sub(r'[^\w\s-]', '', plain)))
    return found


def page_of(link, page):
    """The file that a link of a page leads to; those of CONTRIBUTING are made for the root."""
    return (page.parent / link).resolve() if link else page


@pytest.mark.parametrize('page', PAGES, ids=lambda p: p.name)
def test_links_lead_to_files_and_anchors(page):
    for link in re.findall(r'\]\((?!https?:)([^)]+)\)', text(page)):
        name, _, anchor = link.partition('#')
        target = page_of(name, page)
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_readme_is_short():
    assert len(text(ROOT / 'README.md').split()) <= 900


@pytest.mark.parametrize('page', CURRENT, ids=lambda p: p.name)
def test_named_files_exist(page):
    folders = ('rlml_slam', 'rlml_lab', 'test', 'docs', 'config', 'requirements', 'bags')
    named = {
        m
        for code in code_of(page)
        for m in re.findall(rf'(?<![\w/.$~*])((?:{"|".join(folders)})/[\w./-]*[\w/])', code)
        if 'NAME' not in m and '.X.' not in m
    }
    # a folder of the reader's own may be called so as well
    missing = {m for m in named if not (ROOT / m).exists() and not (DOCS / m).exists()}
    assert not missing


@cache
def names_of_the_code():
    """Every class, function, method and constant of the two packages."""
    found = set()
    for top in ('rlml_slam', 'rlml_lab'):
        for path in (ROOT / top).rglob('*.py'):
            for node in ast.walk(ast.parse(text(path))):
                if isinstance(node, ast.ClassDef | ast.FunctionDef):
                    found.add(node.name)
                elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    found.add(node.id)
    return found


@pytest.mark.parametrize('page', CURRENT, ids=lambda p: p.name)
def test_named_classes_and_functions_exist(page):
    """In `code`: CamelCase, CamelCase.method and function()."""
    for code in code_of(page):
        names = re.findall(r'^([A-Z][a-z]+[A-Z]\w+)(?:\.(\w+))?(?:\(.*\))?$', code)
        names += re.findall(r'^()([a-z]\w+)\(.*\)$', code)
        for name in {n for pair in names for n in pair if n} - OTHERS:
            assert name in names_of_the_code(), f'{code}: no such name'


@pytest.mark.parametrize('page', CURRENT, ids=lambda p: p.name)
def test_named_parameters_exist(page):
    """In `code`: group.field of a known group, and name:=value."""
    groups = {name.split('.')[0] for name in PARAMETERS if '.' in name}
    for code in code_of(page):
        dotted = re.findall(r'(?<![\w/.])([a-z_]+)\.([a-z_]+)(?![\w/(.])', code)
        named = {f'{a}.{b}' for a, b in dotted if a in groups}
        named |= set(re.findall(r'-p "?([a-z_.]+):=', code))
        suffixes = ('.csv', '.yaml', '.html', '.png', '.rlml', '.py', '.pose', '.pgm', '.md')
        named = {n for n in named if not n.endswith(suffixes)}
        assert not named - PARAMETERS - OTHERS, f'{code}: no such parameter'


def test_renamed_parameters_of_the_changelog_exist():
    rows = re.findall(r'^\| `([a-z_.0-9]+)` \| `([a-z_.0-9]+)` \|$', text(TOP[2]), re.MULTILINE)
    renamed = [(old, new) for old, new in rows if '/' not in old]
    assert len(renamed) > 50
    assert not [new for _, new in renamed if new not in PARAMETERS]
    assert not [old for old, _ in renamed if old in PARAMETERS]


def rows_of(table):
    for name, entry in table.items():
        for sub in entry.commands if isinstance(entry, Group) else ('',):
            yield f'{name} {sub}'.strip()


def test_every_command_has_its_row():
    page = text(DOCS / 'command.md')
    missing = [f'rlml {name}' for name in rows_of(COMMANDS) if f'`rlml {name}' not in page]
    missing += [f'rlml-lab {name}' for name in rows_of(LAB) if f'`rlml-lab {name}' not in page]
    assert not missing


def options_of(parser):
    found = set(parser._option_string_actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                found |= options_of(sub)
    return found


@pytest.mark.parametrize('page', CURRENT, ids=lambda p: p.name)
def test_named_commands_and_options_exist(page):
    for code in code_of(page):
        for prog, rest in re.findall(r'(?<![\w.-])(rlml(?:-lab)?) ([a-z][^|#]*)', code):
            if 'ros2' in code and prog == 'rlml' and 'rlml_slam' not in code:
                continue
            table = COMMANDS if prog == 'rlml' else LAB
            words = rest.split()
            assert words[0] in table, code
            entry = table[words[0]]
            if isinstance(entry, Group):
                if len(words) == 1 or not re.match(r'[a-z-]+$', words[1]):
                    continue
                assert words[1] in entry.commands, code
            parser, _ = build_parser(words[:2], table, prog)
            options = set(re.findall(r'(?<!\w)--[a-z][a-z-]*', rest))
            assert options <= options_of(parser) | {'--help', '--ros-args'}, code


def test_messages_that_the_docs_explain_are_those_of_the_code():
    page = text(DOCS / 'tuning.md')
    rows = page.split('| what you see |')[1].split('\n\n')[0].splitlines()[2:]
    code = '\n'.join(text(p) for p in (ROOT / 'rlml_slam').rglob('*.py'))
    messages = [m[1] for row in rows if (m := re.match(r'\| `([^`]*)` +\|', row))]
    assert len(messages) > 4
    for message in messages:
        parts = [part.strip() for part in message.split('…') if part.strip(' :')]
        assert all(part in code for part in parts), message


def test_benchmarks_are_those_of_the_results():
    made = results.page(results.read(ROOT / results.RESULTS))
    assert text(DOCS / 'benchmarks.md') == made, 'rlml-lab results --write docs/benchmarks.md'


def test_accuracy_is_taken_from_pins():
    figures = {'ate_m': 0.01, 'wall_s': 2.0, 'trans_mean_m': 0.02, 'rot_mean_deg': 0.3}
    names = ['intel', 'fr079', 'hall', 'room', 'hall_ekf', 'room_no_odometry', 'room_map']
    names += [f'mrclam6_{robot}{s}' for robot in results.ROBOTS for s in ('', '_no_ids')]
    rows = results.accuracy_rows({name: {'figures': figures} for name in names})
    assert rows[0] == ['Intel Research Lab: mean over all relations', '0.0200 m, 0.300°', '2 s']
    assert rows[2][1:] == ['1.0, 1.0, 1.0, 1.0, 1.0 cm', '10 s']


def test_every_page_is_in_the_navigation():
    nav = set(re.findall(r': ([\w/]+\.md)$', text(ROOT / 'mkdocs.yml'), re.MULTILINE))
    assert nav == {p.name for p in DOCS.glob('*.md')}


def test_pictures_are_small():
    for path in DOCS.glob('*.png'):
        assert path.stat().st_size <= 300_000
