# SPDX-License-Identifier: Apache-2.0
"""Parameters from flat mappings and from ROS parameter files (YAML)."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rlml_slam.errors import FileFormatError, ParameterError
from rlml_slam.params.declaration import declarations
from rlml_slam.params.systems import NODES, ROS_OWN, Parameters
from rlml_slam.plain_yaml import parse_yaml


def from_mapping(values: Mapping[str, Any], of: type[Any] = Parameters) -> Any:
    """Parameters with ``values`` (flat, by ROS name) in place of the defaults.

    ParameterError for an unknown name, or a value outside of its declaration.
    """
    known = {d.name: d for d in declarations(of)}
    groups: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name not in known:
            raise ParameterError(f'unknown parameter {name!r}; similar: {_nearest(name, known)}')
        groups.setdefault(known[name].group, {})[known[name].field] = value
    default = of()
    return dataclasses.replace(
        default, **{g: dataclasses.replace(getattr(default, g), **v) for g, v in groups.items()}
    )


def _nearest(name: str, known: Mapping[str, Any]) -> str:
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return ', '.join(near) if near else 'none; see docs/parameters.md'


def flatten(tree: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Nested mappings as one mapping with dotted names, as ROS names them."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f'{prefix}{key}.'))
        else:
            flat[f'{prefix}{key}'] = value
    return flat


def read_yaml(path: str | Path, of: type[Any] = Parameters) -> dict[str, Any]:
    """Flat parameters of the nodes of ``of`` in a ROS parameter file.

    Reads the sections of these nodes (``front_end: ros__parameters: ...``), in any namespace, and
    of all nodes (``/**``). A parameter that only another node of this package declares is left
    out, so that several nodes may share one file. FileFormatError if the file cannot be read or
    has no such section.
    """
    try:
        tree = parse_yaml(Path(path).read_text(encoding='utf-8'), str(path))
    except OSError as e:
        raise FileFormatError(f'{path}: cannot be read: {e.strerror}') from e
    except UnicodeDecodeError as e:
        raise FileFormatError(f'{path}: not YAML: {e}') from e
    if not isinstance(tree, Mapping):
        raise FileFormatError(f'{path}: no parameters in this file')
    ours = ('**', '*', *NODES[of])
    sections = [flat for name, flat in _sections(tree, str(path)) if name in ours]
    if not sections:
        raise FileFormatError(f'{path}: no section for {" or ".join(NODES[of])} or /**')
    known = {d.name for d in declarations(of)}
    foreign = {d.name for other in NODES for d in declarations(other)} - known
    return {
        name: value
        for section in sections
        for name, value in section.items()
        if name not in foreign and not name.startswith(ROS_OWN)
    }


def _sections(tree: Mapping[str, Any], path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Node name without namespace, and flat parameters, of each section of a file."""
    for key, body in tree.items():
        if not isinstance(body, Mapping):
            raise FileFormatError(f'{path}: {key!r} has no ros__parameters')
        parameters = body.get('ros__parameters')
        if isinstance(parameters, Mapping):
            yield str(key).rsplit('/')[-1], flatten(parameters)
        else:
            yield from _sections(body, path)
