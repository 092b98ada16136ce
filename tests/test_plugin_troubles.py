"""Third-party plugins that fail when they are loaded or constructed: named, contained, reported.

Each failure is a small plugin of its own. Failures in a run are in tests/session.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import labseq
from labseq.assembly.plugin_choice import ChosenPlugin, construct_one, construct_target, read_settings
from labseq.cli import main
from labseq.cli.plugins import Plugins
from labseq.config.document import Document
from labseq.errors import LabseqError, PluginLoadError
from labseq.plugins.calls import call_plugin
from labseq.plugins.host import LOCAL_PACKAGE, PluginHost, PluginInfo
from labseq.registry import Entry, Owner
from labseq.roles import Context

GOOD = '''
from labseq.plugin import Settings, hookimpl
LABSEQ_API = 1
# at the top

class Mine:
    """A planner."""
    degree_of_parallelism = 1

    def __init__(self, settings, context):
        pass  # constructor

    def plan(self, occupancy, target):
        return None

@hookimpl
def labseq_register(registry):
    registry.planner("mine", Mine)  # registration
'''
MAX_WAIT_S = 60.0
SHORT_S = 0.5


class Gate:
    """What a plugin that hangs waits for."""

    def __init__(self) -> None:
        self._opened = threading.Event()
        self.waiting: list[threading.Thread] = []

    def wait(self) -> None:
        self.waiting.append(threading.current_thread())
        self._opened.wait()

    def open(self) -> None:
        """Let the threads that wait go on, until they end."""
        self._opened.set()
        for thread in self.waiting:
            thread.join()


@pytest.fixture
def gate() -> Iterator[Gate]:
    gate = Gate()
    sys.modules["gate"] = gate  # pyright: ignore[reportArgumentType]
    yield gate
    gate.open()
    del sys.modules["gate"]


@pytest.fixture(autouse=True)
def clean_local_modules() -> Iterator[None]:
    yield
    for name in [n for n in sys.modules if n.startswith(LOCAL_PACKAGE)]:
        del sys.modules[name]


def loaded(folder: Path, code: str, max_wait_s: float = MAX_WAIT_S) -> tuple[PluginHost, PluginInfo]:
    (folder / "mine.py").write_text(code, encoding="utf-8")
    host = PluginHost(max_wait_s)
    host.load_folders([folder])
    return host, host.infos[-1]


def impatient(host: PluginHost) -> Entry:
    entry = host.get("planner", "mine")
    return replace(entry, owner=replace(entry.owner, max_wait_s=0.5))


def construct(host: PluginHost) -> Any:
    return construct_one(ChosenPlugin(host.get("planner", "mine"), None), Context("planner"))


REGISTER = 'registry.planner("mine", Mine)  # registration'
HOOK = "@hookimpl\ndef labseq_register(registry):"
TOP, CONSTRUCTOR = "# at the top", "pass  # constructor"
AT_LOADING = [
    # what in the good plugin is replaced, by what, and the reason that is given
    (TOP, "import no_such_sdk", "ModuleNotFoundError: No module named 'no_such"),
    (TOP, "raise SystemExit(0)", "SystemExit: 0 ("),
    (TOP, "raise KeyboardInterrupt", "KeyboardInterrupt ("),
    (TOP, "def f(): f()\nf()", "RecursionError: maximum recursion depth"),
    (TOP, "import labseq\nraise labseq.DeviceError('camera', 'no cable')", "DeviceError: camera: no cable ("),
    (
        TOP,
        "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)",
        "ValueError: signal only works in main thread",
    ),
    ("LABSEQ_API = 1", "LABSEQ_API = 2", "LABSEQ_API 2, but this labseq has LABSEQ_API = 1; up"),
    ("LABSEQ_API = 1", "", "does not state LABSEQ_API; write 'LABSEQ_API = 1'"),
    ("LABSEQ_API = 1", "LABSEQ_API = '1.0'", "'1.0', which is not a whole number"),
    ("def labseq_register", "def labseq_regster", "unknown hook 'labseq_regster'"),
    (
        TOP,
        "def labseq_shot_finished(shot): pass",
        "its labseq_shot_finished would not be called; write '@hookimpl' above it",
    ),
    ("(registry):", "(register):", "an argument 'register'; expected 'registry'"),
    ("(registry):", "():", "has no argument; expected 'registry'"),
    ("def labseq_register", "async def labseq_register", "is an 'async' function"),
    (REGISTER, "yield", "is a generator and would never run"),
    ("@hookimpl", "@hookimpl(wrapper=True)", "its labseq_register is a wrapper"),
    (REGISTER, "1 / 0", "ZeroDivisionError: division by zero"),
    ("registry.planner", "registry.planer", "has no attribute 'planer'"),
    ('"mine", Mine', '"mine", "Mine"', "the factory of planner 'mine' cannot be called"),
    (REGISTER, f"{REGISTER}\n    {REGISTER}", "is already offered by 'mine'"),
    (
        TOP,
        "class Bad(Settings):\n    size: 'NoSuchType' = None\n    model_config = {'frozen': 3}\nBad(size=1)",
        "PydanticUserError",
    ),
    ("LABSEQ_API = 1", "def __getattr__(name): raise OSError(name)", "OSError: LABSEQ_API"),
]


@pytest.mark.parametrize(("old", "new", "reason"), AT_LOADING)
def test_a_plugin_that_fails_to_load_is_contained(tmp_path: Path, old: str, new: str, reason: str) -> None:
    assert old in GOOD
    host, info = loaded(tmp_path, GOOD.replace(old, new))
    assert info.state == "failed"
    assert reason in info.reason
    assert len(info.reason) < 1000
    assert info.reason.isprintable()
    assert host.registry.entries() == []
    assert f"mine: {info.reason}" in Plugins.of(host).as_text()
    with pytest.raises(PluginLoadError) as caught:
        host.get("planner", "mine")
    assert str(caught.value).startswith("plugin 'mine' failed to load: ")
    assert str(tmp_path / "mine.py") in str(caught.value)  # where it comes from


class TestHanging:
    def test_at_import(self, tmp_path: Path, gate: Gate) -> None:
        code = GOOD.replace("# at the top", "print(1)\nimport gate; gate.wait()")
        stdout = sys.stdout
        _, info = loaded(tmp_path, code, SHORT_S)
        assert "did not finish loading within 0.5 s" in info.reason
        assert "'timeouts: {load: ...}'" in info.reason
        assert sys.stdout is stdout
        assert "it printed '1'" in info.notes[0]
        assert f"{LOCAL_PACKAGE}.mine" not in sys.modules

    def test_what_wakes_up_later_registers_nothing(self, tmp_path: Path, gate: Gate) -> None:
        code = GOOD.replace("# registration", "").replace(HOOK, f"{HOOK}\n    import gate; gate.wait()")
        host, _ = loaded(tmp_path, code, SHORT_S)
        gate.open()
        assert host.registry.entries() == []

    def test_in_the_constructor(self, tmp_path: Path, gate: Gate) -> None:
        code = GOOD.replace("pass  # constructor", "import gate; gate.wait()")
        host, info = loaded(tmp_path, code)
        assert info.state == "loaded"
        message = (
            r"the constructor of planner 'mine' did not return within 0\.5 s and was abandoned; if it is"
        )
        with pytest.raises(PluginLoadError, match=message):
            construct_one(ChosenPlugin(impatient(host), None), Context("planner"))


IN_THE_CONSTRUCTOR = [
    (CONSTRUCTOR, "raise OSError('no port')", "constructor of planner 'mine' raised OSErr"),
    (CONSTRUCTOR, "raise SystemExit(0)", "raised SystemExit: 0 ("),
    ("(self, settings, context)", "(self, settings)", "takes 2 positional argum"),
    (REGISTER, 'registry.planner("mine", lambda s, c: None)', "made None instead of an object"),
    ("def plan(", "def plann(", "planner 'mine' has no method plan; see labseq.plugin.Planner"),
    (
        "    def plan(",
        "    @property\n    def plan(self): raise KeyError('x')\n    def _(",
        "the constructor of planner 'mine' raised KeyError: 'x'",
    ),
    (
        REGISTER,
        "global kept; kept = registry; registry.planner('mine', lambda s, c: kept.planner('more', Mine))",
        "it registers planner 'more' after its labseq_register has returned; register everything there",
    ),
]


@pytest.mark.parametrize(("old", "new", "reason"), IN_THE_CONSTRUCTOR)
def test_a_plugin_whose_constructor_fails_is_named(tmp_path: Path, old: str, new: str, reason: str) -> None:
    assert old in GOOD
    host, info = loaded(tmp_path, GOOD.replace(old, new))
    assert info.state == "loaded", info.reason
    with pytest.raises(PluginLoadError) as caught:
        construct(host)
    assert reason in str(caught.value)
    assert str(tmp_path / "mine.py") in str(caught.value)
    assert [entry.name for entry in host.registry.entries()] == ["mine"]


def test_a_pattern_of_the_wrong_shape_is_named(tmp_path: Path) -> None:
    code = GOOD.replace(REGISTER, 'registry.pattern("mine", lambda settings, grid: [1, 2])')
    host, _ = loaded(tmp_path, code)
    grid = labseq.SiteGrid(3, 3, 5e-6)
    with pytest.raises(PluginLoadError, match=r"made no TargetPattern of shape \(3, 3\), but a list"):
        construct_target(ChosenPlugin(host.get("pattern", "mine"), None), grid)


SETTINGS = """
import pydantic

