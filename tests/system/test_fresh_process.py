"""What is imported when, and on which systems, seen in new processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import labseq
from tests.measure_structure import count_lines, virtual_run

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]


def printed(code: str, *arguments: str, cwd: Path) -> str:
    """What a fresh process prints."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_and_help_load_next_to_nothing(tmp_path: Path) -> None:
    code = """
import sys
import labseq

def loaded():
    heavy = {"h5py", "matplotlib", "numba", "numpy", "pluggy", "pydantic", "rich", "scipy", "serial", "yaml"}
    vendors = {"gi", "pypylon", "SoapySDR", "spcm", "spcm_core"}
    plugins = {name for name in sys.modules if name.startswith("labseq_")}
    return sorted((heavy | vendors | plugins) & set(sys.modules))

print(loaded() + [name for name in ("typer",) if name in sys.modules])
print(sorted(name for name in sys.modules if name.startswith("labseq.")))
sys.argv = ["labseq", "--help"]
from labseq.cli import main
try:
    main()
except SystemExit as leaving:
    print("left with", leaving.code)
print(loaded())
import labseq.recording
print(sorted({"h5py"} & set(sys.modules)))
"""
    first, own, *_, left, of_help, of_recording = printed(code, cwd=tmp_path).splitlines()
    assert (first, own, left) == ("[]", "[]", "left with 0")
    assert (of_help, of_recording) == ("[]", "[]")


def test_a_check_imports_only_what_it_needs(tmp_path: Path) -> None:
    code = """
import sys
from labseq.cli import main
try:
    main(["check", "compact_225"])
except SystemExit as leaving:
    assert not leaving.code
print(*sorted(sys.modules))
"""
    modules = printed(code, cwd=tmp_path).splitlines()[-1].split()
    plugins = {name.split(".")[0] for name in modules if name.startswith("labseq_") and "." in name}
    compared = {"labseq_auto", "labseq_grid"}  # for the row `better`
    assert plugins == {"labseq_climb", "labseq_psca", "labseq_virtual"} | compared
    assert "numba" in modules  # and what it imports: scipy
    assert not {"h5py", "lmfit", "matplotlib", "pandas", "rich", "xarray"} & {*modules}


def test_a_list_of_runs_that_are_kept_loads_no_numpy(tmp_path: Path) -> None:
    """Which would take longer than the list of 10,000 runs."""
    code = """
import sys
from labseq.cli import main
try:
    main(["runs", "--search", "lens"])
except SystemExit as leaving:
    assert not leaving.code
print(*sorted(sys.modules))
"""
    modules = printed(code, cwd=tmp_path).splitlines()[-1].split()
    assert "sqlite3" in modules
    assert not {"h5py", "labseq.model", "numpy"} & {*modules}


def test_a_fit_imports_only_what_it_needs(tmp_path: Path) -> None:
    """So that `show --fit` of what a run measures takes no longer than `show`."""
    changes = ["scan={shot.hold.duration: [1 s, 10 s, 40 s]}", "repeats=1"]
    sequence = ROOT / "sequences" / "lifetime.yaml"
    with labseq.Session.open(sequence, overrides=changes, seed=1, output=tmp_path) as session:
        folder = session.run().path
    code = f"""
import sys
from labseq.cli import main
sys.argv = ["labseq", "show", {str(folder)!r}, "--scan", "survival:before,after", "--fit", "exponential"]
try:
    main()
except SystemExit:
    pass
print(sorted({{"h5py", "lmfit", "matplotlib", "numba", "pandas", "rich"}} & {{*sys.modules}}))
"""
    *_, decay, _, _, modules = printed(code, cwd=tmp_path).splitlines()
    assert decay.split()[0] == "decay"
    assert modules == "[]"


def test_the_core_is_what_a_virtual_run_loads(tmp_path: Path) -> None:
    """A reader of the core reads no more than this; it should become less (``poe structure``)."""
    files, _ = virtual_run(Path(labseq.__file__).parents[1], tmp_path)
    assert len(files) <= 117
    assert count_lines(files) <= 26_500


