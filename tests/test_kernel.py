from __future__ import annotations

import importlib
import os
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numba.core import event

import labseq
import labseq.kernel
from labseq.kernel import announcing, const, kernel, load_kernels

MAX_LACK = 3

LEAF = """
    from labseq.kernel import kernel

    @kernel("int64(int64)")
    def leaf(x):
        return x + {step}
"""
MIDDLE = """
    from labseq.kernel import kernel
    from {package}.leaf import leaf

    @kernel("int64(int64)")
    def middle(x):
        return 2 * leaf(x)
"""
TOP = """
    from labseq.kernel import kernel
    from {package} import middle
    from {package}.constants import OFFSET

    MIDDLE = middle.middle

    @kernel("int64(int64)")
    def top(x):
        return MIDDLE(x) + OFFSET
"""


class Package:
    """A package of kernels in a folder of its own, which can be edited and imported again."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder / name
        self.name = name
        self.folder.mkdir()
        self.write("__init__", "")
        self.write("leaf", LEAF.format(step=1))
        self.write("middle", MIDDLE.format(package=name))
        self.write("constants", "OFFSET = 100")
        self.write("top", TOP.format(package=name))

    def write(self, module: str, text: str) -> None:
        (self.folder / f"{module}.py").write_text(textwrap.dedent(text), encoding="utf-8")

    def define(self) -> ModuleType:
        for module in [name for name in sys.modules if name.split(".")[0] == self.name]:
            del sys.modules[module]
        importlib.invalidate_caches()
        return importlib.import_module(f"{self.name}.top")

    def load(self) -> ModuleType:
        top = self.define()
        load_kernels()
        return top

    def result(self) -> int:
        return self.load().top(0)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("LABSEQ_CACHE", str(folder))
    return folder


@pytest.fixture
def package(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, request: Any) -> Package:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # else edits within a second pass unseen
    monkeypatch.syspath_prepend(str(tmp_path))
    return Package(tmp_path, f"kernels_of_{request.node.name.split('[')[0]}")


def compiled_modules(load: Callable[[], object]) -> list[str]:
    modules: list[str] = []

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            modules.append(event.data["dispatcher"].py_func.__module__)

        def on_end(self, event: Any) -> None:
            pass

    announced: list[float] = []
    with event.install_listener("numba:compile", Listener()), announcing(announced.append):
        load()
    assert len(announced) == bool(modules)
    return [name.split(".")[-1] for name in modules if "kernels_of" in name]


def test_an_edit_of_a_callee_in_another_file_is_seen(package: Package) -> None:
    assert package.result() == 102
    package.write("leaf", LEAF.format(step=2))
    assert package.result() == 104
    package.write("leaf", LEAF.format(step=1))
    assert package.result() == 102
    package.write("constants", "OFFSET = 200")
    assert package.result() == 202


def test_only_what_an_edit_touches_is_compiled_again(package: Package) -> None:
    assert compiled_modules(package.load) == ["leaf", "middle", "top"]
    assert compiled_modules(package.load) == []
    package.write("constants", "OFFSET = 200")
    assert compiled_modules(package.load) == ["top"]
    package.write("middle", MIDDLE.format(package=package.name) + "\n")
    assert compiled_modules(package.load) == ["middle", "top"]


def test_a_helper_is_loaded_only_to_compile_what_calls_it_or_when_python_does(package: Package) -> None:
    package.write(
        "middle",
        MIDDLE.format(package=package.name)
        .replace("@kernel", "@helper_kernel")
        .replace("import kernel", "import helper_kernel"),
    )
    package.write(
        "leaf",
        LEAF.format(step=1)
        .replace("@kernel", "@helper_kernel")
        .replace("import kernel", "import helper_kernel"),
    )
    assert compiled_modules(package.load) == ["top", "middle", "leaf"]
    top: Any = package.load()
    assert (len(top.top.overloads), len(top.MIDDLE.overloads)) == (1, 0)
    assert (top.top(0), top.MIDDLE(0), len(top.MIDDLE.overloads)) == (102, 2, 1)
    with pytest.raises(TypeError, match="No matching definition"):
        top.MIDDLE("text")


def test_a_kernel_is_loaded_by_its_first_call(package: Package) -> None:
    top = package.define()
    assert compiled_modules(lambda: top.top(0)) == ["top", "middle", "leaf"]
    again: Any = package.define()
    assert compiled_modules(lambda: again.top(0)) == []
    assert len(again.MIDDLE.overloads) == 0  # nothing has asked for it


def test_threads_may_make_the_first_call_at_the_same_time(package: Package) -> None:
    top = package.define()
    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(top.top, [0] * 4)] == [102] * 4


def test_processes_fill_the_cache(package: Package, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(labseq.kernel, "WORTH_A_PROCESS_S", 0.0)
    monkeypatch.setattr(labseq.kernel, "n_cores", lambda: 2)
    polled: list[None] = []
    top = package.define()
    announced: list[float] = []
    with announcing(announced.append):
        load_kernels(lambda: polled.append(None))
    assert (top.top(0), len(announced)) == (102, 1)
    assert sum(top.top.stats.cache_misses.values()) == 0
    package.write("top", TOP.format(package=package.name).replace("MIDDLE(x)", "MIDDLE(y)"))
    with pytest.raises(labseq.PluginLoadError, match=r"'top' cannot be compiled: TypingError(.|\n)*'y'"):
        package.load()


def test_a_cache_that_cannot_be_written_does_no_harm(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path / "file" / "cache"))
    assert package.result() == 102
    assert not list(package.folder.rglob("*.nbi"))


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_files_truncated_by_a_crash_are_replaced(package: Package, cache: Path, suffix: str) -> None:
    package.load()
    for file in cache.rglob(f"*leaf*.{suffix}"):
        file.write_bytes(file.read_bytes()[:7])
    assert package.result() == 102
    assert compiled_modules(package.load) == ["leaf"]
    assert compiled_modules(package.load) == []


def test_kernels_unused_for_long_are_deleted_and_nothing_else(package: Package, cache: Path) -> None:
    root = cache / "kernels"
    long_ago = time.time() - 31 * 86400
    for name in ("0" * 24, "1" * 24, "notes"):
        (root / name).mkdir(parents=True)
        (root / name / "kernel.nbi").write_text("")
        os.utime(root / name, (long_ago, long_ago))
    os.utime(root / ("1" * 24))
    package.load()
    assert not (root / ("0" * 24)).exists()
    assert (root / ("1" * 24) / "kernel.nbi").exists()
    assert (root / "notes" / "kernel.nbi").exists()


def test_numbas_own_cache_folder_is_left_as_it_was(package: Package) -> None:
    config: Any = importlib.import_module("numba.core.config")
    before = config.CACHE_DIR
    config.CACHE_DIR = "somebody's"
    try:
        package.load()
        assert config.CACHE_DIR == "somebody's"
    finally:
        config.CACHE_DIR = before


def test_a_function_without_a_file_is_compiled_without_the_cache(cache: Path) -> None:
    scope: dict[str, Any] = {"kernel": kernel}
    exec("@kernel('int64(int64)')\ndef double(x):\n    return 2 * x", scope)  # a notebook's way
    assert scope["double"](4) == 8
    assert not cache.exists()


def test_several_signatures_and_read_only_arrays(cache: Path) -> None:
    @kernel([f"int64({const('int64', 1)})", f"float64({const('float64', 1)})"])
    def total(values: Any) -> Any:
        result = values[0]
        for value in values[1:]:
            result += value
        return result + MAX_LACK

    options: Any = total
    assert options.targetoptions["nogil"]  # other threads run while a kernel does
    values = np.arange(4)
    assert total(values) == 9
    values.flags.writeable = False
    assert total(values) == 9
    assert total(values / 2) == 6.0
    with pytest.raises(TypeError, match="No matching definition"):
        total(values.astype(np.int16))


def run_python(code: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(code)],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_interpreted_kernels_never_load_numba() -> None:
    code = """
        import sys, types
        import labseq.motion, labseq_psca
        from labseq.kernel import announcing, interpret
        print("numba" in sys.modules)
        interpret()
        with announcing(print):
            from labseq.motion.check_kernels import longest_move
        print(isinstance(longest_move, types.FunctionType), "numba" in sys.modules)
    """
    assert run_python(code).split() == ["False", "True", "False"]


@pytest.mark.parametrize(
    ("is_loaded", "disable_jit", "interpreted"),
    [(False, None, True), (True, None, False), (False, "0", False), (False, "1", False)],
)
def test_kernels_are_interpreted_unless_numba_is_loaded_or_the_user_decides(
    monkeypatch: pytest.MonkeyPatch, is_loaded: bool, disable_jit: str | None, interpreted: bool
) -> None:
    switch = threading.Event()
    monkeypatch.setattr(labseq.kernel, "_INTERPRETED", switch)
    monkeypatch.setitem(sys.modules, "numba", ModuleType("numba"))
    if not is_loaded:
        monkeypatch.delitem(sys.modules, "numba")
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    if disable_jit is not None:
        monkeypatch.setenv("NUMBA_DISABLE_JIT", disable_jit)
    labseq.kernel.interpret()
    assert switch.is_set() == interpreted


def test_kernels_are_plain_python_without_the_compiler() -> None:
    code = """
        import numpy as np
        from labseq.plugin import Context, MotionSpec, SiteGrid, TargetPattern, check_plan, tone_program
        from labseq_psca.planner import PscaPlanner, PscaSettings

        atoms = np.random.default_rng(3).random((8, 7)) < 0.7
        fill = np.zeros((8, 7), np.bool_)
        fill[1:7, 1:6] = np.indices((6, 5)).sum(axis=0) % 3 > 0
        clear = np.zeros((8, 7), np.bool_)
        clear[1:7, 1:6] = ~fill[1:7, 1:6]
        target = TargetPattern(fill, clear)
        plan = PscaPlanner(PscaSettings(degree_of_parallelism=3), Context()).plan(atoms, target)
        report = check_plan(plan, atoms, target, 3)
        program = tone_program(plan, SiteGrid(8, 7))
        arrays = (plan.moves, report.batch_end_s, program.column.end_hz, program.row.phase_rad)
        result = repr([bool(report.meets_target), *(array.tolist() for array in arrays)])
    """
    scope: dict[str, Any] = {}
    exec(textwrap.dedent(code), scope)
    plain = run_python(textwrap.dedent(code) + "print(result)", NUMBA_DISABLE_JIT="1")
    assert plain == scope["result"]
    assert plain.startswith("[True")