class Odd(Settings):
    size: int = 1

    @pydantic.model_validator(mode="before")
    @classmethod
    def check(cls, values):
        TROUBLE
"""


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("raise SystemExit(0)", "the settings model of planner 'mine' raised SystemExit: 0 ("),
        ("import gate; gate.wait()", "the settings model of planner 'mine' did not return within "),
    ],
)
def test_a_settings_model_that_fails_is_named(code: str, message: str, tmp_path: Path, gate: Gate) -> None:
    code = GOOD.replace("# at the top", SETTINGS.replace("TROUBLE", code)).replace(
        "Mine)  #", "Mine, Odd)  #"
    )
    host, info = loaded(tmp_path, code)
    assert info.state == "loaded", info.reason
    document = Document.parse("planner: {use: mine, size: 3}\n", "s.yaml")
    with pytest.raises(LabseqError) as caught:
        read_settings(document, impatient(host), ("planner",), frozenset({"use"}))
    assert message in str(caught.value)
    assert str(caught.value).startswith("s.yaml:1:")


class Point:
    """An entry point of a distribution that is not installed."""

    def __init__(self, name: str, distribution: str, load: Callable[[], object]) -> None:
        self.name = self.value = name
        self.dist = SimpleNamespace(read_text=lambda _: f"Name: {distribution}\nVersion: 1.2\n\nVersion: 2")
        self.load = load


def module(name: str, code: str = GOOD) -> ModuleType:
    made = ModuleType(name)
    exec(code, made.__dict__)
    return made


def test_two_distributions_with_a_plugin_of_one_name(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        Point("ixon", "labseq-ixon", lambda: module("a")),
        Point("ixon", "lab-of-bob", lambda: module("b")),
    ]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    host = PluginHost()
    host.load_entry_points()
    first, second = host.infos
    assert (first.state, first.source) == ("loaded", "the distribution labseq-ixon 1.2")
    assert (second.name, second.state) == ("ixon (the distribution lab-of-bob 1.2)", "failed")
    assert "labseq-ixon 1.2) is already called 'ixon'" in second.reason
    assert host.get("planner", "mine").origin == "ixon"


def test_an_installed_plugin_is_named_by_its_distribution(monkeypatch: pytest.MonkeyPatch) -> None:
    code = GOOD.replace("pass  # constructor", "raise OSError('no port')")
    points = [
        Point("ixon", "labseq-ixon", lambda: module("ixon", code)),
        Point("odd", "labseq-odd", lambda: 5),
        Point("old", "labseq-old", lambda: module("old", "LABSEQ_API = 0")),
    ]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    host = PluginHost()
    host.load_entry_points()
    assert [info.state for info in host.infos] == ["loaded", "failed", "failed"]
    with pytest.raises(
        PluginLoadError, match=r"plugin 'old' .*; it comes from the distribution labseq-old 1\.2$"
    ):
        host.get("planner", "old")
    with pytest.raises(PluginLoadError, match="the constructor of planner 'mine' raised OSError: no port"):
        construct(host)


NOISY = (
    "import os, sys\nprint('hello')\nos.write(1, b'from C')\nsys.stdout.write('again')\nsys.stdout.flush()"
)


def test_what_plugins_print_spoils_no_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(GOOD.replace("# at the top", NOISY))
    (tmp_path / "other.py").write_text("1 / 0")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    with pytest.raises(SystemExit) as leaving:
        main(["plugins", "--json"])
    out, err = capfd.readouterr()
    assert leaving.value.code == 0
    found = {one["name"]: one for one in json.loads(out)["plugins"]}
    assert "hello" in err
    assert found["mine"]["offers"] == ["planner:mine"]
    assert "it printed 'hello again' to stderr" in found["mine"]["notes"][0]
    assert (found["other"]["state"], found["other"]["offers"]) == ("failed", [])
    assert {one["state"] for name, one in found.items() if name != "other"} == {"loaded"}
    assert [name for name, one in found.items() if one["notes"]] == ["mine"]  # labseq's own print nothing


def test_the_table_shows_failures_and_what_a_plugin_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(GOOD.replace("# at the top", "print('hi')"))
    (tmp_path / "other.py").write_text("1 / 0")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    with pytest.raises(SystemExit):
        main(["plugins"])
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line for line in lines if line}
    assert "loaded" in rows["labseq_virtual"]
    assert "camera:virtual" in rows["labseq_virtual"]
    assert "failed" in rows["other"]
    assert "ZeroDivisionError" in rows["other:"]
    assert any(line.startswith("mine: warning: while it was loaded it printed 'hi'") for line in lines)


def test_a_program_without_stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    owner = Owner("mine")
    for _ in range(2):
        call_plugin(owner, "pattern 'x'", lambda: print("no reader"))
    (note,) = owner.notes
    assert note.startswith("in pattern 'x' it printed 'no reader'")
    assert sys.stdout is None