def test_no_kernel_is_loaded_in_a_shot_of_the_virtual_lab(tmp_path: Path) -> None:
    """Else the first run compiles it in the call of a device, which then counts as hung."""
    code = """
import sys
from labseq.cli import main
from labseq.sequencer.run import Sequencer

def kernels():
    return {name for name in sys.modules if "kernels" in name}

before, opening = [], Sequencer.open
Sequencer.open = lambda self: (before.append(kernels()), opening(self))[1]
try:
    main(["run", "compact_225", "--shots=1", "--seed=1", "--output=data"])
except SystemExit as leaving:
    assert not leaving.code
print(sorted(kernels() - before[0]))
"""
    assert printed(code, cwd=tmp_path).splitlines()[-1] == "[]"


WITHOUT_POSIX = """
import os
import asyncio, ctypes, importlib, logging.handlers, multiprocessing.shared_memory, multiprocessing.pool
import multiprocessing.popen_spawn_posix, pkgutil, signal, socket, ssl, subprocess, sys, tempfile, types
import filelock, h5py, matplotlib.figure, numba, numpy.random, pandas, PIL.Image, pluggy, pydantic, pytest
import hypothesis, psutil, rich.live, rich.progress, scipy.ndimage, scipy.optimize, scipy.special, serial
import tifffile, typer, xarray, yaml

for name in "fcntl termios resource pty pwd grp tty syslog readline crypt".split():
    sys.modules[name] = None
gone = set((
    "fork forkpty getuid geteuid getgid getgroups getppid killpg setsid uname nice getloadavg mkfifo statvfs "
    "sched_getaffinity sched_setaffinity fchmod chown openpty O_NOFOLLOW O_DIRECTORY O_NONBLOCK sysconf "
    "SIGKILL SIGHUP SIGUSR1 SIGUSR2 SIGALRM SIGPIPE SIGQUIT SIGCHLD setitimer alarm pthread_kill "
    "pthread_sigmask sigwait pause AF_UNIX"
).split())
instead = {(sys, "platform"): "win32", (os, "name"): "nt"}
guarded = {os, signal, socket, sys}

class AsOnWindows(types.ModuleType):
    def __getattribute__(self, name):
        value = super().__getattribute__(name)
        if self not in guarded or not (name in gone or (self, name) in instead):
            return value
        if "labseq" not in sys._getframe(1).f_globals.get("__name__", ""):
            return value
        if name in gone:
            raise AttributeError(name)
        return instead[self, name]

for module in guarded:
    module.__class__ = AsOnWindows

"""
"""For modules of labseq and its plugins the system is Windows, and what only POSIX has is missing; other
packages still see this system."""


def test_every_module_can_be_imported_where_there_is_no_posix(tmp_path: Path) -> None:
    code = """
wrong, n = [], 0
for top in ["labseq", *sys.argv[1:]]:
    for found in pkgutil.walk_packages(importlib.import_module(top).__path__, top + "."):
        if found.name.endswith("__main__"):
            continue
        n += 1
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:  # modules that the other control system imports
            if found.name.split(".")[0] != "labseq_bridges":
                wrong.append(f"{found.name}: {error}")
        except BaseException as error:
            wrong.append(f"{found.name}: {type(error).__name__}: {error}")
print(n, wrong)
"""
    plugins = sorted(path.parent.name for path in Path(__file__).parents[2].glob("plugins/*/__init__.py"))
    assert len(plugins) > 10
    no_compiling = "import os; os.environ['NUMBA_DISABLE_JIT'] = '1'\n"  # kernels are only imported
    n, _, wrong = printed(no_compiling + WITHOUT_POSIX + code, *plugins, cwd=tmp_path).strip().partition(" ")
    assert (int(n) > 300, wrong) == (True, "[]")


def test_a_virtual_run_needs_no_posix(tmp_path: Path) -> None:
    code = """
from labseq.cli import main
main(["run", "compact_225", "--shots=2", "--seed=1", "--output=data", "--debug"])
"""
    assert "2 of 2" in printed(WITHOUT_POSIX + code, cwd=tmp_path)
