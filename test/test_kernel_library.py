# SPDX-License-Identifier: Apache-2.0
"""Kernels of a library do what Numba's own do, and check what they are given."""

import multiprocessing
import os
import pickle
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import pytest

from rlml_slam import compiled, warm_up  # noqa: F401, so that it is known whether there is one
from rlml_slam.kernels import build, built, library, missing, native
from rlml_slam.kernels.emit import check_of, dumps, emit_into, entries_of
from rlml_slam.kernels.library import Index, Library

PACKAGE = Path(library.__file__).parents[1]


class Pair(NamedTuple):
    values: np.ndarray
    scale: float


def scaled(pair, k, on, out):
    """Writes into ``out``; a negative k raises."""
    if k < 0:
        raise ValueError('k is negative')
    if on:
        out[:] = pair.values * pair.scale + k
    return pair, out.sum()


def read(rows):
    return rows['a'].sum()


ROWS = np.zeros(3, [('a', np.int64), ('b', np.float64)])


def arguments(n=4):
    return Pair(np.arange(n, dtype=float), 2.0), 3, True, np.zeros(n)


@numba.njit(no_cpython_wrapper=True)
def long_sum(values):
    """Too large to be copied into what calls it."""
    total = 0.0
    for k in range(len(values) - 1):
        if values[k] > values[k + 1]:
            total += np.linalg.solve(np.eye(2) * values[k], np.ones(2)).sum()
        total += np.sort(values)[k]
    return total


VALUES = np.array([3.0, 2.0, 4.0])
SUM = 2 / 3 + 2.0 + 3.0  # of them, by long_sum


def first(values):
    return long_sum(values) + 1.0


def second(values):
    return long_sum(values) + 2.0


def emitted(work):
    """In a process of its own: entries and constants, and what the kernels return there."""
    objects = emit_into(work, library.best_processor())
    entries, results = [], []
    called = ((scaled, arguments()), (read, (ROWS,)), (first, (VALUES,)), (second, (VALUES,)))
    for function, given in called:
        dispatcher = numba.njit(error_model='numpy')(function)
        results.append(dispatcher(*given))
        entries += entries_of(f'{function.__module__}.{function.__name__}', dispatcher)
    constants = {name: dumps(of.consts) for name, of in objects.environments.items()}
    return entries, constants, results


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A library of some kernels, and the decorator that takes them from it."""
    work = tmp_path_factory.mktemp('library')
    runtime = build._start_runtime(work)
    with multiprocessing.get_context('spawn').Pool(1) as pool:
        entries, constants, results = pool.apply(emitted, (work,))
    assert (results[0][1], *results[1:]) == (24.0, 0, SUM + 1.0, SUM + 2.0)
    build._write_table(work / 'entries.h', entries, constants)
    build._link(work, runtime)
    index = Index((), '', 'generic', {e.kernel: [(e.check, e.name)] for e in entries})
    path = work / library.LIBRARY
    return native.kernel_of(Library(path, index, library._load(path)))


@pytest.fixture
def kernel(made):
    native.CONVERTED.clear()
    return made(scaled)


def test_it_computes_returns_and_raises_as_the_function_does(kernel):
    pair, k, on, out = arguments()
    same, total = kernel(pair, k, on, out)
    np.testing.assert_array_equal(out, [3.0, 5.0, 7.0, 9.0])
    assert total == 24.0
    assert type(same) is Pair
    np.testing.assert_array_equal(same.values, pair.values)
    with pytest.raises(ValueError, match='k is negative'):
        kernel(pair, -1, on, out)
    assert kernel.__doc__ == scaled.__doc__
    assert not native.CONVERTED


def test_large_function_is_compiled_once_for_all_that_call_it(made):
    assert made(first)(VALUES) == SUM + 1.0
    assert made(second)(VALUES) == SUM + 2.0


def test_array_of_records_is_taken(made):
    rows = ROWS.copy()
    rows['a'] = 5
    assert made(read)(rows) == 15
    with pytest.raises(TypeError, match='array of'):
        made(read)(np.zeros(3))


def test_view_is_written_through(kernel):
    wide = np.zeros((4, 2))
    kernel(arguments()[0], np.int64(3), np.bool_(True), wide[:, 1])
    np.testing.assert_array_equal(wide[:, 1], [3.0, 5.0, 7.0, 9.0])
    assert not wide[:, 0].any()
    assert native.CONVERTED.total() == 1


def test_whole_numbers_and_names_are_taken(kernel):
    out = np.zeros(4)
    kernel(Pair(np.arange(4), 2), k=3, on=True, out=out)
    np.testing.assert_array_equal(out, [3.0, 5.0, 7.0, 9.0])


@pytest.mark.parametrize(
    ('wrong', 'why'),
    [
        (('pair', 3, True, np.zeros(4)), 'a Pair of 2'),
        ((arguments()[0], 3.5, True, np.zeros(4)), 'an integer'),
        ((arguments()[0], 3, 1, np.zeros(4)), 'True or False'),
        ((arguments()[0], 3, True, np.zeros((4, 1))), '1 dimensions'),
        ((arguments()[0], 3, True, np.zeros(4, complex)), 'of complex128'),
        ((Pair(np.zeros(4), 'x'), 3, True, np.zeros(4)), 'a number'),
        ((arguments()[0], 3, True, None), 'an array'),
    ],
)
def test_what_it_was_not_compiled_for_is_refused(kernel, wrong, why):
    with pytest.raises(TypeError, match=why):
        kernel(*wrong)


def test_arguments_that_cannot_come_from_python_have_no_entry():
    assert check_of(numba.types.literal(3)) is None
    assert check_of(numba.float64[:, :]) is None
    assert check_of(numba.float32) is None


EVERY_KERNEL = """
import sys
from rlml_slam import compiled, warm_up
warm_up.import_core()
for name, module in sorted(sys.modules.items()):
    for value in vars(module).values() if name.startswith('rlml_slam') else ():
        if type(value) is compiled.LIBRARY.module.Kernel:
            kernel = f'{value.__module__}.{value.__name__}'
            if kernel not in compiled.LIBRARY.index.entries:
                print(kernel)
