# SPDX-License-Identifier: Apache-2.0
"""Object code of all that Numba compiles in a process which makes the library.

Numba would generate code to run it, and forget it. Here code is generated once, for the processor
level of the library and for any address: the process runs it, and the library is linked of it.
Numba also copies each function into all that call it; here a large one stays where it is.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
from numba import types
from numba.core import codegen, environment, registry, serialize
from numba.np.numpy_support import as_dtype

numba_codegen: Any = codegen
lookup: Any = environment.lookup_environment
dumps: Any = serialize.dumps
ENVIRONMENT = '_ZN08NumbaEnv'  # how Numba names the variable that points to a function's constants
COMPILED = '_ZN'  # how names of what it compiles begin,
ENTRY = '_ZN7cpython'  # and of the entries from Python
SHARED = (llvm.Linkage.external, llvm.Linkage.common)  # what other objects may use
LARGE = 250  # lines of LLVM's code; it inlines no function of that size
C_CONTIGUOUS, ALIGNED, WRITEABLE = 0x0001, 0x0100, 0x0400  # flags of NumPy's arrays


@dataclass(frozen=True)
class Entry:
    """A kernel for one signature; ``environment``: the variable that points to its constants."""

    kernel: str
    name: str
    check: bytes
    environment: str


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


def entries_of(kernel: str, dispatcher: Any) -> list[Entry]:
    """Entry of every signature that Python can call."""
    made: list[Entry] = []
    for result in dispatcher.overloads.values():
        parts = tuple(check_of(kind) for kind in result.signature.args)
        if None not in parts:
            names = map(_own, (result.fndesc.llvm_cpython_wrapper_name, result.fndesc.env_name))
            name, constants = names
            made.append(Entry(kernel, name, pickle.dumps(('T', tuple, parts)), constants))
    return made


class Objects:
    """Objects of this process: written into ``folder``, and loaded to be run.

    ``environments``: Numba's constants of each function, by the variable that points to them.
    """

    def __init__(self, folder: Path, processor: str) -> None:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        self._machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
            cpu=processor, features='', opt=3, reloc='pic', codemodel='default'
        )
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(''), self._machine)
        self._folder, self._num = folder, 0
        self._new: list[str] = []  # variables that do not point to their constants yet
        self.environments: dict[str, Any] = {}

    def add(self, module: Any) -> None:
        """Generate the code of an optimised module."""
        of_library = module.clone()
        for function in of_library.functions:
            _rename(function)
        for variable in of_library.global_variables:
            name = variable.name
            _rename(variable)
            if name.startswith(ENVIRONMENT) and variable.name not in self.environments:
                self.environments[variable.name] = lookup(name)
                self._new.append(variable.name)
        code = self._machine.emit_object(of_library)
        self._num += 1
        (self._folder / f'object_{os.getpid()}_{self._num}.o').write_bytes(code)
        self._engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(code))

    def address(self, name: str) -> int:
        """Of a function that was added, by Numba's name, ready to be called."""
        self._engine.finalize_object()
        for variable in self._new:
            place = ctypes.c_void_p.from_address(self._engine.get_global_value_address(variable))
            place.value = id(self.environments[variable])
        self._new.clear()
        return int(self._engine.get_function_address(_own(name)))


def _own(name: str) -> str:
    """A name for Numba's: short, and of this process, as another one may use the same."""
    return f'k{os.getpid()}_{hashlib.sha256(name.encode()).hexdigest()[:16]}'


def _rename(value: Any) -> None:
    """Of a function or variable: what other objects need has a name of its own."""
    if value.linkage in SHARED and COMPILED in value.name:
        value.name = _own(value.name)
        value.visibility = 'hidden'
    elif not value.is_declaration:
        value.linkage = 'internal'


class _Defined:
    """A module without the functions that it only declares."""

    def __init__(self, module: Any) -> None:
        self._module = module
        self.functions = [f for f in module.functions if not f.is_declaration]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)


class _CodeLibrary(numba_codegen.JITCodeLibrary):  # type: ignore[misc]
    """What Numba compiles at a time: a function, and small ones that it calls."""

    def _optimize_functions(self, ll_module: Any) -> None:
        # Numba makes a pass manager for each function
        ll_module.data_layout = self._codegen._data_layout
        super()._optimize_functions(_Defined(ll_module))

    def _verify_declare_only_symbols(self) -> None:
        """Large functions are only declared."""

    def _get_module_for_linking(self) -> Any:
        """What is copied into a module that calls the function: nothing if it is large."""
        self._ensure_finalized()
        return llvm.parse_assembly('') if self._large else super()._get_module_for_linking()

    def _finalize_specific(self) -> None:
        own = [f for f in self.get_defined_functions() if f.linkage == llvm.Linkage.external]
        called = [f for f in own if not f.name.startswith(ENTRY)]
        self._large = any(str(f).count('\n') > LARGE for f in called)
        if self._large or len(called) < len(own):
            self._codegen.objects.add(self._final_module)

    def get_pointer_to_function(self, name: str) -> int:
        """Address of an entry; 0 of a part."""
        self._ensure_finalized()
        known = any(f.name == name for f in self.get_defined_functions())
        return self._codegen.objects.address(name) if known else 0


class _Codegen(numba_codegen.JITCPUCodegen):  # type: ignore[misc]
    _library_class = _CodeLibrary
    objects: Objects

    def _add_module(self, module: Any) -> None:
        """Numba's own engine is not used."""

    def set_env(self, env_name: str, env: Any) -> None:
        """The constants of a function: its object has them."""


@functools.cache
def emit_into(folder: Path, processor: str) -> Objects:
    """From now on all that Numba compiles in this process goes into ``folder`` as objects."""
    for own in (_CodeLibrary, _Codegen):
        for name in vars(own):
            if not hasattr(own.__base__, name):
                raise ImportError(f'this Numba has no {own.__base__.__name__}.{name}')
    context: Any = registry.cpu_target.target_context
    context.refresh()  # compiles Numba's runtime, which is not of the library
    made = context._internal_codegen = _Codegen('rlml_slam')
    made.objects = Objects(folder, processor)
    return made.objects
