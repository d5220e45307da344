# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels on disk whose sources have changed since.

Numba recompiles a kernel only when its own file changed. Constants and kernels of the files that
this one imports are built into it as well, so here a kernel goes when any of those changed.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import json
from pathlib import Path
from typing import Any

import numba

# What a file with kernels imports to make them.
MAKER = 'rlml_slam.compiled'
# They find and call compiled kernels, and are in none.
LOADING = {f'kernels/{name}.py' for name in ('cache', 'library', 'missing', 'native')}


def remove_stale(package: Path) -> None:
    """Delete the compiled kernels of a package which were made of other sources.

    Where the folder cannot be written to, and NUMBA_CACHE_DIR names no other, Numba keeps them
    with the user's files, and an installation gives all files new times.
    """
    folder = _cache_of(package)
    stamp = folder / 'kernels.stamp'
    paths = sorted(package.rglob('*.py'))
    times = _times(package, paths)
    with contextlib.suppress(OSError):
        known = _read(stamp)
        if known.get('times') == times:
            return
        made_of = _made_of(package, paths)
        for name, digest in made_of.items():
            if known.get(name) != digest:
                source = package / name
                for path in _cache_of(source.parent).glob(f'{source.stem}.*.nb[ci]'):
                    path.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        stamp.write_text(json.dumps({'times': times, **made_of}), encoding='utf-8')


def sources_of(package: Path) -> tuple[str, ...]:
    """All files that the kernels of a package are made of, by name."""
    texts = _texts(package, sorted(package.rglob('*.py')))
    imported: dict[str, set[str]] = {}
    makers = [name for name, text in texts.items() if MAKER.encode() in text]
    found = set().union(*(_reached(n, texts, imported, package.name) for n in makers))
    return tuple(sorted(found - LOADING))


def _cache_of(folder: Path) -> Path:
    """Where Numba keeps the kernels of a folder's sources."""
    config: Any = numba.config
    if not config.CACHE_DIR:
        return folder / '__pycache__'
    # as numba.core.caching names it
    digest = hashlib.sha1(str(folder).encode()).hexdigest()
    return Path(config.CACHE_DIR) / f'{folder.name}_{digest}'


def _read(stamp: Path) -> dict[str, str]:
    """What was written the last time, nothing where it cannot be read."""
    try:
        known = json.loads(stamp.read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _times(package: Path, paths: list[Path]) -> str:
    """Digest of names, sizes and times of change: the same ones mean the same sources."""
    seen = hashlib.sha256()
    for path in paths:
        stat = path.stat()
        seen.update(f'{path.relative_to(package)} {stat.st_size} {stat.st_mtime_ns}\n'.encode())
    return seen.hexdigest()


def _made_of(package: Path, paths: list[Path]) -> dict[str, str]:
    """Digest of all that the kernels of a file are made of, by the name of the file."""
    texts = _texts(package, paths)
    imported: dict[str, set[str]] = {}
    digests = {}
    for name, text in texts.items():
        if MAKER.encode() not in text:
            continue
        seen = hashlib.sha256()
        for one in sorted(_reached(name, texts, imported, package.name)):
            seen.update(f'{one} {len(texts[one])}\n'.encode() + texts[one])
        digests[name] = seen.hexdigest()
    return digests


def _texts(package: Path, paths: list[Path]) -> dict[str, bytes]:
    """Content of each file by its name in the package."""
    return {path.relative_to(package).as_posix(): path.read_bytes() for path in paths}


def _reached(
    name: str, texts: dict[str, bytes], imported: dict[str, set[str]], package: str
) -> set[str]:
    """A file and all that it imports of the package; ``imported`` is what is known so far."""
    reached, ahead = {name}, [name]
    while ahead:
        at = ahead.pop()
        if at not in imported:
            # the package itself only names its API, which no kernel is made of
            found = set() if at == '__init__.py' else _imports(texts[at], package)
            imported[at] = found & texts.keys()
        ahead += imported[at] - reached
        reached |= imported[at]
    return reached


def _imports(text: bytes, package: str) -> set[str]:
    """Files of the package which a source may import, as far as there are such."""
    names = {package}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
    files = set()
    for name in names:
        top, *rest = name.split('.')
        if top == package:
            files |= {'/'.join([*rest, '__init__.py'])} | (
                {'/'.join(rest) + '.py'} if rest else set()
            )
    return files
