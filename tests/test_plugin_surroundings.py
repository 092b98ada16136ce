"""Plugins that change what all code in the process shares: put back, and told with the plugin's name."""

from __future__ import annotations

import gc
import locale
import logging
import multiprocessing
import os
import random
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from labseq.plugins import LOCAL_PACKAGE, PluginHost, contained
from labseq.plugins.contained import SHARED
from labseq.registry import Owner

PLUGIN = """
import labseq
LABSEQ_API = 1

@labseq.hookimpl
def labseq_register(registry):
    registry.planner("mine", print)

import os, sys, gc, random, locale, logging, socket, threading, multiprocessing, warnings
import numpy as np
"""
CHANGES: dict[str, tuple[str, Callable[[], Any], str]] = {
    # what it does -> how, what must be as before, and how it is told
    "seeds": ("random.seed(1)", random.getstate, "it seeded or used Python's global random numbers"),
    "draws": ("random.random()", random.getstate, "draw from context.random"),
    "seeds numpy": (
        "np.random.seed(1)",
        lambda: str(np.random.get_state()),  # noqa: NPY002
        "it seeded or used numpy's global random numbers",
    ),
    "numpy errors": ("np.seterr(all='raise')", np.geterr, "it changed numpy's error state"),
    "numpy printing": ("np.set_printoptions(precision=1)", np.get_printoptions, "numpy's print options"),
    "no warnings": (
        "warnings.simplefilter('ignore')",
        lambda: list(warnings.filters),
        "it set everybody's warnings of Warning to 'ignore'",
    ),
    "fewer warnings": (
        "warnings.filterwarnings('always', category=UserWarning)",
        lambda: list(warnings.filters),
        "it set everybody's warnings of UserWarning to 'always'",
    ),
    "default warnings": (
        "warnings.resetwarnings()",
        lambda: list(warnings.filters),
        "it changed everybody's rules for warnings",
    ),
    "folder": ("os.chdir('/')", Path.cwd, "it changed the working folder to "),
    "locale": (
        "locale.setlocale(locale.LC_ALL, 'C.UTF-8' if locale.setlocale(locale.LC_ALL) == 'C' else 'C')",
        lambda: locale.setlocale(locale.LC_ALL),
        "it changed the locale to ",
    ),
    "environment": (
        "os.environ['OMP_NUM_THREADS'] = '1'; del os.environ['LABSEQ_STATE']; os.environ['PATH'] += ':/x'",
        lambda: dict(os.environ),
        "the environment variables 'LABSEQ_STATE', 'OMP_NUM_THREADS', 'PATH'; this was put back: set it in",
    ),
    "path": ("sys.path.insert(0, '/lab')", lambda: list(sys.path), "sys.path (it added the folder '/lab')"),
    "path order": ("sys.path.reverse()", lambda: list(sys.path), "it changed sys.path; this was put back"),
    "logging": (
        "logging.basicConfig(level='DEBUG', force=True)",
        lambda: (logging.root.level, list(logging.root.handlers)),
        "it changed the root of Python's logging",
    ),
    "no logging": ("logging.disable()", lambda: logging.root.manager.disable, "root of Python's logging"),
    "excepthook": ("sys.excepthook = print", lambda: sys.excepthook, "replaced sys.stderr or an excepthook"),
    "stderr": ("sys.stderr = open(os.devnull)", lambda: sys.stderr, "replaced sys.stderr or an excepthook"),
    "stdout": ("sys.stdout = sys.stderr", lambda: sys.stdout, "it replaced sys.stdout; this was put back"),
    "prints": ("print('two', 'words')", lambda: sys.stdout, "it printed ('two words'); this went to stderr"),
    "recursion": (
        "sys.setrecursionlimit(sys.getrecursionlimit() + 9)",
        sys.getrecursionlimit,
        "it set the recursion limit to ",
    ),
    "garbage": ("gc.disable()", gc.isenabled, "it switched garbage collection on or off"),
    "sockets": ("socket.setdefaulttimeout(1)", socket.getdefaulttimeout, "a timeout for everybody's sockets"),
    "processes": (
        "multiprocessing.set_start_method('spawn', force=True)",
        lambda: multiprocessing.get_start_method(allow_none=True),
        "it set how multiprocessing starts processes",
    ),
}


