"""What all tests share."""

import gc
import importlib.metadata
import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Generator
from functools import cache, partial
from importlib.machinery import SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from hypothesis import settings

from labseq.files import cache_root

# A busy computer is no failure, and what passed once passes again; ``poe search`` looks for new examples.
settings.register_profile("labseq", deadline=None, derandomize=True, max_examples=30)
settings.register_profile("search", deadline=None)
settings.load_profile("labseq")

for _name in ("LABSEQ_DATA", "LABSEQ_PLUGIN_PATH"):  # the user's own must not reach the tests
    os.environ.pop(_name, None)
for _name in ("LABSEQ_LOCKS", "LABSEQ_STATE"):  # for fixtures that outlive a test: leads nowhere
    os.environ[_name] = os.devnull

gc.disable()  # until all tests are collected, which makes a million objects that stay

if sys.dont_write_bytecode:  # else each process would compile the tests and numba's source again
    _BYTECODE, _TEMPORARY = cache_root() / "bytecode", Path(tempfile.gettempdir())
    shutil.rmtree(_BYTECODE / _TEMPORARY.relative_to(_TEMPORARY.anchor), ignore_errors=True)  # of past tests
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = str(_BYTECODE)
    sys.dont_write_bytecode = False

OPTIONAL = (
    *("PIL", "h5netcdf", "hdf5plugin", "matplotlib", "optuna", "pandas", "pyarrow", "pylablib", "pypylon"),
    *("ruff", "sphinx", "starlette", "tifffile", "uvicorn", "uvloop", "xarray"),
    *("axe_playwright_python", "httptools", "msgpack", "playwright", "zmq"),
)
_MISSING = [] if os.environ.get("LABSEQ_REQUIRE_ALL") else [m for m in OPTIONAL if find_spec(m) is None]
_NEEDS_MISSING = re.compile(
    rf"No module named '?({'|'.join(_MISSING)})\b|pip install [^\n]?labseq\[|No such file.*'ruff'"
)
_NUMBERS = itertools.count()
_WRITE: Callable[..., None] = vars(SourceFileLoader)["_cache_bytecode"]
_ENTRY_POINTS: Callable[..., Any] = importlib.metadata.entry_points
_READ_TEXT = importlib.metadata.PathDistribution.read_text
_GIT: dict[tuple[Path | str | None, ...], str | None] = {}
_REPOSITORY = Path(__file__).parents[1]
LONGEST = ("tests/web/test_browser.py", "tests/docs/test_blocks.py")
"""Files whose tests take longest; each also prepares much that its tests share in one process."""


