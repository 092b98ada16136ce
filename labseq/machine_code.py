"""Machine code of kernels: numba makes it, llvmlite alone runs it.

Importing numba takes a third of the time in which a run starts, and is needed to compile only.
What is compiled is therefore kept with all that it refers to: numba's helper functions by
their names, constants as objects, and the types of its arguments, which are checked here
because machine code converts numbers but trusts arrays. Everything that labseq knows of
numba's inside is in this module.
"""

from __future__ import annotations

import builtins
import ctypes
import importlib
import importlib.util
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple, cast

import numpy as np

FORMAT: Final = 3
"""Raised when this module makes other machine code of the same kernel."""
NDARRAY: Final = "labseq_ndarray"
"""Symbol of the class of arrays in machine code; numba would import all of itself to find it."""
FLAGS: Final = {"C": 0x101, "F": 0x102, "A": 0x100}
"""Flags that numpy arrays of each layout have; all are aligned."""
WRITEABLE: Final = 0x400
REAL: Final = (float, int, np.integer, np.floating, np.bool_)
NUMBERS: Final = {
    "Boolean": (int, np.bool_),
    "Integer": (int, np.integer, np.bool_),
    "Float": REAL,
    "Complex": (*REAL, complex, np.complexfloating),
}
DTYPES: Final = {dtype.name: dtype for dtype in map(np.dtype, np.typecodes["AllInteger"] + "?efdFD")}
TESTED: Final = {"ndarray": np.ndarray, **NUMBERS, **DTYPES}
"""The names in tests of arguments."""


class MachineCode(NamedTuple):
    """Machine code of one signature of a kernel, as it is kept in the cache.

    Attributes:
        entry: Symbol of the function that takes Python objects.
        c_entry: Symbol of the function that C code can call; "" if there is none.
        object_code: The content of an object file.
        symbols: Symbol outside of it -> name in :func:`_symbols`.
        environments: Symbol -> Python objects that the code uses.
        n_parameters: Number of its parameters, which are called a0, a1 and so on.
        test: Expression that tells whether arguments fit.
    """

    entry: str
    c_entry: str
    object_code: bytes
    symbols: dict[str, str]
    environments: dict[str, list[object]]
    n_parameters: int
    test: str


def environment() -> str:
    """Text of everything but its source that machine code depends on."""
    settings = sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    return repr((FORMAT, _versions(), settings, _processor()))


@cache
def _versions() -> tuple[str, ...]:
    from importlib.metadata import version

    return (sys.version, version("numba"), version("llvmlite"), np.__version__)


@cache
def _processor() -> tuple[str, ...]:
    from llvmlite import binding

    return (
        binding.get_process_triple(),
        binding.get_host_cpu_name(),
        binding.get_host_cpu_features().flatten(),
    )


def compile_for_python(result: Any, *, is_only: bool, for_c: bool = False) -> MachineCode:
    """Machine code that Python can call.

    Args:
        result: Numba's result of compiling, which has none yet for Python objects.
        is_only: Whether it is the kernel's only signature, which converts numbers.
        for_c: Whether code in C calls it, too.
    """
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.environment import lookup_environment
    from numba.core.intrinsics import INTR_MATH
    from numba.core.pythonapi import PythonAPI
    from numba.core.runtime.nrt import rtsys

    class Api(cast("Any", PythonAPI)):
        def serialize_object(self, obj: object) -> Any:
            return obj if obj is np.ndarray else super().serialize_object(obj)

        def unserialize(self, structptr: Any) -> Any:
            return self.get_c_object(NDARRAY) if structptr is np.ndarray else super().unserialize(structptr)

    context, function = result.target_context.subtarget(enable_nrt=True), result.fndesc
    context.refresh()  # what was not compiled, but loaded, has not made it learn all types
    context.get_python_api = partial(cast("Any", Api), context)
    codegen = context.codegen()
    library = codegen.create_library(function.qualname)
    library._optimize_final_module = library._finalize_final_module = _do_nothing  # noqa: SLF001
    context.create_cpython_wrapper(library, function, result.environment, None, release_gil=True)
    if for_c:  # of the class, because this process may make only bitcode
        type(context).create_cfunc_wrapper(context, library, function, result.environment, None)
    library.add_linking_library(result.library)
    library.add_linking_library(rtsys.library)
    with global_compiler_lock:
        library.finalize()
    module = library._final_module  # noqa: SLF001
    passes, builder = type(codegen)._module_pass_manager(codegen)  # noqa: SLF001
    passes.run(module, builder)
    values = [*module.functions, *module.global_variables]
    names = {value.name for value in values if value.is_declaration and not value.name.startswith("llvm.")}
    used = {name: lookup_environment(name) for name in (value.name for value in values) if "NumbaEnv" in name}
    constants = {name: cast("Any", found).consts for name, found in used.items() if found is not None}
    constants = {name: found for name, found in constants.items() if found}
    tests = [
        test for number, one in enumerate(function.argtypes) for test in _tests(one, f"a{number}", is_only)
    ]
    return MachineCode(
        function.llvm_cpython_wrapper_name,
        function.llvm_cfunc_wrapper_name if for_c else "",
        codegen._tm.emit_object(module),  # noqa: SLF001
        {name: f"numba_{name}" if name in INTR_MATH else name for name in sorted(names)},
        constants | {function.env_name: result.environment.consts},
        len(function.argtypes),
        " and ".join(tests) or "True",
    )