@pytest.fixture(autouse=True)
def clean_local_modules() -> Iterator[None]:
    yield
    for name in [n for n in sys.modules if n.startswith(LOCAL_PACKAGE)]:
        del sys.modules[name]


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("change", CHANGES)
def test_what_a_plugin_changes_is_put_back_and_told(change: str, tmp_path: Path) -> None:
    code, read, told = CHANGES[change]
    (tmp_path / "mine.py").write_text(f"{PLUGIN}{code}\n", encoding="utf-8")
    host, before = PluginHost(), read()
    host.load_folders([tmp_path])
    (info,) = host.infos
    assert info.state == "loaded", info.reason
    (note,) = info.notes
    assert told in note
    assert note.startswith("while it was loaded it ")
    assert read() == before
    assert host.notes == []  # nobody has asked for it
    host.get("planner", "mine")
    assert host.notes == [f"plugin 'mine' ({tmp_path / 'mine.py'}): {note}"]


def test_everything_that_is_looked_at_is_tried() -> None:
    assert len(SHARED) == 15  # a new one needs a row above


def test_what_concerns_nobody_else_is_left_alone(tmp_path: Path) -> None:
    code = """
class MineWarning(Warning): pass
warnings.filterwarnings("ignore", category=MineWarning)
warnings.filterwarnings("ignore", message="mine")
logging.getLogger("mine").addHandler(logging.NullHandler())
np.random.default_rng(1).random()
random.Random(1).random()
with np.errstate(all="raise"), warnings.catch_warnings():
    warnings.simplefilter("ignore")
"""
    (tmp_path / "mine.py").write_text(PLUGIN + code, encoding="utf-8")
    host = PluginHost()
    with warnings.catch_warnings():
        host.load_folders([tmp_path])
        (info,) = host.infos
        assert (info.state, info.notes) == ("loaded", [])
        assert "MineWarning" in str(warnings.filters)


def test_rules_of_its_own_stay_where_others_are_put_back() -> None:
    class MineWarning(Warning):
        pass

    def work() -> None:
        warnings.simplefilter("ignore")
        warnings.simplefilter("ignore", MineWarning)

    with warnings.catch_warnings():
        before = list(warnings.filters)
        contained(Owner("mine"), "", work)
        assert warnings.filters[1:] == before
        assert warnings.filters[0][2] is MineWarning


def test_a_plugin_that_fails_is_put_back_too(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import os\nos.chdir('/')\n1 / 0\n", encoding="utf-8")
    host, before = PluginHost(), Path.cwd()
    host.load_folders([tmp_path])
    assert host.infos[0].state == "failed"
    assert "it changed the working folder to" in host.infos[0].notes[0]
    assert Path.cwd() == before


def test_several_changes_are_told_one_by_one() -> None:
    owner = Owner("mine")

    def work() -> int:
        os.environ.update({f"MINE_{k}": "1" for k in range(5)})
        random.seed(1)
        return 3

    assert contained(owner, "the constructor of camera 'x'", work) == 3
    assert contained(owner, "the constructor of camera 'x'", work) == 3  # told once
    first, second = owner.notes
    assert first.startswith("in the constructor of camera 'x' it seeded or used Python's global random num")
    assert "it changed the environment variables 'MINE_0', 'MINE_1', 'MINE_2' and 2 more; this was" in second


def test_threads_are_told() -> None:
    owner, end = Owner("mine"), threading.Event()
    thread = threading.Thread(target=end.wait, name="watchdog", daemon=True)
    contained(owner, "", thread.start)
    end.set()
    thread.join()
    (note,) = owner.notes
    assert note.startswith("while it was loaded it started the thread 'watchdog'; start none before open()")


def test_a_folder_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    owner = Owner("mine")
    contained(owner, "", lambda: (os.chdir(tmp_path), gone.rmdir()))
    assert "it changed the working folder to" in owner.notes[0]  # it cannot be put back


def test_what_it_kept_of_stdout_leads_there_later(capsys: pytest.CaptureFixture[str]) -> None:
    kept = contained(Owner("mine"), "", lambda: sys.stdout)
    print("later", file=kept)
    assert capsys.readouterr() == ("later\n", "")
    assert kept.encoding == sys.stdout.encoding


def test_without_any_stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    owner = Owner("mine")
    contained(owner, "", lambda: print("nobody hears it"))
    assert "it printed ('nobody hears it')" in owner.notes[0]
    assert sys.stdout is None


def test_what_is_not_loaded_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "socket")
    owner = Owner("mine")
    fake = SimpleNamespace(getdefaulttimeout=lambda: 1.0)
    contained(owner, "", lambda: sys.modules.update(socket=fake))  # pyright: ignore[reportArgumentType]
    assert owner.notes == []