def pytest_xdist_auto_num_workers() -> int:
    """Two processes for each core: a quarter of the time, tests wait for processes and devices."""
    return 2 * (os.cpu_count() or 1)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile all kernels before the whole suite begins: its processes would each compile the same ones."""
    config = session.config
    if hasattr(config, "workerinput") or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    names = [
        ".".join(path.relative_to(base).with_suffix("").parts)
        for base, folder in ((_REPOSITORY, "labseq"), (_REPOSITORY / "plugins", "."))
        for path in (base / folder).rglob("*kernels*.py")
    ]
    code = (
        f"import importlib, labseq.kernel as k; [*map(importlib.import_module, {names!r})]; k.load_kernels()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests come first: begun last, one would keep a process busy when the others have ended."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))


def pytest_collection_finish() -> None:
    """What costs time for nothing in a process of thousands of tests.

    Each session goes through all objects before its first shot, and keeps those out of later rounds: here
    it would be a fifth of the time of all runs, for pytest's own and those of other tests. And what is
    written need not outlive the machine; a process that is killed loses nothing of what it wrote. What is
    installed, the state of this repository and the command line stay the same: each run would read a hundred
    files for the first, start five processes for the second, and construct a parser for the last. Runs and
    checks plan for a twentieth of the random loadings.
    """
    from labseq.session import check, provenance, session

    gc.collect()
    gc.freeze()
    gc.enable()
    gc.set_threshold(100_000, 20, 20)  # what tests make is rarely garbage in cycles
    patch = pytest.MonkeyPatch()
    patch.setattr(session, "gc", SimpleNamespace(collect=int, freeze=int, get_freeze_count=int, unfreeze=int))
    patch.setattr(check, "N_LOADINGS", check.N_LOADINGS // 20)
    patch.setattr(os, "fsync", os.fstat)
    patch.setattr(SourceFileLoader, "_cache_bytecode", _cache_bytecode)
    patch.setattr(importlib.metadata, "entry_points", lambda **which: _entry_points(tuple(sys.path), **which))
    patch.setattr(importlib.metadata.PathDistribution, "read_text", cache(_READ_TEXT))
    patch.setattr(typer.main, "get_command", cache(typer.main.get_command))
    patch.setattr(provenance, "_git", partial(_git_here_once, vars(provenance)["_git"]))


@cache
def _entry_points(_path: tuple[str, ...], **which: str) -> Any:
    return _ENTRY_POINTS(**which)


def _git_here_once(git: Callable[..., str | None], folder: Path, *arguments: str) -> str | None:
    if not folder.resolve().is_relative_to(_REPOSITORY):
        return git(folder, *arguments)
    asked = (os.environ.get("GIT_DIR"), folder, *arguments)
    if asked not in _GIT:
        _GIT[asked] = git(folder, *arguments)
    return _GIT[asked]


def _cache_bytecode(
    loader: SourceFileLoader, source: str, bytecode: str, data: bytes, write: Callable[..., None] = _WRITE
) -> None:
    """Write bytecode, except of temporary files: a test may edit them within a second."""
    if not source.startswith(tempfile.gettempdir()):
        write(loader, source, bytecode, data)


def _skip_if_something_is_missing(report: pytest.CollectReport | pytest.TestReport) -> None:
    """A test that fails for want of an optional package is skipped, as `uv run pytest` installs none."""
    texts = [str(report.longrepr), *(text for _, text in report.sections)]
    if _MISSING and report.failed and any(_NEEDS_MISSING.search(text) for text in texts):
        report.outcome = "skipped"
        path, line, _ = getattr(report, "location", None) or (report.nodeid, 0, "")
        report.longrepr = (path, line or 0, "Skipped: needs a package of `uv sync --all-extras --all-groups`")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    _skip_if_something_is_missing(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    _skip_if_something_is_missing(report)
    return report


@pytest.fixture(autouse=True)
def own_state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders of state and locks for each test and its subprocesses, so that none sees another's runs."""
    folder = tmp_path_factory.getbasetemp() / "state" / str(next(_NUMBERS))
    monkeypatch.setenv("LABSEQ_STATE", str(folder))
    monkeypatch.setenv("LABSEQ_LOCKS", str(folder / "devices"))


@pytest.fixture
def pretend_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Makes Python find a package, until the test ends, as ``pip install -e`` would have."""

    def install(package: Path) -> None:
        project = tomllib.loads((package / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        name, version, points = project["name"], project["version"], project["entry-points"]["labseq"]
        info = tmp_path / "site-packages" / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        lines = (f"{point} = {module}\n" for point, module in points.items())
        (info / "entry_points.txt").write_text("[labseq]\n" + "".join(lines))
        monkeypatch.syspath_prepend(str(info.parent))
        monkeypatch.syspath_prepend(str(package / "src"))

    return install


@pytest.fixture
def call(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    """Runs a command in this process; returns its exit code, stdout and stderr."""

    from labseq.cli import main

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "stdout", sys.stdout)
        stdout, descriptor = sys.stdout, os.dup(1)  # --json redirects both for the rest of the process
        try:
            with pytest.raises(SystemExit) as leaving:
                main(arguments)
        finally:
            sys.stdout = stdout
            os.dup2(descriptor, 1)
            os.close(descriptor)
        code: Any = leaving.value.code or 0
        out, err = capfd.readouterr()
        return code, out, err

    return run