def _tests(numba_type: Any, name: str, is_only: bool) -> Iterator[str]:
    """Expressions that tell whether a value is what machine code takes."""
    from numba.core import types
    from numba.np.numpy_support import as_dtype

    if isinstance(numba_type, types.Array):
        flags = FLAGS[numba_type.layout] | (WRITEABLE if numba_type.mutable else 0)
        dtype = cast("Any", as_dtype)(numba_type.dtype).name
        if dtype in DTYPES:
            yield f"isinstance({name}, ndarray) and {name}.dtype == {dtype}"
            yield f"{name}.ndim == {numba_type.ndim} and {name}.flags.num & {flags} == {flags}"
            return
    if isinstance(numba_type, types.BaseTuple):
        yield f"isinstance({name}, tuple) and len({name}) == {len(numba_type)}"
        for number, one in enumerate(cast("Any", numba_type)):
            yield from _tests(one, f"{name}[{number}]", is_only)
        return
    for kind in NUMBERS:
        if isinstance(numba_type, getattr(types, kind)):
            yield f"isinstance({name}, {'Float' if is_only and kind != 'Complex' else kind})"
            return
    raise TypeError(f"a kernel takes arrays, numbers and tuples of these, not {numba_type}")


def packed(result: Any) -> bytes:
    """Numba's result of compiling a function, for other processes that compile calls of it."""
    from numba.core.serialize import dumps

    result.library.serialize_using_object_code = result.library.serialize_using_bitcode
    return cast("Any", dumps)(result._reduce())  # noqa: SLF001


def unpacked(values: tuple[Any, ...], context: Any) -> Any:
    """The result that was packed."""
    from numba.core.compiler import CompileResult
    from numba.core.runtime.nrt import rtsys

    rtsys.initialize(context)
    return cast("Any", CompileResult)._rebuild(context, *values)  # noqa: SLF001


def prefer_wide_vectors() -> None:
    """Let numba use vectors of 512 bits where the processor is fast with them, from Ice Lake on.

    LLVM prefers 256 bits on all of Intel's processors. Rendering takes a quarter less time with 512
    (Sapphire Rapids).
    """
    from llvmlite import binding
    from numba.core import config

    features, settings = binding.get_host_cpu_features(), cast("Any", config)
    if features.get("avx512vbmi2") and settings.ENABLE_AVX and settings.CPU_FEATURES is None:
        settings.CPU_FEATURES = f"{features.flatten()},-prefer-256-bit"


def make_only_bitcode() -> None:
    """Let this process only compile: no machine code of functions that numba compiles from now on.

    Kernels are linked as bitcode, and optimised when all that they call is in them. That takes
    a quarter less time.
    """
    from numba.core.registry import cpu_target

    context = cast("Any", cpu_target).target_context
    codegen = context.codegen()
    codegen._module_pass_manager = partial(  # noqa: SLF001
        codegen._module_pass_manager,  # noqa: SLF001
        opt=0,
        loop_vectorize=False,
        slp_vectorize=False,
        cost="cheap",
    )
    for owner, name in (
        (context, "create_cfunc_wrapper"),
        (codegen, "_add_module"),
        (codegen, "set_env"),
        (codegen, "_scan_and_fix_unresolved_refs"),
    ):
        setattr(owner, name, _do_nothing)


