from __future__ import annotations

import ctypes
import importlib
import importlib.util
import multiprocessing
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
import labseq.kernels.kernel
from labseq.kernels.kernel import announcing, c_address, const, kernel, load_kernels
from labseq.kernels.native import (
    WakeSignal,
    call_c,
    carray,
    new_timer,
    now_ns,
    pointer,
    set_signal,
    sleep_ns,
    swap,
    wait_signal,
)

MAX_LACK = 3

LEAF = """
    from labseq.kernels.kernel import helper_kernel

    @helper_kernel("int64(int64)")
    def leaf(x):
        return x + {step}
"""
MIDDLE = """
    from labseq.kernels.kernel import helper_kernel
    from {package} import leaf

    @helper_kernel("int64(int64)")
    def middle(x):
        return 2 * leaf.leaf(x)
"""
TOP = """
    from labseq.kernels.kernel import kernel
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
        path = self.folder / f"{module}.py"
        path.write_text(textwrap.dedent(text), encoding="utf-8")
        # bytecode of a file of the same size from the same second would be taken for up to date
        Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)

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
    monkeypatch.setattr(labseq.kernels.kernel, "_PENDING", {})  # without those that other tests have imported
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


def is_loaded(function: Any) -> bool:
    return bool(function._dispatchers)


def test_an_edit_of_a_callee_in_another_file_is_seen(package: Package) -> None:
    assert package.result() == 102
    package.write("leaf", LEAF.format(step=2))
    assert package.result() == 104
    package.write("leaf", LEAF.format(step=1))
    assert package.result() == 102
    package.write("constants", "OFFSET = 200")
    assert package.result() == 202


def test_only_what_an_edit_touches_is_compiled_again(package: Package) -> None:
    assert compiled_modules(package.load) == ["top", "middle", "leaf"]
    assert compiled_modules(package.load) == []
    package.write("constants", "OFFSET = 200")
    assert compiled_modules(package.load) == ["top"]
    package.write("middle", MIDDLE.format(package=package.name).replace("2 *", "3 *"))
    assert compiled_modules(package.load) == ["top", "middle"]
    package.write("leaf", "# a comment\nUNUSED = 3\n" + textwrap.dedent(LEAF.format(step=1)))
    assert compiled_modules(package.load) == []


def test_constants_of_other_modules_and_in_tuples_and_functions_of_numba_belong_to_the_source(
    package: Package,
) -> None:
    top = """
        import {package}.constants
        import {package}
        from labseq.kernels.kernel import kernel
        from {package}.helper import PAIR, double

        @kernel("float64(float64)")
        def top(x):
            return double(x) * {package}.constants.OFFSET + PAIR[0][0]
    """
    helper = "import numba, numpy as np\nPAIR = np.array([{}]), np.zeros(2)\n"
    double = "@numba.njit\ndef double(x):\n    return {} * x\n"
    package.write("top", top.format(package=package.name))
    results = []
    for constant, pair, factor in ((1, 0.5, 2), (3, 0.5, 2), (3, 0.5000000001, 2), (3, 0.5, 7)):
        package.write("constants", f"OFFSET = {constant}")
        package.write("helper", helper.format(pair) + double.format(factor))
        results.append(package.load().top(1.0))
    assert results == [2.5, 6.5, 6.5000000001, 21.5]


def test_the_columns_of_records_and_named_tuples_belong_to_the_source(package: Package) -> None:
    top = """
        import numpy as np
        from labseq.kernels.kernel import kernel
        from {package}.columns import RECORD, Pair

        @kernel("int64(UniTuple(int64, 2))")
        def top(numbers):
            pair, records = Pair(*numbers), np.zeros(2, RECORD)
            records[0].a = pair.first
            return records[0].a + 10 * records.itemsize
    """
    columns = """
        import numpy as np
        from typing import Any, NamedTuple
        RECORD = np.dtype([(name, np.int64) for name in {record}])
        Pair = NamedTuple("Pair", {pair})
    """
    package.write("top", top.format(package=package.name))
    results = []
    for record, pair in (("ab", "first second"), ("ab", "second first"), ("abc", "second first")):
        fields = [(name, "Any") for name in pair.split()]
        package.write("columns", columns.format(record=list(record), pair=fields))
        results.append(package.load().top((1, 2)))
    assert results == [161, 162, 242]


def test_the_values_of_an_enclosing_function_belong_to_the_source(cache: Path) -> None:
    def adding(step: int) -> Any:
        @kernel("int64(int64)")
        def add(x: Any) -> Any:
            return x + step

        return add

    assert [adding(step)(1) for step in (1, 2, 1)] == [2, 3, 2]
    assert len([*cache.glob("kernels/add-*")]) == 2


def test_a_helper_is_loaded_only_to_compile_what_calls_it_or_when_python_does(package: Package) -> None:
    package.load()
    top = package.load()
    assert (is_loaded(top.top), is_loaded(top.MIDDLE)) == (True, False)
    assert (top.top(0), top.MIDDLE(0), is_loaded(top.MIDDLE)) == (102, 2, True)
    with pytest.raises(TypeError, match="No matching definition"):
        top.MIDDLE("text")


def test_a_helper_without_a_signature_is_compiled_as_part_of_what_calls_it(package: Package) -> None:
    package.write("middle", MIDDLE.format(package=package.name).replace('"int64(int64)"', ""))
    assert compiled_modules(package.load) == ["top", "middle", "leaf"]
    assert compiled_modules(package.load) == []
    package.write("leaf", LEAF.format(step=2))
    assert package.result() == 104
    assert package.define().MIDDLE(0.5) == 2 * 2  # leaf takes whole numbers


def test_a_kernel_is_loaded_by_its_first_call(package: Package) -> None:
    top = package.define()
    assert compiled_modules(lambda: top.top(0)) == ["top", "middle", "leaf"]
    again = package.define()
    assert compiled_modules(lambda: again.top(0)) == []
    assert not is_loaded(again.MIDDLE)  # nothing has asked for it


def test_a_kernel_that_calls_itself_or_is_called_by_kernels_and_python(cache: Path) -> None:
    scope: dict[str, Any] = {"kernel": kernel, "__name__": __name__}
    recursive = """
        @kernel("int64(int64)")
        def factorial(n):
            return 1 if n < 2 else n * factorial(n - 1)

        @kernel("int64(int64)")
        def ways(n):
            return factorial(n) // 2
    """
    for _ in range(2):
        exec(textwrap.dedent(recursive), scope)
        assert (scope["ways"](4), scope["factorial"](4)) == (12, 24)


def test_a_call_that_began_before_the_kernel_was_loaded_is_answered(package: Package) -> None:
    top = package.define()
    begun = top.top._call  # what a thread holds that was interrupted at the start of its call
    load_kernels()
    assert [begun(0), top.top(0), begun(0)] == [102] * 3


def test_threads_may_make_the_first_call_at_the_same_time(package: Package) -> None:
    top = package.define()
    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(top.top, [0] * 4)] == [102] * 4


def test_processes_fill_the_cache(package: Package, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(labseq.kernels.kernel, "WORTH_A_PROCESS_S", 0.0)
    monkeypatch.setattr(labseq.kernels.kernel, "n_cores", lambda: 2)
    polled: list[None] = []
    top = package.define()
    announced: list[float] = []
    with announcing(announced.append):
        load_kernels(lambda: polled.append(None))
    assert (top.top(0), len(announced)) == (102, 1)
    assert compiled_modules(package.load) == []
    package.write("top", TOP.format(package=package.name).replace("+ OFFSET", "+ x.y"))
    message = r"'top' cannot be compiled: TypingError(.|\n)*'y'(.|\n)*top\.py\", line 10:"
    with pytest.raises(labseq.PluginLoadError, match=message):
        package.load()


def test_a_worker_that_may_start_no_processes_compiles_by_itself(
    package: Package, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(labseq.kernels.kernel, "WORTH_A_PROCESS_S", 0.0)
    monkeypatch.setattr(labseq.kernels.kernel, "n_cores", lambda: 2)
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # type: ignore[attr-defined]
    assert package.result() == 102


def test_a_cache_that_cannot_be_written_does_no_harm(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path / "file" / "cache"))
    assert package.result() == 102
    assert not list(package.folder.rglob("*top-*"))


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("size", [0, 7, 1000])
def test_files_truncated_by_a_crash_are_replaced(package: Package, cache: Path, size: int, kind: str) -> None:
    package.load()
    for file in cache.rglob(f"kernel.top-*.{kind}"):
        file.write_bytes(file.read_bytes()[:size])
    assert compiled_modules(package.load) == ["top"]
    assert compiled_modules(package.load) == []
    assert package.result() == 102


def test_another_copy_of_a_package_finds_its_kernels_compiled(package: Package, tmp_path: Path) -> None:
    assert compiled_modules(package.load) == ["top", "middle", "leaf"]
    (tmp_path / "elsewhere").mkdir()
    package.folder = package.folder.rename(tmp_path / "elsewhere" / package.name)
    sys.path[0] = str(tmp_path / "elsewhere")
    package.write("leaf", "# a comment\nUNUSED = 3\n" + textwrap.dedent(LEAF.format(step=1)))
    assert compiled_modules(package.load) == []
    assert package.result() == 102


@pytest.mark.parametrize("ahead_days", [0, 365])
def test_kernels_unused_for_long_are_deleted_whatever_the_clock(
    package: Package, cache: Path, monkeypatch: pytest.MonkeyPatch, ahead_days: int
) -> None:
    root, now_s = cache / "kernels", time.time()
    for name, days in (("old", 31), ("recent", 29)):
        (root / name / "python").mkdir(parents=True)
        used_s = now_s - days * 86400
        os.utime(root / name, (used_s, used_s))
    (root / "new" / "python").mkdir(parents=True)
    monkeypatch.setattr(time, "time", lambda: now_s + ahead_days * 86400)
    package.load()
    left = {path.name for path in root.iterdir()}
    assert {"recent", "new"} < left
    assert "old" not in left


def test_a_function_of_a_notebook_is_cached_by_its_code(cache: Path) -> None:
    for factor in (2, 3):
        scope: dict[str, Any] = {"kernel": kernel}
        exec(f"@kernel('int64(int64)')\ndef times(x):\n    return {factor} * x", scope)
        assert scope["times"](4) == 4 * factor


def test_several_signatures_and_read_only_arrays(cache: Path) -> None:
    @kernel([f"int64({const('int64', 1)})", f"float64({const('float64', 1)})"])
    def total(values: Any) -> Any:
        result = values[0]
        for value in values[1:]:
            result += value
        return result + MAX_LACK

    values = np.arange(4)
    assert total(values) == 9
    values.flags.writeable = False
    assert total(values) == 9
    assert total(values / 2) == 6.0
    with pytest.raises(TypeError, match="No matching definition"):
        total(values.astype(np.int16))


def test_machine_code_is_given_only_what_it_was_compiled_for(cache: Path) -> None:
    pair = "Tuple((float64[::1], float64))"

    @kernel(f"Tuple((float64[::1], int64))(float64[::1], {const('int16', 2)}, int64, {pair})")
    def scaled(values: Any, grid: Any, n: Any, pair: Any) -> Any:
        return values * n + pair[0] * pair[1] + grid[0, 0], n

    grid, values = np.full((2, 3), 5, np.int16), np.arange(3.0)
    read_only = values.copy()
    read_only.flags.writeable = False
    for _ in range(3):  # arrays that a kernel returns belong to Python
        result, n = scaled(values, grid, np.int32(2), (values, 1))
        assert (result.tolist(), n, result.flags.writeable) == ([5.0, 8.0, 11.0], 2, True)
    wrong: list[tuple[Any, ...]] = [
        (read_only, grid, 2, (values, 1.0)),
        (np.arange(6.0)[::2], grid, 2, (values, 1.0)),
        (values.astype(np.float32), grid, 2, (values, 1.0)),
        (values.tolist(), grid, 2, (values, 1.0)),
        (values, grid[0], 2, (values, 1.0)),
        (values, grid.T, 2, (values, 1.0)),
        (values, grid.astype(np.uint16), 2, (values, 1.0)),
        (values, grid, "2", (values, 1.0)),
        (values, grid, 2, (values, 1.0, 1.0)),
        (values, grid, 2, (grid, 1.0)),
        (values, grid, 2, values),
    ]
    for arguments in wrong:
        with pytest.raises(TypeError, match="No matching definition"):
            scaled(*arguments)


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
        import sys
        import numpy as np
        import labseq.motion, labseq_psca
        from labseq.kernels.kernel import announcing, interpret
        print("numba" in sys.modules)
        interpret()
        with announcing(print):
            from labseq.motion.check_kernels import longest_move
            print(longest_move(np.zeros((1, 4), np.int16)))
        print("numba" in sys.modules)
    """
    assert run_python(code).split() == ["False", "0", "False"]


