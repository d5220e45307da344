# SPDX-License-Identifier: Apache-2.0
"""Object code of what Numba compiled: one object per kernel and signature.

Numba's optimised module is compiled once more as code that may lie anywhere, for the processor
level of the library. Only the entry from Python is visible; all else is the object's own.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
from numba import types
from numba.core import environment, serialize
from numba.np.numpy_support import as_dtype

lookup: Any = environment.lookup_environment
dumps: Any = serialize.dumps
ENVIRONMENT = '_ZN08NumbaEnv'  # how Numba names the variable that points to a function's constants
C_CONTIGUOUS, ALIGNED, WRITEABLE = 0x0001, 0x0100, 0x0400  # flags of NumPy's arrays


@dataclass(frozen=True)
class Entry:
    """A kernel for one signature.

    ``environments``: (name of the variable, pickled constants), the kernel's own first.
    """

    kernel: str
    name: str
    check: bytes
    object_file: Path
    environments: list[tuple[str, bytes]]


def check_of(kind: Any) -> tuple[Any, ...] | None:
    """What table.c compares an argument with; None of one that cannot come from Python."""
    elements: Any = kind
    if isinstance(kind, types.BaseTuple):
        parts = tuple(check_of(part) for part in elements)
        return None if None in parts else ('T', getattr(kind, 'instance_class', tuple), parts)
    if isinstance(kind, types.Array) and kind.layout == 'C':
        aligned = ALIGNED if kind.aligned else 0
        flags = C_CONTIGUOUS | aligned | (WRITEABLE if kind.mutable else 0)
        return ('A', kind.ndim, flags, as_dtype(kind.dtype))
    names = {types.float64: 'f', types.int64: 'i', types.boolean: 'b', types.none: 'n'}
    return (names[kind],) if kind in names else None


def entries_of(
    kernel: str, dispatcher: Any, machine: Any, folder: Path, prefix: str
) -> list[Entry]:
    """Entry of every signature that Python can call; writes their objects into ``folder``."""
    made: list[Entry] = []
    for result in dispatcher.overloads.values():
        parts = tuple(check_of(kind) for kind in result.signature.args)
        if None in parts:
            continue
        name = f'{prefix}_{len(made)}'
        module = llvm.parse_bitcode(result.library._final_module.as_bitcode())
        environments = _hide_all_but(module, result.fndesc.llvm_cpython_wrapper_name, name)
        own = [e for e in environments if e[0] == result.fndesc.env_name]
        named = []
        for k, (variable, _) in enumerate(own + [e for e in environments if e not in own]):
            module.get_global_variable(variable).name = f'{name}_environment_{k}'
            of: Any = lookup(variable) or result.environment
            named.append((f'{name}_environment_{k}', dumps(of.consts)))
        (folder / f'{name}.o').write_bytes(machine.emit_object(module))
        check = pickle.dumps(('T', tuple, parts))
        made.append(Entry(kernel, name, check, folder / f'{name}.o', named))
    return made


def _hide_all_but(module: Any, wrapper: str, name: str) -> list[tuple[str, None]]:
    """Make everything but the entry the module's own; the variables of environments in it."""
    environments = []
    for function in module.functions:
        if function.name == wrapper:
            function.name, function.linkage = name, 'external'
        elif not function.is_declaration:
            function.linkage = 'internal'
    for variable in module.global_variables:
        if variable.name.startswith(ENVIRONMENT):
            environments.append((variable.name, None))
        elif not variable.is_declaration:
            variable.linkage = 'internal'
    return environments


def machine_for(processor: str) -> Any:
    """LLVM's code generator for a shared library."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=processor, features='', opt=3, reloc='pic', codemodel='default'
    )
