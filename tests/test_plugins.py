"""The plugin host: loading, blocking, reporting."""

import importlib.metadata
import signal
import sys
from types import ModuleType

import pytest

from labseq import hookspecs
from labseq.errors import ConfigError, PluginLoadError, UnknownPluginError
from labseq.plugins import LOCAL_PACKAGE, PluginHost

GOOD = """
from labseq.plugin import hookimpl
LABSEQ_API = 1

class Mine:
    def __init__(self, settings, context): pass

@hookimpl
def labseq_register(registry):
    registry.planner("mine", Mine)
"""


@pytest.fixture
def host():
    return PluginHost()


@pytest.fixture(autouse=True)
def clean_local_modules():
    yield
    for name in [n for n in sys.modules if n.startswith(LOCAL_PACKAGE)]:
        del sys.modules[name]


def load(host, folder, text, name="mine"):
    (folder / f"{name}.py").write_text(text, encoding="utf-8")
    host.load_folders([folder])
    return host.infos[-1]


def test_a_file_in_a_folder_is_a_plugin(host, tmp_path):
    info = load(host, tmp_path, GOOD)
    assert (info.name, info.state, info.origin) == ("mine", "loaded", str(tmp_path / "mine.py"))
    entry = host.get("planner", "mine")
    assert entry.origin == "mine"
    assert entry.factory.__module__ == "labseq_local.mine"


def test_a_package_in_a_folder_is_a_plugin(host, tmp_path):
    package = tmp_path / "mine"
    package.mkdir()
    (package / "__init__.py").write_text(GOOD.replace("class Mine:", "from .part import VALUE\nclass Mine:"))
    (package / "part.py").write_text("VALUE = 1\n")
    host.load_folders([tmp_path])
    assert host.infos[-1].state == "loaded", host.infos[-1].reason
    assert host.get("planner", "mine")


def test_a_package_is_loaded_as_it_is_now(tmp_path):
    for folder, value in (("one", 1), ("two", 2)):  # of one name, in one process, as in a notebook
        package = tmp_path / folder / "mine"
        package.mkdir(parents=True)
        text = GOOD.replace("class Mine:", "from .part import VALUE\nclass Mine:\n    value = VALUE")
        (package / "__init__.py").write_text(text)
        (package / "part.py").write_text(f"VALUE = {value}\n")
        host = PluginHost()
        host.load_folders([tmp_path / folder])
        assert vars(host.get("planner", "mine").factory)["value"] == value


def test_hidden_files_and_other_files_are_left_alone(host, tmp_path):
    for name in ("_private.py", ".hidden.py", "notes.txt", "data.json"):
        (tmp_path / name).write_text("raise SystemExit(1)")
    (tmp_path / "empty_folder").mkdir()
    host.load_folders([tmp_path])
    assert host.infos == []


def test_an_installed_library_in_a_folder_is_not_a_plugin(host, tmp_path, monkeypatch):
    (tmp_path / "some_simulator.py").write_text("x = 1\n")
    (tmp_path / "mine.py").write_text(GOOD)
    monkeypatch.syspath_prepend(tmp_path)
    host.load_folders([tmp_path])
    assert [(info.name, info.state) for info in host.infos] == [("mine", "loaded")]


def test_a_file_whose_name_cannot_be_imported_is_reported(host, tmp_path):
    info = load(host, tmp_path, GOOD, "my-planner")
    assert (info.name, info.state) == ("my-planner", "failed")
    assert "rename it" in info.reason


