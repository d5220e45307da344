# SPDX-License-Identifier: Apache-2.0
"""The command ``rlml``: a table of subcommands, each imported only when it is used.

A subcommand is a module with ``add_parser(subparsers)`` and ``run(args) -> int``.
An expected error is one line on stderr and exit code 1, or ``ERROR_CODE`` of the module where 1 is
an answer. A wrong command line is exit code 2, and a bug is a traceback.
"""

from __future__ import annotations

import argparse
import difflib
import errno
import importlib
import io
import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

from rlml_slam.errors import RlmlError
from rlml_slam.interrupts import held_interrupts
from rlml_slam.version import __version__

INTERRUPTED, BROKEN_PIPE = 130, 141  # what a shell reports for Ctrl-C, and for `… | head`


@dataclass(frozen=True)
class Command:
    """A subcommand: its module and what ``--help`` says about it."""

    module: str
    help: str


@dataclass(frozen=True)
class Group:
    """Subcommands under one name."""

    help: str
    commands: Mapping[str, Command]


Table: TypeAlias = Mapping[str, Command | Group]

COMMANDS: Table = {
    'demo': Command(
        'rlml_slam.cli.demo', 'simulator, front end and back end live over DDS, then a report'
    ),
    'replay': Command(
        'rlml_slam.cli.replay', 'run the system over a bag: no topics, deterministic'
    ),
    'warm-up': Command(
        'rlml_slam.cli.warm_up', 'compile the kernels once, into the package or else for this user'
    ),
    'live': Command('rlml_slam.cli.live', 'play a bag to the live nodes, then a report'),
    'view': Command(
        'rlml_slam.cli.view.view', 'running nodes in a browser: map, plots and health, live'
    ),
    'convert': Command('rlml_slam.cli.convert', 'a recorded log becomes a bag'),
    'evaluate': Command(
        'rlml_slam.cli.evaluate', 'errors of a trajectory against relations or ground truth'
    ),
    'simulate': Command(
        'rlml_slam.cli.simulate', 'write a bag of a drive through a synthetic world'
    ),
    'map': Group(
        'saved maps',
        {
            'info': Command(
                'rlml_slam.cli.map.map_info', 'check a saved map and say what is in it'
            ),
            'import': Command(
                'rlml_slam.cli.map.map_import', 'text files as a saved map: CSV, g2o, PGM and YAML'
            ),
            'merge': Command('rlml_slam.cli.map.map_merge', 'saved maps of many sessions as one'),
            'reflectors': Command(
                'rlml_slam.cli.map.map_reflectors',
                'which reflectors are there, new, moved, missing or ghosts',
            ),
            'survey': Command(
                'rlml_slam.cli.map.map_survey',
                'reflectors of a saved map against where they were surveyed',
            ),
            'export': Command(
                'rlml_slam.cli.map.map_export', 'a saved map as text: CSV, g2o, TUM, PGM and YAML'
            ),
        },
    ),
    'plan': Command(
        'rlml_slam.cli.layout.plan', 'accuracy and uniqueness that a layout of reflectors gives'
    ),
    'audit': Command(
        'rlml_slam.cli.layout.audit', 'a run against its planned layout: what is not as planned'
    ),
    'compare': Command(
        'rlml_slam.cli.compare', 'two runs of one bag: what differs, and where they part'
    ),
    'closures': Command(
        'rlml_slam.cli.closures', 'loop closures of a replay or of a running back end; revoke one'
    ),
    'call': Command(
        'rlml_slam.cli.call', 'a service of a running node: save_map, relocalize and so on'
    ),
    'optimize': Command('rlml_slam.cli.optimize', 'optimise a pose graph file (g2o, TORO)'),
    'doctor': Command(
        'rlml_slam.cli.doctor',
        'what the scans of a bag are like, and a threshold for its reflectors',
    ),
    'check': Command(
        'rlml_slam.cli.check', 'a running robot: topics, transforms and clocks, and what is wrong'
    ),
    'docs': Command(
        'rlml_slam.cli.docs',
        'the tables of topics, services and parameters, from the declarations in the code',
    ),
}