def _do_nothing(*_: object) -> None: ...


def calling(
    name: str, functions: Sequence[tuple[MachineCode, Callable[..., Any], int]]
) -> Callable[..., Any]:
    """One function that calls the first of several that takes its arguments.

    Args:
        name: Name in errors.
        functions: The machine code of each, and what :func:`load` made of it.
    """

    def refuse(*args: Any) -> None:
        kinds = [
            f"{arg.dtype} array of shape {arg.shape}" if hasattr(arg, "shape") else repr(arg) for arg in args
        ]
        raise TypeError(f"No matching definition of kernel '{name}' for {', '.join(kinds)}")

    names = ", ".join(f"a{number}" for number in range(functions[0][0].n_parameters))
    calls = [f"f{number}({names}) if {code.test} else" for number, (code, *_) in enumerate(functions)]
    scope = {f"f{number}": function for number, (_, function, _) in enumerate(functions)}
    return eval(f"lambda {names}: {' '.join(calls)} refuse({names})", TESTED | scope | {"refuse": refuse})  # noqa: S307


def load(code: MachineCode) -> tuple[MachineCode, Callable[..., Any], int]:
    """The function of machine code, in an engine of its own: names may be the same in two files.

    It trusts that its arguments pass the test.

    Returns:
        The code, the function for Python, and the address of the one for C, 0 if there is none.

    Raises:
        LookupError: The code needs a function that is not there.
    """
    from llvmlite import binding

    known = _symbols()
    target = binding.Target.from_triple(binding.get_process_triple())
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), target.create_target_machine(jit=True))
    for symbol, helper in code.symbols.items():
        if helper in known:
            binding.add_symbol(symbol, known[helper])
        elif not binding.address_of_symbol(symbol):
            importlib.import_module("numba")  # it loads Intel's vector functions if they are installed
            if not binding.address_of_symbol(symbol):  # LLVM would end the process
                raise LookupError(f"no function {symbol}")
    engine.add_object_file(binding.ObjectFileRef.from_data(code.object_code))
    engine.finalize_object()
    dynfunc, environments = _extension("numba._dynfunc"), list[Any]()
    for symbol, values in code.environments.items():
        environments.append(dynfunc.Environment({}))
        environments[-1].consts[:] = values
        address = engine.get_global_value_address(symbol)
        ctypes.c_void_p.from_address(address).value = id(environments[-1])
    entry = engine.get_function_address(code.entry)
    unused = dynfunc.Environment({})
    function = dynfunc.make_function(
        sys.modules[__name__], "kernel", "", entry, unused, (engine, environments)
    )
    return code, function, engine.get_function_address(code.c_entry) if code.c_entry else 0


@cache
def _symbols() -> dict[str, int]:
    """The addresses that numba gives to the names in its machine code."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    if platform.machine() == "s390x":
        binding.load_library_permanently("libgcc_s.so.1")
    memory = _extension("numba.core.runtime._nrt_python")
    memory.memsys_use_cpython_allocator()
    helpers = _extension("numba._helperlib").c_helpers | _extension("numba._dynfunc").c_helpers
    errors = {name: id(value) for name, value in vars(builtins).items() if isinstance(value, type)}
    return {
        "_Py_NoneStruct": id(None),
        NDARRAY: id(np.ndarray),
        **{f"numba_{name}": address for name, address in helpers.items()},
        **{name if name[0] == "_" else f"NRT_{name}": at for name, at in memory.c_helpers.items()},
        **{f"PyExc_{name}": address for name, address in errors.items()},
    }


@cache
def _extension(name: str) -> ModuleType | Any:
    """One of numba's modules in C, imported without numba."""
    if name in sys.modules:
        return sys.modules[name]
    numba = importlib.util.find_spec("numba")
    assert numba is not None
    assert numba.submodule_search_locations is not None
    stem = Path(numba.submodule_search_locations[0], *name.split(".")[1:])
    for path in [stem.with_name(stem.name + suffix) for suffix in EXTENSION_SUFFIXES]:
        if path.is_file():
            spec = importlib.util.spec_from_file_location(name, path)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            return module
    raise LookupError(f"no module {name}")