@pytest.fixture
def ctrl_c():
    """As in a terminal, also where the tests run in the background and Ctrl-C is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_while_a_plugin_loads_goes_through(host, tmp_path, ctrl_c):
    code = "import signal, threading\nsignal.raise_signal(signal.SIGINT)\nthreading.Event().wait(1.0)\n"
    stdout = sys.stdout
    with pytest.raises(KeyboardInterrupt):
        load(host, tmp_path, code)
    assert sys.stdout is stdout


def test_a_file_in_place_of_a_folder_is_the_users_mistake(host, tmp_path):
    (tmp_path / "mine.py").write_text(GOOD)
    with pytest.raises(ConfigError, match="cannot be read: Not a directory"):
        host.load_folders([tmp_path / "mine.py"])


def test_the_environment_names_folders_too(host, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(GOOD)
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    host.load_folders([])
    assert host.get("planner", "mine")


def test_a_folder_given_twice_is_loaded_once(host, tmp_path, monkeypatch):
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    load(host, tmp_path, GOOD)
    assert [info.state for info in host.infos] == ["loaded"]


def test_a_missing_folder_is_the_users_mistake(host, tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        host.load_folders([tmp_path / "nowhere"])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("import nothing_of_this_name\nLABSEQ_API = 1\n", "ModuleNotFoundError: No module named"),
        ("LABSEQ_API = 1\ndef broken(:\n", "SyntaxError"),
        ("LABSEQ_API = 1\nraise SystemExit(2)\n", "SystemExit: 2"),
        ("x = 1\n", "does not state LABSEQ_API"),
        ("LABSEQ_API = 99\n", "was written for LABSEQ_API 99"),
        ("LABSEQ_API = '1'\n", "was written for LABSEQ_API '1', which is no whole number; this labseq has"),
        ("class Odd(BaseException): pass\nraise Odd('no')\n", "Odd: no"),
        ("raise ValueError('two\\nlines\\x1b[31m')\n", "ValueError: two lines?[31m"),
        (GOOD.replace('"mine", Mine', '"mine", Mine, dict'), "expected a subclass of labseq.plugin.Settings"),
        (
            GOOD.replace("def labseq_register(registry)", "def labseq_register(register)"),
            "an argument 'register'",
        ),
        (GOOD.replace("def labseq_register(registry)", "def labseq_register()"), "has no argument"),
        (GOOD.replace("@hookimpl\n", ""), "it implements no hook; write '@hookimpl'"),
        (GOOD.replace("def labseq_register", "def labseq_regster"), "unknown hook"),
        (GOOD.replace('"mine", Mine', '"", Mine'), "a planner needs a name"),
        (GOOD.replace('"mine", Mine', '"mine", 5'), "cannot be called"),
        (GOOD.replace("registry.planner", "registry.planer"), "has no attribute 'planer'"),
        (GOOD.replace('("mine", Mine)', '("mine", Mine); 1 / 0'), "ZeroDivisionError"),
    ],
)
def test_a_broken_plugin_is_reported_and_contained(host, tmp_path, text, reason):
    info = load(host, tmp_path, text)
    assert info.state == "failed"
    assert reason in info.reason
    assert host.registry.entries() == []
    with pytest.raises(PluginLoadError, match="plugin 'mine' failed to load") as caught:
        host.get("planner", "mine")
    assert reason in str(caught.value)


def test_the_reason_names_file_and_line(host, tmp_path):
    info = load(host, tmp_path, "LABSEQ_API = 1\n\nraise RuntimeError('no')\n")
    assert f"{tmp_path / 'mine.py'}:3" in info.reason


def test_a_broken_plugin_does_not_hide_the_next(host, tmp_path):
    load(host, tmp_path, "1 / 0", "a_broken")
    load(host, tmp_path, GOOD)
    assert host.get("planner", "mine")


def test_a_name_taken_twice_names_both_origins(host, tmp_path):
    load(host, tmp_path, GOOD, "first")
    other = tmp_path / "more"
    other.mkdir()
    info = load(host, other, GOOD, "second")
    assert info.state == "failed"
    assert "planner 'mine' is offered by 'first' already" in info.reason
    with pytest.raises(PluginLoadError, match="offered by 'first' already"):
        host.get("planner", "mine")


def test_two_files_of_one_name_in_two_folders(host, tmp_path):
    load(host, tmp_path, GOOD)
    other = tmp_path / "more"
    other.mkdir()
    info = load(host, other, GOOD.replace('"mine"', '"mine_too"'))
    assert info.state == "failed"
    assert str(tmp_path / "mine.py") in info.reason


def test_an_unknown_name_suggests_the_nearest(host, tmp_path):
    load(host, tmp_path, GOOD)
    with pytest.raises(UnknownPluginError, match="did you mean 'mine'"):
        host.get("planner", "mien")


def test_an_unknown_name_tells_of_plugins_that_did_not_load(host, tmp_path):
    load(host, tmp_path, "1 / 0", "other")
    with pytest.raises(UnknownPluginError, match="plugin 'other' did not load"):
        host.get("planner", "mine")


def test_one_failing_entry_point_takes_nothing_down(host, monkeypatch):
    class Point:
        dist = None

        def __init__(self, name, load):
            self.name = self.value = name
            self.load = load

    def fail():
        raise ImportError("no vendor library")

    good = ModuleType("good")
    exec(GOOD, good.__dict__)
    points = [Point("bad", fail), Point("good", lambda: good)]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    host.load_entry_points()
    assert [(info.name, info.state) for info in host.infos] == [("bad", "failed"), ("good", "loaded")]
    assert host.get("planner", "mine")


def test_observers_that_fail_are_named_and_the_others_called(host, tmp_path):
    watcher = """
from labseq.plugin import hookimpl
LABSEQ_API = 1
seen = []

@hookimpl
def labseq_shot_finished(shot):
    seen.append(shot)
"""
    load(host, tmp_path, watcher, "good_watcher")
    load(host, tmp_path, watcher.replace("seen.append(shot)", "1 / 0"), "bad_watcher")
    listeners = dict(host.listeners("labseq_shot_finished", shot="a shot"))
    with pytest.raises(ZeroDivisionError):
        listeners["bad_watcher"]()
    listeners["good_watcher"]()
    assert sys.modules["labseq_local.good_watcher"].seen == ["a shot"]


def test_every_hook_is_documented():
    hooks = [value for name, value in vars(hookspecs).items() if name.startswith("labseq_")]
    assert len(hooks) == 4
    assert all(hook.__doc__ for hook in hooks)


def test_hosts_share_nothing(host, tmp_path):
    load(host, tmp_path, GOOD)
    other = PluginHost()
    assert other.infos == []
    assert other.registry.find("planner", "mine") is None