@pytest.mark.parametrize(
    ("is_loaded", "disable_jit", "interpreted"),
    [(False, None, True), (True, None, False), (False, "0", False), (False, "1", False)],
)
def test_kernels_are_interpreted_unless_numba_is_loaded_or_the_user_decides(
    monkeypatch: pytest.MonkeyPatch, is_loaded: bool, disable_jit: str | None, interpreted: bool
) -> None:
    switch = threading.Event()
    monkeypatch.setattr(labseq.kernels.kernel, "_INTERPRETED", switch)
    monkeypatch.setitem(sys.modules, "numba", ModuleType("numba"))
    if not is_loaded:
        monkeypatch.delitem(sys.modules, "numba")
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    if disable_jit is not None:
        monkeypatch.setenv("NUMBA_DISABLE_JIT", disable_jit)
    labseq.kernels.kernel.interpret()
    assert switch.is_set() == interpreted


def test_kernels_are_plain_python_without_the_compiler() -> None:
    code = """
        import numpy as np
        from labseq.plugin import Context, MotionSpec, SiteGrid, TargetPattern
        from labseq.plugin.motion import tone_program
        from labseq.plugin.planning import check_plan
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


@kernel("int64(int64, int64, int64)", for_c=True)
def add_to_word(address: int, value: int, factor: int) -> int:
    word = carray(pointer(address), 1, np.int64)
    word[0] += factor * value
    return word[0]  # type: ignore[no-any-return]


@kernel("int64(int64, int64)")
def call_and_swap(function: int, address: int) -> int:
    return call_c(function, address, 20, 2) + swap(address, 7)  # type: ignore[no-any-return]


def test_kernels_call_c_and_are_called_by_it() -> None:
    word = np.array([1], np.int64)
    address = word.ctypes.data
    function = ctypes.CFUNCTYPE(*[ctypes.c_int64] * 4)(c_address(add_to_word))
    assert (function(address, 5, 3), word[0]) == (16, 16)
    assert (call_and_swap(c_address(add_to_word), address), word[0]) == (2 * 56, 7)


def test_kernels_tell_the_time_and_sleep() -> None:
    timer = new_timer()
    start_ns = time.perf_counter_ns()
    sleep_ns(timer, 2_000_000)
    took_ns, later_ns = now_ns(timer) - start_ns, time.perf_counter_ns() - start_ns
    assert 0 <= took_ns <= later_ns
    assert took_ns >= 2_000_000 or sys.platform == "win32"


def test_a_signal_wakes_what_waits_for_it_or_will() -> None:
    signal = WakeSignal()
    start_s = time.perf_counter()
    set_signal(signal.words)
    wait_signal(signal.words, 30_000)
    thread = threading.Thread(target=wait_signal, args=(signal.words, 30_000))
    thread.start()
    set_signal(signal.words)
    thread.join()
    assert time.perf_counter() - start_s < 20.0
    start_s = time.perf_counter()
    wait_signal(signal.words, 20)
    assert time.perf_counter() - start_s > 10e-3