def main(
    argv: Sequence[str] | None = None,
    table: Table = COMMANDS,
    prog: str = 'rlml',
    description: str = '2D SLAM and localization with reflectors and a laser.',
) -> int:
    """Run one command line of the command ``prog``; the exit code."""
    module: ModuleType | None = None
    try:
        # not every terminal has ±, or all file names
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors='backslashreplace')
        if '_ARGCOMPLETE' in os.environ:
            complete(table, prog)
        arguments = list(sys.argv[1:] if argv is None else argv)
        parser, module = build_parser(arguments, table, prog, description)
        args = parser.parse_args(arguments)
        if module is None:
            parser.error('a command is missing')
        args.command_line = shlex.join([prog, *arguments])
        code = int(module.run(args))
        print(end='', flush=True)  # which a closed stdout takes as well
        return code
    except RlmlError as e:
        print(f'{prog}: {e}', file=sys.stderr)
        return int(getattr(module, 'ERROR_CODE', 1))
    except KeyboardInterrupt:
        print(f'{prog}: interrupted', file=sys.stderr)
        return INTERRUPTED
    except OSError as e:
        if e.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        # the reader of our output went away, or its disk is full: what still waits goes nowhere
        if sys.stdout is not None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if e.errno == errno.EPIPE:
            return BROKEN_PIPE
        print(f'{prog}: cannot write: {e.strerror}', file=sys.stderr)
        return int(getattr(module, 'ERROR_CODE', 1))


def complete(table: Table, prog: str) -> None:
    """Answer a shell that asks for completions of its line, and end the process."""
    import argcomplete

    line, point = os.environ['COMP_LINE'], int(os.environ['COMP_POINT'])
    parser, _ = build_parser(line.encode()[:point].decode().split()[1:], table, prog)
    argcomplete.autocomplete(parser)


def build_parser(
    arguments: Sequence[str], table: Table = COMMANDS, prog: str = 'rlml', description: str = ''
) -> tuple[argparse.ArgumentParser, ModuleType | None]:
    """The parser for a command line, and the module of the command it names.

    Only that module is imported, so that ``--help`` costs nothing.
    """
    parser = argparse.ArgumentParser(prog=prog, description=description)
    parser.add_argument('--version', action='version', version=f'{prog} {__version__}')
    return parser, _add_commands(parser, table, list(arguments))


def _add_commands(
    parser: argparse.ArgumentParser, table: Table, arguments: Sequence[str]
) -> ModuleType | None:
    """Add the table to a parser; the module of the command that the arguments begin with."""
    subparsers = parser.add_subparsers(metavar='COMMAND', title='commands', required=True)
    words = [a for a in arguments if not a.startswith('-')]
    wanted = words[0] if words and words[0] == next(iter(arguments), None) else None
    if wanted is not None and wanted not in table and '_ARGCOMPLETE' not in os.environ:
        for near in difflib.get_close_matches(wanted, table, n=1):
            parser.error(f'there is no command {wanted!r}; is {near!r} meant?')
    module = None
    for name, entry in table.items():
        if name != wanted:
            subparsers.add_parser(name, help=entry.help, add_help=False)
        elif isinstance(entry, Group):
            group = subparsers.add_parser(name, help=entry.help, description=entry.help)
            module = _add_commands(group, entry.commands, arguments[1:])
        else:
            module = _load(name, entry)
            module.add_parser(subparsers)
            _state_defaults(subparsers.choices[name])
    return module


def _state_defaults(parser: argparse.ArgumentParser) -> None:
    """Add to the help of each number what it is unless given."""
    for action in parser._actions:
        is_number = type(action.default) in (int, float) and action.nargs != 0
        if is_number and 'default' not in (action.help or ''):
            action.help = f'{action.help or ""} (default: %(default)s)'.lstrip()


def between(low: float, high: float) -> Callable[[str], float]:
    """The ``type`` of an argument that is a number from ``low`` to ``high``; NaN is none."""

    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f'{text} is not between {low:g} and {high:g}')
        return value

    return number


def _load(name: str, command: Command) -> Any:
    """The module of a command; one line of advice if what it needs is not installed."""
    try:
        with held_interrupts() as check:
            module = importlib.import_module(command.module)
            check()
        return module
    except ModuleNotFoundError as e:
        missing = e.name or ''
        if missing == command.module:
            raise RlmlError(f'this installation has no command {name!r}') from e
        if missing.split('.')[0] in ('rlml_slam', 'rlml_lab'):
            raise
        raise RlmlError(f'{name} needs the Python package {missing!r}; install it') from e


if __name__ == '__main__':
    sys.exit(main())
