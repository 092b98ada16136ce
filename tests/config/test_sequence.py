"""Sequence files: their values, defaults and overrides; wrong ones are in test_wrong_sequences.py."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import labseq
from labseq.config.addresses import Override
from labseq.config.document import plugin_paths
from labseq.config.sequence import SequenceSpec, StepSpec, load_sequence
from labseq.errors import ConfigError, UnknownPluginError
from labseq.plugins.host import PluginHost

DATA = Path(__file__).parent / "data"
SMALL = "labseq: 1\nname: s\nshots: 1\ntarget: {pattern: compact}\nshot: [{load: {}}]\n"


def load(folder: Path, text: str, *overrides: Override) -> SequenceSpec:
    path = folder / "s.yaml"
    path.write_text(text, encoding="utf-8")
    return load_sequence(path, overrides)[1]


def refusal(folder: Path, text: str, *overrides: Override) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, text, *overrides)
    return str(caught.value).removeprefix(str(folder / "s.yaml"))


def test_everything_in_it() -> None:
    document, spec, _ = load_sequence(DATA / "sequence.yaml")
    assert spec.name == "compact-225"
    assert spec.profile == "virtual"
    assert spec.shots == 20
    assert spec.seed == 7
    assert spec.record_frames == "last"
    assert spec.attempts == 2
    assert spec.target is not None
    assert (spec.target.use, spec.target.loc, spec.target.key) == ("compact", ("target",), "pattern")
    assert (spec.planner.use, spec.planner.loc, spec.planner.key) == ("psca", ("planner",), "use")
    assert spec.shot == (
        StepSpec("load", "", ("shot", 0, "load")),
        StepSpec("image", "", ("shot", 1, "image")),
        StepSpec("rearrange", "sort", ("shot", 2, "rearrange")),
        StepSpec("device", "", ("shot", 3, "device")),
        StepSpec("wait", "", ("shot", 4, "wait")),
        StepSpec("image", "", ("shot", 5, "image")),
    )
    assert [document.get(step.loc) is None for step in spec.shot] == [False] * 5 + [True]


@pytest.mark.parametrize("planner", ["", "planner:\n"])
def test_default_planner_can_be_set(tmp_path: Path, planner: str) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(SMALL + planner, encoding="utf-8")
    document, spec, _ = load_sequence(path, [Override("planner.degree_of_parallelism", "3")])
    assert document.get(spec.planner.loc) == {"use": "psca", "degree_of_parallelism": 3}


def test_wrong_override_names_its_option(tmp_path: Path) -> None:
    assert refusal(tmp_path, SMALL, Override("shots", "0")).startswith("--set shots=0: ")
    assert refusal(tmp_path, SMALL, Override("shots", "0", "--shots 0")).startswith("--shots 0: ")


def test_an_override_replaces_a_wrong_value(tmp_path: Path) -> None:
    assert load(tmp_path, SMALL.replace("shots: 1", "shots: many"), Override("shots", "2")).shots == 2


def test_only_the_newer_format_is_reported(tmp_path: Path) -> None:
    (line,) = refusal(tmp_path, "labseq: 2\nnew: 1\nshots: 0\n").splitlines()
    assert re.match(r":1:9: .*format is 2, this labseq reads 1\); update labseq", line)


def test_all_problems_at_once(tmp_path: Path) -> None:
    text = SMALL.replace("shots: 1", "shots: 0").replace("{load: {}}", "{load: 5}, {name: x}, {a: , b: }")
    lines = refusal(tmp_path, text).split("\n")
    assert [line.split(": ")[0][-4:] for line in lines] == [":3:8", "5:15", "5:19", "5:36"]


@pytest.mark.parametrize(
    ("name", "is_name"),
    [
        *((name, True) for name in ("Größe 3", "x_y-z.1", "原子", "e\u0301te\u0301", "n" * 80)),
        *((name, False) for name in ("..", "a/b", "a\\\\b", "a\\nb", "\u202ea", "_", " a", "\\0")),
    ],
)
def test_names_that_a_folder_can_have(tmp_path: Path, name: str, is_name: bool) -> None:
    text = SMALL.replace("name: s", f'name: "{name}"')
    if is_name:
        assert load(tmp_path, text).name
    else:
        assert refusal(tmp_path, text).startswith(":2:7: name is '")


@pytest.mark.parametrize("version", ["1.0", "true", ""])
def test_a_wrong_version(tmp_path: Path, version: str) -> None:
    message = refusal(tmp_path, SMALL.replace("labseq: 1", f"labseq: {version}"))
    assert message.endswith("; expected 1, the version of the file format")
    assert message.startswith(":1:9: labseq is " if version else ":1:8: labseq is empty")


def test_plugin_folders_are_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    path = tmp_path / "s.yaml"
    path.write_text(SMALL + "plugin_folders: [mine, ~nobody-of-this-name, yours]\n", encoding="utf-8")
    document, spec, _ = load_sequence(path)
    assert plugin_paths(document, ["mine"]) == [tmp_path / "mine"]
    with pytest.raises(ConfigError) as caught:
        plugin_paths(document, spec.plugin_folders)
    first, second = caught.value.problems
    assert (first.line, first.column) == (6, 24)
    assert str(second).startswith(f"{path}:6:46: ")
    assert str(second).endswith(str(tmp_path / "yours"))


def test_the_folder_of_own_plugins_may_be_missing_where_none_is_used(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(SMALL + "plugin_folders: [plugins]\n", encoding="utf-8")
    document, spec, _ = load_sequence(path)
    assert plugin_paths(document, spec.plugin_folders) == []
    with pytest.raises(UnknownPluginError, match=r"its plugin folder .* does not exist"):
        PluginHost().get("planner", "mine", path)
    (tmp_path / "plugins").mkdir()
    assert plugin_paths(document, spec.plugin_folders) == [tmp_path / "plugins"]


def test_analyses_have_their_place_and_their_time(tmp_path: Path) -> None:
    assert load(tmp_path, SMALL + "analysis:\n").analysis == ()
    one, two = load(tmp_path, SMALL + "analysis: [{use: a}, {use: b, finish_within: 1 min}]").analysis
    assert (one.use, one.finish_within, one.loc) == ("a", 10.0, ("analysis", 0))
    assert (two.use, two.finish_within, two.loc) == ("b", 60.0, ("analysis", 1))


@pytest.mark.parametrize(
    ("analyses", "message"),
    [
        ("survival", r":6:11: analysis is 'survival'; expected a list"),
        ("[survival]", r":6:12: there is only 'survival' here; expected a mapping"),
        ("[{use: survival}, {use: survival}]", r":6:35: the analysis 'survival' is listed a second time"),
        ("[{use: sruvival}]", r":6:18: unknown analysis 'sruvival'.*did you mean 'survival'"),
        ("[{use: survival, atom: all}]", r":6:28: .*'atom'.*did you mean 'atoms'"),
    ],
)
def test_wrong_analyses_are_refused_before_the_run(tmp_path: Path, analyses: str, message: str) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(f"{SMALL}analysis: {analyses}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        labseq.Session.open(path)
