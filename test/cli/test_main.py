# SPDX-License-Identifier: Apache-2.0
"""The command line as a whole: exit codes, lazy imports, one line for a user's mistake."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from rlml_lab.main import COMMANDS as LAB
from rlml_slam.cli import main as command_line
from rlml_slam.cli.main import COMMANDS, Command, Group, main
from rlml_slam.errors import FileFormatError


def entries():
    for name, entry in [*COMMANDS.items(), *LAB.items()]:
        if isinstance(entry, Group):
            yield from ((f'{name} {sub}', command) for sub, command in entry.commands.items())
        else:
            yield name, entry


def test_help_imports_no_command():
    code = (
        'import sys; from rlml_slam.cli.main import main\n'
        'try: main(["--help"])\n'
        'except SystemExit: pass\n'
        'print([m for m in ("numpy", "numba", "matplotlib", "rich") if m in sys.modules])'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == '[]'
    for name in COMMANDS:
        assert name in done.stdout


@pytest.mark.parametrize(
    ('words', 'what'),
    [
        (['evaluate', 'ate', 'a', 'b', '--max-gap', 'nan'], 'nan is not between 0 and inf'),
        (
            ['convert', 'carmen', 'a', 'b', '--field-of-view', '-10'],
            '-10 is not between 1 and 360',
        ),
        (['check', '--seconds', '-1'], '-1 is not between 0.1 and 100000'),
        (['plan', 'room', '--out', 'p', '--clearance', '-1'], '-1 is not between 0 and 100'),
        (['map', 'merge', 'a', 'b', '--out', 'c', '--jobs', '-3'], '-3 is not between 0 and 256'),
    ],
)
def test_number_out_of_bounds_is_named(words, what, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert what in capsys.readouterr().err


def test_numbers_say_their_default(capsys):
    with pytest.raises(SystemExit):
        main(['check', '--help'])
    assert 'to listen (default: 10.0)' in ' '.join(capsys.readouterr().out.split())


def test_module_runs_as_the_command():
    done = subprocess.run(
        [sys.executable, '-m', 'rlml_slam', '--version'], capture_output=True, text=True
    )
    assert done.returncode == 0
    assert done.stdout.startswith('rlml ')


@pytest.mark.parametrize(
    ('words', 'meant'),
    [(['repaly', 'bag'], 'replay'), (['map', 'impot'], 'import'), (['--version', 'repaly'], '')],
)
def test_misspelled_command_is_suggested(words, meant, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == (2 if meant else 0)
    assert (f"is '{meant}' meant?" in capsys.readouterr().err) == bool(meant)


def test_command_that_is_like_none_lists_all(capsys):
    with pytest.raises(SystemExit):
        main(['xyzzy'])
    err = capsys.readouterr().err
    assert 'invalid choice' in err
    assert all(name in err for name in COMMANDS)


@pytest.mark.parametrize(('name', 'command'), list(entries()))
def test_table_says_what_the_command_says(name, command):
    if command.module in ('rlml_slam.cli.demo', 'rlml_slam.cli.live'):
        pytest.importorskip('rclpy', reason='needs ROS 2 or its wheels')
    module = importlib.import_module(command.module)
    subparsers = argparse.ArgumentParser().add_subparsers()
    module.add_parser(subparsers)
    # the table knows name and help without importing it
    (action,) = subparsers._choices_actions
    assert (action.dest, action.help) == (name.rsplit(' ')[-1], command.help)
    assert callable(module.run)


@pytest.mark.parametrize('arguments', [[], ['nonsense'], ['evaluate'], ['replay', 'bag'], ['-x']])
def test_wrong_command_line_is_exit_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as e:
        main(arguments)
    assert e.value.code == 2
    assert 'usage: rlml' in capsys.readouterr().err


def run_with(monkeypatch, run):
    module = SimpleNamespace(add_parser=lambda subparsers: subparsers.add_parser('do'), run=run)
    monkeypatch.setattr(command_line, '_load', lambda name, command: module)
    return main(['do'], {'do': Command('do', 'something')})


def test_expected_error_is_one_line_and_exit_code_1(monkeypatch, capsys):
    def run(args):
        raise FileFormatError('x.log:3: broken')

    assert run_with(monkeypatch, run) == 1
    out, err = capsys.readouterr()
    assert (out, err) == ('', 'rlml: x.log:3: broken\n')


def test_bug_is_a_traceback(monkeypatch):
    def run(args):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_with(monkeypatch, run)


def test_interrupt_is_exit_code_130(monkeypatch, capsys):
    def run(args):
        raise KeyboardInterrupt

    assert run_with(monkeypatch, run) == 130


@pytest.mark.parametrize(
    ('output', 'code', 'said'),
    [
        ('', 141, ''),  # a pipe that nobody reads
        ('> /dev/full', 1, 'rlml: cannot write: No space left on device\n'),
        ('>&-', 0, ''),
        ('> out.txt', 0, ''),
    ],
)
def test_output_that_goes_nowhere_is_no_traceback(output, code, said, tmp_path):
    (tmp_path / 'a.tum').write_text('1.0 1 2 0 0 0 0 1\n2.0 1 2 0 0 0 0 1\n')
    (tmp_path / 'r').write_text('1 2 0 0 0 0 0 0\n')
    line = f'"{sys.executable}" -m rlml_slam.cli.main evaluate relations a.tum r {output}'
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        ['bash', '-c', line], cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONIOENCODING': 'ascii', 'PYTHONPATH': os.getcwd()},
    )  # fmt: skip
    os.close(writer)
    assert (done.returncode, done.stderr) == (code, said)
    if output == '> out.txt':
        assert r'0.0000 \xb1 0.0000 m' in (tmp_path / 'out.txt').read_text()


def test_missing_package_is_named(capsys):
    table = {'do': Command('rlml_slam.cli.no_such_module', 'something')}
    assert main(['do'], table) == 1
    assert "no command 'do'" in capsys.readouterr().err


def test_missing_dependency_is_named(monkeypatch, capsys):
    def fail(name):
        raise ModuleNotFoundError("No module named 'gtsam'", name='gtsam')

    monkeypatch.setattr(command_line.importlib, 'import_module', fail)
    assert main(['do'], {'do': Command('do', 'something')}) == 1
    assert "do needs the Python package 'gtsam'" in capsys.readouterr().err


def test_json_is_all_that_stdout_gets(tmp_path, capsys):
    path = tmp_path / 'a.tum'
    path.write_text('1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n')
    assert main(['evaluate', 'ate', str(path), str(path), '--json']) == 0
    out, _ = capsys.readouterr()
    assert json.loads(out)['rmse_m'] == 0.0
    assert main(['evaluate', 'ate', str(path), str(path), '--align']) == 0
    assert 'rmse 0.0000 m' in capsys.readouterr().out


def test_relations_are_evaluated(tmp_path, capsys):
    trajectory, relations = tmp_path / 'a.tum', tmp_path / 'a.relations'
    trajectory.write_text('1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n')
    relations.write_text('1.0 2.0 1 0.1 0 0 0 0\n')
    arguments = ['evaluate', 'relations', str(trajectory), str(relations)]
    assert main([*arguments, '--json']) == 0
    assert json.loads(capsys.readouterr().out)['trans_mean_m'] == pytest.approx(0.1)
    assert main(arguments) == 0
    assert '0.1000 ± 0.0000 m' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('line', 'expected'),
    [
        ('rlml re', {'replay'}),
        ('rlml map in', {'info'}),
        ('rlml call ', {'save_map', 'load_map', 'relocalize'}),
        ('rlml replay --sy', {'--system'}),
    ],
)
def test_shells_complete(line, expected, tmp_path):
    env = os.environ | {
        '_ARGCOMPLETE': '1', '_ARGCOMPLETE_STDOUT_FILENAME': str(tmp_path / 'out'),
        'COMP_LINE': line, 'COMP_POINT': str(len(line)), '_ARGCOMPLETE_IFS': '\n',
    }  # fmt: skip
    command = [sys.executable, '-m', 'rlml_slam.cli.main']
    done = subprocess.run(command, env=env, capture_output=True, check=False)
    assert done.stderr == b''
    found = {word.strip() for word in (tmp_path / 'out').read_text().split('\n')}
    assert expected <= found
