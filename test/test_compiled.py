# SPDX-License-Identifier: Apache-2.0
"""Kernels that were compiled from other sources are not used."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import rlml_slam
from rlml_slam.kernels.cache import remove_stale


@pytest.fixture
def package(tmp_path):
    """A package whose kernel has a constant of another file built in."""
    folder = tmp_path / 'some'
    folder.mkdir()
    (folder / '__init__.py').write_text('')
    (folder / 'constants.py').write_text('N = 1\n')
    (folder / 'kernels.py').write_text(
        'from pathlib import Path\n'
        'from rlml_slam.compiled import kernel\n'
        'from rlml_slam.kernels.cache import remove_stale\n'
        'remove_stale(Path(__file__).parent)\n'
        'from some.constants import N\n'
        '@kernel\n'
        'def answer(x):\n'
        '    return x + N\n'
    )
    return folder


def answer(package, cache=None):
    """What the kernel answers to 10 in a new process; ``cache`` is Numba's folder."""
    code = 'from some.kernels import answer; print(answer(10))'
    path = f'{package.parent}:{Path(rlml_slam.__file__).parents[1]}'
    cache_env = {} if cache is None else {'NUMBA_CACHE_DIR': str(cache)}
    done = subprocess.run(
        [sys.executable, '-c', code],
        env={
            'PYTHONPATH': path, 'HOME': str(package.parent), 'RLML_SLAM_KERNELS': 'jit',
            **cache_env,
        },
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return int(done.stdout)


def test_constant_that_changed_in_another_file_is_used(package):
    assert answer(package) == 11
    assert list(package.glob('__pycache__/*.nbi'))
    (package / 'constants.py').write_text('N = 25\n')
    assert answer(package) == 35


def test_folder_that_numba_is_told_to_use_is_looked_at(package, tmp_path):
    cache = tmp_path / 'cache'
    assert answer(package, cache) == 11
    (compiled,) = cache.glob('some_*/kernels.answer-*.nbi')
    before = compiled.stat().st_mtime_ns
    assert answer(package, cache) == 11
    assert compiled.stat().st_mtime_ns == before
    (package / 'constants.py').write_text('N = 25\n')
    assert answer(package, cache) == 35
    assert not list(package.glob('__pycache__/*.nbi'))


def test_kernels_of_the_same_sources_stay(package):
    remove_stale(package)
    compiled = package / '__pycache__' / 'kernels.answer.nbi'
    compiled.touch()
    remove_stale(package)
    assert compiled.exists()
    (package / 'more.py').write_text('')
    (package / 'constants.py').touch()
    remove_stale(package)
    assert compiled.exists()


@pytest.mark.parametrize('changed', ['constants.py', 'kernels.py', '__init__.py', 'deep/base.py'])
def test_kernel_goes_with_a_source_that_it_is_made_of(package, changed):
    (package / 'deep').mkdir()
    (package / 'deep' / '__init__.py').write_text('')
    (package / 'deep' / 'base.py').write_text('M = 1\n')
    (package / 'constants.py').write_text('from some.deep import base\nN = base.M\n')
    remove_stale(package)
    compiled = package / '__pycache__' / 'kernels.answer.nbi'
    compiled.touch()
    with (package / changed).open('a') as source:
        source.write('# changed\n')
    remove_stale(package)
    assert not compiled.exists()


def test_kernel_stays_where_only_the_api_changes(package):
    (package / '__init__.py').write_text('def f():\n    from some.api import g\n')
    (package / 'api.py').write_text('g = 1\n')
    remove_stale(package)
    compiled = package / '__pycache__' / 'kernels.answer.nbi'
    compiled.touch()
    (package / 'api.py').write_text('g = 2\n')
    remove_stale(package)
    assert compiled.exists()


def test_every_file_with_kernels_is_known():
    """One that is not would keep kernels of other sources."""
    package = Path(rlml_slam.__file__).parent
    remove_stale(package)
    known = json.loads((package / '__pycache__' / 'kernels.stamp').read_text())
    for compiled in package.rglob('__pycache__/*.nbi'):
        source = compiled.parents[1] / (compiled.name.split('.')[0] + '.py')
        # those of a file that was moved are never read again
        assert not source.exists() or source.relative_to(package).as_posix() in known


def test_folder_that_cannot_be_written_to_is_no_error(package):
    (package / '__pycache__').write_text('not a folder')
    remove_stale(package)
