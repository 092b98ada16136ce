"""The plugin host: loading, blocking, reporting."""

import re
import signal
import sys
from fractions import Fraction
from pathlib import Path

import pytest

from labseq import hookspecs
from labseq.errors import ConfigError, PluginLoadError, UnknownPluginError
from labseq.plugins.host import LOCAL_PACKAGE, PluginHost
from labseq.settings import Settings

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


def test_a_package_is_loaded_as_it_is_now(tmp_path, monkeypatch):
    for folder, value in (("one", 1), ("two", 2)):  # of one name, in one process, as in a notebook
        package = tmp_path / folder / "mine"
        package.mkdir(parents=True)
        text = GOOD.replace("class Mine:", "from .part import VALUE\nclass Mine:\n    value = VALUE")
        (package / "__init__.py").write_text(text)
        (package / "part.py").write_text(f"VALUE = {value}\n")
        monkeypatch.chdir(tmp_path / folder)
        host = PluginHost()
        host.load_folders([Path()])
        assert vars(host.get("planner", "mine").factory)["value"] == value


PLACES = GOOD.replace('"mine", Mine)', '"mine", "fractions:Fraction", "labseq.plugin:Settings")')


def test_what_is_given_by_its_place_is_imported_when_it_is_named(host, tmp_path):
    assert load(host, tmp_path, PLACES).state == "loaded"
    assert host.registry.names("planner") == ["mine"]
    entry = host.get("planner", "mine")
    assert (entry.factory, entry.settings_model) == (Fraction, Settings)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (
            "fractions:",
            "no_such_module:",
            "the import of planner 'mine' raised ModuleNotFoundError: No module",
        ),
        (":Fraction", ":Fiction", "the import of planner 'mine' raised AttributeError: module 'fractions'"),
        ("fractions:Fraction", "math:pi", "the factory of planner 'mine' cannot be called"),
        (":Settings", ":Problem", "the settings model of planner 'mine' is <class 'labseq.errors.Problem'>"),
    ],
)
def test_a_place_where_nothing_is_names_the_plugin(host, tmp_path, old, new, reason):
    load(host, tmp_path, PLACES.replace(old, new))
    with pytest.raises(PluginLoadError, match=re.escape(reason)) as caught:
        host.get("planner", "mine")
    assert caught.value.plugin == "mine"
    host.import_all()
    assert host.infos[-1].state == "failed"
    assert host.infos[-1].reason.startswith(reason)
    assert host.registry.names("planner") == []


def test_other_files_are_ignored_and_odd_names_reported(host, tmp_path):
    for name in ("_private.py", ".hidden.py", "notes.txt", "data.json"):
        (tmp_path / name).write_text("raise SystemExit(1)")
    (tmp_path / "empty_folder").mkdir()
    host.load_folders([tmp_path])
    assert host.infos == []
    info = load(host, tmp_path, GOOD, "my-planner")
    assert (info.name, info.state) == ("my-planner", "failed")
    assert "rename it" in info.reason


def test_an_installed_library_in_a_folder_is_not_a_plugin(host, tmp_path, monkeypatch):
    (tmp_path / "some_simulator.py").write_text("x = 1\n")
    (tmp_path / "mine.py").write_text(GOOD)
    monkeypatch.syspath_prepend(tmp_path)
    host.load_folders([tmp_path])
    assert [(info.name, info.state) for info in host.infos] == [("mine", "loaded")]


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
    with pytest.raises(ConfigError, match="does not exist"):
        host.load_folders([tmp_path / "nowhere"])


def test_a_folder_of_the_environment_that_is_also_given_is_loaded_once(host, tmp_path, monkeypatch):
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    load(host, tmp_path, GOOD)
    assert [info.state for info in host.infos] == ["loaded"]
    (tmp_path / "mine.py").write_text(GOOD)
    other = PluginHost()
    other.load_folders([])
    assert other.get("planner", "mine")


def test_the_reason_names_file_and_line_and_the_next_plugin_is_loaded(host, tmp_path):
    info = load(host, tmp_path, "LABSEQ_API = 1\n\nraise RuntimeError('no')\n")
    assert f"{tmp_path / 'mine.py'}:3" in info.reason
    (tmp_path / "mine.py").unlink()
    load(host, tmp_path, GOOD, "next_one")
    assert host.get("planner", "mine")


def test_a_name_taken_twice_names_both_origins(host, tmp_path):
    load(host, tmp_path, GOOD, "first")
    other = tmp_path / "more"
    other.mkdir()
    info = load(host, other, GOOD, "second")
    assert info.state == "failed"
    assert "planner 'mine' is already offered by 'first'" in info.reason
    with pytest.raises(PluginLoadError, match="already offered by 'first'"):
        host.get("planner", "mine")


def test_two_files_of_one_name_in_two_folders(host, tmp_path):
    load(host, tmp_path, GOOD)
    other = tmp_path / "more"
    other.mkdir()
    info = load(host, other, GOOD.replace('"mine"', '"mine_too"'))
    assert info.state == "failed"
    assert str(tmp_path / "mine.py") in info.reason


def test_an_unknown_name_lists_plugins_that_did_not_load(host, tmp_path):
    load(host, tmp_path, "1 / 0", "other")
    with pytest.raises(UnknownPluginError, match="plugin 'other' did not load"):
        host.get("planner", "mine")


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
    assert hooks
    assert all(hook.__doc__ for hook in hooks)
