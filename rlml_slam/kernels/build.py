# SPDX-License-Identifier: Apache-2.0
"""Makes the library of kernels: Numba compiles in several processes, the C compiler links."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rlml_slam.errors import RlmlError
from rlml_slam.kernels import built, library
from rlml_slam.kernels.cache import sources_of
from rlml_slam.kernels.emit import Entry, dumps, emit_into, entries_of

PACKAGE = Path(__file__).parents[1]
MEMORY = 1.5e9  # [bytes] that a process compiling all kernels may need
LONGEST = ('graph', 'matching', 'slam', 'deformable', 'sensing')  # to compile
TICK = 1.0  # [s] at which progress is reported
Progress = Callable[[int, int, str], None]  # done, of how many, the last module
Compiled = tuple[list[Entry], dict[str, bytes]]  # with the constants of all functions, pickled


class BuildError(RlmlError):
    """The library cannot be made here; kernels are then compiled when first called."""


def build(folder: Path, processor: str, progress: Progress, force: bool = False) -> Path:
    """Make the library of the package's sources in ``folder``; its path.

    One that this user has built of the same sources is copied, unless ``force``.
    Raises BuildError where there is no C compiler, and OSError where ``folder`` is read-only.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sources = sources_of(PACKAGE)
    index = library.Index(sources, library.digest(PACKAGE, sources), processor, {})
    place = built.place_of(PACKAGE, index)
    if force or place is None or not built.take(place, folder):
        _make(folder, index, progress)
        if place is not None:
            built.keep(folder, place)
    return folder / library.LIBRARY


def _make(folder: Path, index: library.Index, progress: Progress) -> None:
    """Compile and link into ``folder``; fills the entries of ``index``."""
    with tempfile.TemporaryDirectory(prefix='.kernels-', dir=folder) as name:
        work = Path(name)
        runtime = _start_runtime(work)
        entries, constants = _compile(work, index.processor, progress)
        for entry in entries:
            index.entries.setdefault(entry.kernel, []).append((entry.check, entry.name))
        _write_table(work / 'entries.h', entries, constants)
        _link(work, runtime)
        (work / library.INDEX).write_bytes(pickle.dumps(asdict(index)))
        # the index last: a library with another one's index would be of other sources
        (folder / library.INDEX).unlink(missing_ok=True)
        os.replace(work / library.LIBRARY, folder / library.LIBRARY)
        os.replace(work / library.INDEX, folder / library.INDEX)


def _compile(work: Path, processor: str, progress: Progress) -> Compiled:
    """All kernels; the modules are shared out among processes."""
    os.environ |= {
        library.BY_USER: 'jit', 'RLML_SLAM_NO_CACHE': '1',
        'NUMBA_CPU_NAME': processor, 'NUMBA_CPU_FEATURES': '',
    }  # fmt: skip
    free = os.sysconf('SC_AVPHYS_PAGES') * os.sysconf('SC_PAGE_SIZE')
    workers = max(1, min(len(os.sched_getaffinity(0)), int(free / MEMORY)))
    found: dict[str, list[Entry]] = {}
    constants: dict[str, bytes] = {}
    others = {*multiprocessing.active_children()}
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context('spawn'))
    try:
        folders = pool.submit(_folders).result()
        waiting = {pool.submit(_compile_folder, work, processor, f) for f in folders}
        last, done = '', 0
        while waiting:
            progress(done, sum(map(len, folders)), last)
            ready, waiting = wait(waiting, TICK, FIRST_COMPLETED)
            for folder, entries, of_folder in (future.result() for future in ready):
                last, done = folder[-1], done + len(folder)
                # two processes may have compiled the same kernel; either will do
                found = entries | found
                constants |= of_folder
    except BrokenProcessPool as e:
        raise BuildError('a process that compiles kernels has ended: is memory short?') from e
    finally:
        for worker in {*multiprocessing.active_children()} - others:  # interrupted, they are idle
            worker.terminate()
        pool.shutdown(cancel_futures=True)
    return [entry for name in sorted(found) for entry in found[name]], constants


def _folders() -> list[list[str]]:
    """Modules with kernels by folder, as its kernels have parts in common; the longest first."""
    from rlml_slam import warm_up

    warm_up.import_core()
    folders: dict[str, list[str]] = {name: [] for name in LONGEST}
    for name, _ in warm_up.loaded():
        folders.setdefault(name.split('.')[1], []).append(name)
    return list(folders.values())