"""


@pytest.mark.skipif(not warm_up.has_library(), reason='the sources have no library: rlml warm-up')
def test_every_kernel_of_the_package_is_in_its_library():
    done = subprocess.run(
        [sys.executable, '-c', EVERY_KERNEL], capture_output=True, text=True, check=True
    )
    assert not done.stdout


@native.part
def plus(a, b):
    return a + offset(b)


@native.formula
def offset(b):
    return b + 1.0


def total(values):
    """Sum of the values and one each."""
    s = 0.0
    for v in values:
        s = plus(s, v)
    return s


def test_a_kernel_that_the_library_lacks_is_compiled_with_its_parts(made):
    kernel = made(total)
    assert kernel(np.arange(3.0)) == 6.0
    assert kernel(values=np.arange(2)) == 3.0
    assert isinstance(missing.compiled(total), numba.core.dispatcher.Dispatcher)


def test_library_of_other_sources_or_processors_is_not_used(tmp_path):
    (tmp_path / 'a.py').write_text('N = 1\n')
    index = Index(('a.py',), library.digest(tmp_path, ('a.py',)), library.best_processor(), {})
    assert library.fits(index, tmp_path)
    (tmp_path / 'a.py').write_text('N = 2\n')
    assert not library.fits(index, tmp_path)
    (tmp_path / 'a.py').unlink()
    assert not library.fits(index, tmp_path)
    assert not library.runs('another')
    assert library.runs(library.best_processor())


def test_damaged_index_is_no_library(tmp_path):
    assert library.read_index(tmp_path) is None
    (tmp_path / library.LIBRARY).write_bytes(b'')
    good = pickle.dumps(asdict(Index((), '', 'generic', {})))
    for text in (b'', b'nonsense', good[:-3], pickle.dumps(5), pickle.dumps({'sources': ()})):
        (tmp_path / library.INDEX).write_bytes(text)
        assert library.read_index(tmp_path) is None
    (tmp_path / library.INDEX).write_bytes(good)
    assert library.read_index(tmp_path) is not None


def test_without_a_compiler_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(build.shutil, 'which', lambda _: None)
    with pytest.raises(build.BuildError, match='install gcc'):
        build._compiler()


def end_of_process():
    """In a process that compiles: what the system does where memory is short."""
    os._exit(9)


def test_process_that_ends_while_it_compiles_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setattr(build, '_folders', end_of_process)
    monkeypatch.setattr(build.os, 'environ', dict(os.environ))
    with pytest.raises(build.BuildError, match='has ended'):
        build._compile(tmp_path, 'generic', lambda *_: None)


@pytest.fixture
def compilations(monkeypatch, tmp_path):
    """How often the library is compiled: a stand-in whose content is the count."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    done = []

    def make(folder, index, _progress):
        done.append(index)
        (folder / library.LIBRARY).write_text(str(len(done)))
        (folder / library.INDEX).write_bytes(pickle.dumps(asdict(index)))

    monkeypatch.setattr(build, '_make', make)
    return done


def build_in(folder, processor='x86-64', force=False):
    return build.build(folder, processor, lambda *_: None, force).read_text()


def test_same_sources_are_compiled_once_for_all_folders(compilations, tmp_path):
    assert build_in(tmp_path / 'tree') == '1'
    assert build_in(tmp_path / 'wheel') == '1'
    assert library.read_index(tmp_path / 'wheel') == compilations[0]
    assert sorted(os.listdir(tmp_path / 'wheel')) == sorted([library.LIBRARY, library.INDEX])
    assert build_in(tmp_path / 'wheel', force=True) == '2'
    assert build_in(tmp_path / 'other') == '2'


@pytest.mark.parametrize('changed', ['processor', 'sources', 'numba', 'makers'])
def test_what_was_made_otherwise_is_compiled_again(compilations, tmp_path, monkeypatch, changed):
    build_in(tmp_path / 'tree')
    if changed == 'sources':
        monkeypatch.setattr(build, 'sources_of', lambda _: ('errors.py',))
    elif changed == 'numba':
        monkeypatch.setattr(built.importlib.metadata, 'version', lambda _: '0')
    elif changed == 'makers':
        monkeypatch.setattr(built, 'MAKERS', ('build.py',))
    processor = 'x86-64-v2' if changed == 'processor' else 'x86-64'
    assert build_in(tmp_path / 'wheel', processor) == '2'


def test_libraries_not_used_for_longest_are_dropped(compilations, tmp_path, monkeypatch):
    for k, version in enumerate('abcad'):
        monkeypatch.setattr(built.importlib.metadata, 'version', lambda _, v=version: v)
        build_in(tmp_path / 'tree')
        place = built.place_of(PACKAGE, compilations[-1])
        os.utime(place, (k, k))
    assert len(compilations) == 4
    monkeypatch.setattr(built.importlib.metadata, 'version', lambda _: 'a')
    assert build_in(tmp_path / 'tree') == '1'
    monkeypatch.setattr(built.importlib.metadata, 'version', lambda _: 'b')
    assert build_in(tmp_path / 'tree') == '5'


def test_without_a_cache_nothing_is_kept_and_all_is_built(compilations, tmp_path):
    (tmp_path / 'cache').write_text('a file where a folder should be')
    assert build_in(tmp_path / 'tree') == '1'
    assert build_in(tmp_path / 'wheel') == '2'
