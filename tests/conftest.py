"""What all tests share."""

import importlib.metadata
import itertools
import os
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import settings

from tests.needs import NEEDS, is_here

# Read when numpy is imported, which is later; on small arrays, threads of linear algebra mostly wait.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# A busy computer is not a failure, and what passed once passes again; ``poe search`` looks for new examples.
settings.register_profile("labseq", deadline=None, derandomize=True, max_examples=30)
settings.register_profile("search", deadline=None)
settings.load_profile("labseq")

REPOSITORY = Path(__file__).parents[1]
_NUMBERS = itertools.count()
LONGEST = ("tests/web/test_browser.py", "tests/docs/test_blocks.py")
"""Files whose tests take longest; each also prepares much that its tests share in one process."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--quick``, for running tests while editing."""
    parser.addoption("--quick", action="store_true", help="nothing outlives a power cut; checks plan less")


def pytest_configure() -> None:
    """Keep the user's folders, options and terminal from the tests and their processes."""
    terminal = ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES", "TTY_COMPATIBLE", "TTY_INTERACTIVE")
    for name in ("LABSEQ_DATA", "LABSEQ_PLUGIN_PATH", "PYTHONUNBUFFERED", *terminal):
        os.environ.pop(name, None)
    os.environ["TERM"] = "xterm-256color"
    for name in ("LABSEQ_LOCKS", "LABSEQ_STATE"):  # for fixtures that outlive a test: leads nowhere
        os.environ[name] = os.devnull
    # else each process that a test starts would compile numba's source again
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


def pytest_xdist_auto_num_workers() -> int:
    """Two processes for each core: a quarter of the time, tests wait for processes and devices."""
    return 2 * (os.cpu_count() or 1)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what the cache lacks before several processes begin: each would compile the same kernels.

    Tests that are named by their files may need few kernels.
    """
    config = session.config
    if hasattr(config, "workerinput") or not config.getoption("numprocesses"):
        return
    if not any(Path(argument).is_dir() for argument in config.args):
        return
    names = [
        ".".join(path.relative_to(base).with_suffix("").parts)
        for base, folder in ((REPOSITORY, "labseq"), (REPOSITORY / "plugins", "."))
        for path in (base / folder).rglob("*kernels*.py")
    ]
    code = f"""
import importlib, labseq.kernels.kernel as k
[*map(importlib.import_module, {names!r})]
if not all(one.is_cached() for one in k._PENDING if not one.is_helper):
    k.load_kernels()
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests come first: begun last, one would keep a process busy when the others have ended."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))


def pytest_collection_finish(session: pytest.Session) -> None:
    patch = pytest.MonkeyPatch()
    _look_up_once(patch)
    if session.config.getoption("--quick"):
        _be_quick(patch)


def _look_up_once(patch: pytest.MonkeyPatch) -> None:
    """What is installed, the state of this repository and the command line are the same for all tests.

    A process of labseq looks each up once; the tests are thousands of such processes in one.
    """
    from labseq.session import sources

    entry_points, read_text = importlib.metadata.entry_points, importlib.metadata.PathDistribution.read_text
    installed = cache(lambda _path, **which: entry_points(**which))
    patch.setattr(importlib.metadata, "entry_points", lambda **which: installed(tuple(sys.path), **which))
    patch.setattr(importlib.metadata.PathDistribution, "read_text", cache(read_text))
    patch.setattr(typer.main, "get_command", cache(typer.main.get_command))
    patch.setattr(sources, "_git", partial(_git_here_once, vars(sources)["_git"], {}))


def _be_quick(patch: pytest.MonkeyPatch) -> None:
    """Leave out what is rarely the subject of the tests that one runs while editing.

    Files need not outlive a power cut; checks plan for fewer loadings.
    """
    from labseq.session import check

    patch.setattr(check, "N_LOADINGS", check.N_LOADINGS // 20)
    patch.setattr(os, "fsync", os.fstat)


def _git_here_once(
    git: Callable[..., str | None],
    answers: dict[tuple[Any, ...], str | None],
    folder: Path,
    *arguments: str,
) -> str | None:
    if not folder.resolve().is_relative_to(REPOSITORY):
        return git(folder, *arguments)
    question = (os.environ.get("GIT_DIR"), folder, *arguments)
    if question not in answers:
        answers[question] = git(folder, *arguments)
    return answers[question]


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test that needs what is not here; fail it where everything must be."""
    needed = [name for marker in item.iter_markers("needs") for name in marker.args]
    for name in needed:
        if not is_here(name):
            reason = f"needs {name}: {NEEDS[name].install}"
            if os.environ.get("LABSEQ_REQUIRE_ALL"):
                pytest.fail(reason, pytrace=False)
            pytest.skip(reason)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """One line for each reason why tests were skipped."""
    reasons = Counter(
        str(report.longrepr[2]).removeprefix("Skipped: ")
        for report in terminalreporter.stats.get("skipped", ())
    )
    for reason, n in reasons.most_common():
        terminalreporter.write_line(f"{n} skipped: {reason}")


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
def call(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs a command in this process; returns its exit code, stdout and stderr."""

    from labseq.cli import main

    def run(*arguments: str) -> tuple[int, str, str]:
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