def _compile_folder(
    work: Path, processor: str, names: list[str]
) -> tuple[list[str], dict[str, list[Entry]], dict[str, bytes]]:
    """In a process of its own: what the warm-ups of modules compile."""
    from rlml_slam import warm_up
    from rlml_slam.kernels import jit

    warm_up.import_core()
    objects = emit_into(work, processor)
    known = dict(warm_up.loaded())
    for name in names:
        known[name]()
    made = {
        kernel: entries_of(kernel, dispatcher)
        for kernel, dispatcher in jit.KERNELS.items()
        if dispatcher.overloads and kernel not in _EMITTED
    }
    constants = {
        variable: dumps(of.consts)
        for variable, of in objects.environments.items()
        if variable not in _EMITTED
    }
    _EMITTED.update(made, constants)
    return names, made, constants


_EMITTED: set[str] = set()  # by this process


def _write_table(path: Path, entries: list[Entry], constants: dict[str, bytes]) -> None:
    """The tables that Numba's modulemixin.c reads: methods, constants, and where they go."""
    declared, pickles, places = [], [], []
    # those of the entries first, in their order
    for variable in dict.fromkeys([*(e.environment for e in entries), *constants]):
        pickled = constants[variable]
        declared.append(f'extern void *{variable};')
        text = ''.join(f'\\{byte:03o}' for byte in pickled)
        pickles.append(f'{{"{text}", {len(pickled)}, "", 0, 0}},')
        places.append(f'&{variable},')
    methods = []
    for entry in entries:
        declared.append(f'PyObject *{entry.name}(PyObject *, PyObject *, PyObject *);')
        method = f'(PyCFunction)(void (*)(void)){entry.name}'
        methods.append(f'{{"{entry.name}", {method}, METH_VARARGS | METH_KEYWORDS, 0}},')
    lines = [
        *declared,
        'static PyMethodDef entries[] = {', *methods, '{0}};',
        'static env_def_t environments[] = {', *pickles, '{0}};',
        'static env_gv_t places[] = {', *places, '0};',
    ]  # fmt: skip
    path.write_text('\n'.join(lines) + '\n', encoding='ascii')


def _compiler() -> list[str]:
    """The C compiler; BuildError where there is none."""
    for command in (os.environ.get('CC'), sysconfig.get_config_var('CC'), 'cc', 'gcc', 'clang'):
        if command and shutil.which(shlex.split(command)[0]):
            return shlex.split(command)
    raise BuildError('no C compiler: install gcc and g++ (Debian, Ubuntu: build-essential)')


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ['no message'])[-1]
        raise BuildError(f'{command[0]} failed: {said}')


def _flags() -> list[str]:
    """Of the C compiler, for files that include Numba's."""
    import numba
    import numpy as np
    from numba import _helperlib

    wide = int(getattr(_helperlib, 'LAPACK_BUILD_ILP64', 0))
    folder = Path(numba.__file__).parent
    return [
        '-O2', '-fPIC', '-w', '-DPYCC_MODULE_NAME=_kernels', '-DPYCC_USE_NRT=1',
        f'-DNUMBA_LAPACK_BUILD_ILP64={wide}', f'-I{folder / "pycc"}', f'-I{np.get_include()}',
        f'-I{sysconfig.get_path("include")}',
    ]  # fmt: skip


def _start_runtime(work: Path) -> list[Path]:
    """Numba's runtime as objects; early, because it is quick and may fail."""
    import numba
    from numba import cext

    flags, made = _flags(), list[Path]()
    libraries: Any = cext.get_extension_libs
    root = Path(numba.__file__).parent
    for source in [*map(Path, libraries()), root / 'core/runtime/nrt.cpp']:
        made.append(work / f'runtime_{source.stem}.o')
        _run([*_compiler(), *flags, '-c', str(source), '-o', str(made[-1])])
    return made


def _link(work: Path, runtime: list[Path]) -> None:
    """The shared library of all objects, without what no entry needs."""
    table = str(Path(__file__).with_name('table.c'))
    _run([
        *_compiler(), *_flags(), f'-I{work}', '-shared', '-Wl,-s', '-Wl,--gc-sections', table,
        *map(str, [*runtime, *sorted(work.glob('object_*.o'))]),
        '-o', str(work / library.LIBRARY), '-lpthread', '-lm',
    ])  # fmt: skip
