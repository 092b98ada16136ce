"""Sequence files, right and wrong: values, and the first message exactly."""

# ruff: noqa: E501 - messages are quoted as they are printed

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.config.addresses import Override
from labseq.config.document import plugin_paths
from labseq.config.sequence import SequenceSpec, StepSpec, load_sequence
from labseq.errors import ConfigError
from labseq.settings import PatternChoice

DATA = Path(__file__).parent / "data"
SMALL = "labseq: 1\nname: s\nshots: 1\ntarget: {pattern: compact}\nshot: [{load: {}}]\n"


def load(folder: Path, text: str, *overrides: Override | tuple[str, str]) -> SequenceSpec:
    path = folder / "s.yaml"
    path.write_text(text, encoding="utf-8")
    return load_sequence(path, overrides)[1]


def refusal(folder: Path, text: str, *overrides: Override | tuple[str, str]) -> str:
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


def test_defaults(tmp_path: Path) -> None:
    spec = load(tmp_path, SMALL)
    assert (spec.profile, spec.seed, spec.record_frames, spec.attempts) == ("virtual", None, "all", 3)
    assert spec.plugin_folders == []
    assert spec.planner.use == "psca"


@pytest.mark.parametrize("planner", ["", "planner:\n"])
def test_default_planner_can_be_set(tmp_path: Path, planner: str) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(SMALL + planner, encoding="utf-8")
    document, spec, _ = load_sequence(path, [("planner.degree_of_parallelism", "3")])
    assert document.get(spec.planner.loc) == {"use": "psca", "degree_of_parallelism": 3}


@pytest.mark.parametrize("name", ["a", "Größe 3", "x_y-z.1", "原子", "e\u0301te\u0301", "n" * 80])
def test_names(tmp_path: Path, name: str) -> None:
    assert len(load(tmp_path, SMALL.replace("name: s", f"name: '{name}'")).name) <= 80


@pytest.mark.parametrize(
    "name", ["..", "a/b", "a\\\\b", "a:b", "a\\nb", "\u202ea", "_", " a", "a ", "a*", "\\0"]
)
def test_no_names(tmp_path: Path, name: str) -> None:
    assert refusal(tmp_path, SMALL.replace("name: s", f'name: "{name}"')).startswith(":2:7: name is '")


def test_plain_pairs_are_overrides(tmp_path: Path) -> None:
    assert load(tmp_path, SMALL, ("shots", "5"), ("profile", "lab")).shots == 5


def test_wrong_override_names_its_option(tmp_path: Path) -> None:
    assert refusal(tmp_path, SMALL, ("shots", "0")) == "--set shots=0: shots is 0; expected at least 1"
    assert refusal(tmp_path, SMALL, Override("shots", "0", "--shots 0")) == (
        "--shots 0: shots is 0; expected at least 1"
    )


def test_wrong_value_is_mended_by_an_override(tmp_path: Path) -> None:
    assert load(tmp_path, SMALL.replace("shots: 1", "shots: many"), ("shots", "2")).shots == 2


def test_profile_in_place_of_a_sequence() -> None:
    with pytest.raises(ConfigError, match=r":4:1: this is a hardware profile .* expected a sequence$"):
        load_sequence(DATA / "profile.yaml")


@pytest.mark.parametrize("version", ["1.0", "true", "'1'", "0", "[1]", ""])
def test_no_version(tmp_path: Path, version: str) -> None:
    message = refusal(tmp_path, SMALL.replace("labseq: 1", f"labseq: {version}"))
    assert message.endswith("; expected 1, the version of the file format")
    assert message.startswith(":1:9: labseq is " if version else ":1:8: labseq is empty")


def test_only_the_newer_format_is_reported(tmp_path: Path) -> None:
    assert refusal(tmp_path, "labseq: 2\nnew: 1\nshots: 0\n") == (
        ":1:9: this file is written for a newer labseq: its format is 2, this labseq reads 1; update labseq"
    )


def test_all_problems_at_once(tmp_path: Path) -> None:
    text = SMALL.replace("shots: 1", "shots: 0").replace("{load: {}}", "{load: 5}, {name: x}, {a: , b: }")
    lines = refusal(tmp_path, text).split("\n")
    assert [line.split(": ")[0][-4:] for line in lines] == [":3:8", "5:15", "5:19", "5:36"]


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
    assert str(second) == (
        f"{path}:6:46: there is no plugin folder 'yours'; expected a folder at {tmp_path / 'yours'}"
    )


def test_every_setting_is_described() -> None:
    models = (SequenceSpec, PatternChoice)
    assert all(field.description for model in models for field in model.model_fields.values())


GOOD = (Path(__file__).parent / "data" / "sequence.yaml").read_text(encoding="utf-8")
CASES = [
    (
        "misspelt key",
        "shots: 20",
        "shoots: 20",
        "s.yaml:5:1: 'shoots' is not a setting of a sequence; expected one of labseq, name, profile, shots, seed, target, planner, record_frames, attempts, policy, plugin_folders, scan, repeats, order, variables, analysis, shot; did you mean 'shots'?",
    ),
    ("zero shots", "shots: 20", "shots: 0", "s.yaml:5:8: shots is 0; expected at least 1"),
    (
        "too many shots",
        "shots: 20",
        "shots: 1000001",
        "s.yaml:5:8: shots is 1000001; expected at most 1000000",
    ),
    (
        "shots in words",
        "shots: 20",
        "shots: twenty",
        "s.yaml:5:8: shots is 'twenty'; expected a whole number",
    ),
    (
        "shots in quotes",
        "shots: 20",
        'shots: "20"',
        "s.yaml:5:8: shots is '20'; expected a whole number; write 20 without quotes",
    ),
    (
        "shots with underscore",
        "shots: 20",
        "shots: 1_000",
        "s.yaml:5:8: shots is '1_000'; expected a whole number; did you mean 1000?",
    ),
    ("shots as a float", "shots: 20", "shots: 2e1", "s.yaml:5:8: shots is 2e1; expected a whole number"),
    ("shots as a switch", "shots: 20", "shots: true", "s.yaml:5:8: shots is true; expected a whole number"),
    ("shots empty", "shots: 20", "shots:", "s.yaml:5:7: shots is empty; expected a whole number"),
    ("shots missing", "shots: 20\n", "", "s.yaml:2:1: 'shots' is missing (how many shots a run takes)"),
    ("negative seed", "seed: 7", "seed: -1", "s.yaml:6:7: seed is -1; expected at least 0"),
    (
        "huge seed",
        "seed: 7",
        "seed: 9223372036854775808",
        "s.yaml:6:7: seed is 9223372036854775808; expected less than 9223372036854775808",
    ),
    (
        "number too long",
        "seed: 7",
        "seed: 11111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111",
        "s.yaml:6:7: a number of 101 characters is too long; expected a number of a few digits",
    ),
    (
        "newer format",
        "labseq: 1",
        "labseq: 2",
        "s.yaml:2:9: this file is written for a newer labseq: its format is 2, this labseq reads 1; update labseq",
    ),
    (
        "format as text",
        "labseq: 1",
        "labseq: '1'",
        "s.yaml:2:9: labseq is '1'; expected 1, the version of the file format",
    ),
    ("format missing", "labseq: 1\n", "", "s.yaml:2:1: 'labseq' is missing (version of the file format: 1)"),
    (
        "name as a number",
        "name: compact-225",
        "name: 225",
        "s.yaml:3:7: name is 225; expected text; put it in quotes",
    ),
    (
        "name with a separator",
        "name: compact-225",
        "name: a/b",
        "s.yaml:3:7: name is 'a/b', with '/' in it; expected letters, digits, spaces, '-', '_' and '.'",
    ),
    (
        "name with a control character",
        "name: compact-225",
        'name: "a\\tb"',
        "s.yaml:3:7: name is 'a\\tb', with '\\t' in it; expected letters, digits, spaces, '-', '_' and '.'",
    ),
    (
        "name of dots",
        "name: compact-225",
        "name: ..",
        "s.yaml:3:7: name is '..'; expected at least one letter or digit",
    ),
    (
        "name too long",
        "name: compact-225",
        "name: xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx",
        "s.yaml:3:7: name has 81 characters; expected at most 80",
    ),
    ("name empty", "name: compact-225", "name: ''", "s.yaml:3:7: name has 0 characters; expected at least 1"),
    (
        "record_frames",
        "record_frames: last",
        "record_frames: lst",
        "s.yaml:11:16: record_frames is 'lst'; expected 'all', 'last' or 'none'; did you mean 'last'?",
    ),
    ("attempts", "attempts: 2", "attempts: 0", "s.yaml:12:11: attempts is 0; expected at least 1"),
    (
        "plugin folders as text",
        '[plugins, "more plugins"]',
        "plugins",
        "s.yaml:13:17: plugin_folders is 'plugins'; expected a list ([a, b], or lines that begin with '- ')",
    ),
    (
        "plugin folder as a number",
        '[plugins, "more plugins"]',
        "[plugins, 5]",
        "s.yaml:13:27: plugin_folders.1 is 5; expected text; put it in quotes",
    ),
    (
        "target by name alone",
        "target: {pattern: compact, rows: 15, cols: 15}",
        "target: compact",
        "s.yaml:7:9: just 'compact' stands here; expected a mapping; write '{pattern: compact}'",
    ),
    (
        "target without a pattern",
        "{pattern: compact",
        "{patern: compact",
        "s.yaml:7:9: 'pattern' is missing from 'target' (the name of a target pattern); did you write 'patern' for it?",
    ),
    (
        "pattern as a number",
        "{pattern: compact",
        "{pattern: 5",
        "s.yaml:7:19: pattern is 5; expected text; put it in quotes",
    ),
    (
        "planner without use",
        "use: psca\n",
        "uses: psca\n",
        "s.yaml:9:3: 'use' is missing from 'planner' (the name of a plugin); did you write 'uses' for it?",
    ),
]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("s.yaml")


def test_the_good_one_is_good(here: Path) -> None:
    here.write_text(GOOD, encoding="utf-8")
    load_sequence(here)


@pytest.mark.parametrize(("old", "new", "message"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_first_message(here: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    here.write_bytes(GOOD.replace(old, new, 1).encode())

    with pytest.raises(ConfigError) as caught:
        load_sequence(here)

    assert str(caught.value.problems[0]) == message


HEAD = """labseq: 1
name: x
shots: 1
target: {pattern: compact, rows: 5, cols: 5}
shot: [{image: {}}]
"""


def read(tmp_path, text):
    path = tmp_path / "x.yaml"
    path.write_text(HEAD + text)
    return load_sequence(path)[1]


def test_analyses_may_be_left_out_or_empty(tmp_path):
    assert read(tmp_path, "").analysis == ()
    assert read(tmp_path, "analysis:\n").analysis == ()


def test_each_has_its_place_and_its_time(tmp_path):
    one, two = read(tmp_path, "analysis: [{use: a, gain: 3}, {use: b, finish_within: 1 min}]").analysis
    assert (one.use, one.finish_within, one.loc) == ("a", 10.0, ("analysis", 0))
    assert (two.use, two.finish_within, two.loc) == ("b", 60.0, ("analysis", 1))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("analysis: survival", r":6:11: analysis is 'survival'; expected a list"),
        ("analysis: [survival]", r":6:12: just 'survival' stands here; expected a mapping"),
        ("analysis: [{atoms: all}]", r":6:12: 'use' is missing"),
        (
            "analysis: [{use: a}, {use: a}]",
            r":6:28: the analysis 'a' stands here a second time; expected each analysis once",
        ),
        ("analysis: [{use: a, finish_within: soon}]", r":6:36: .*expected"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(tmp_path, text, expected):
    with pytest.raises(labseq.ConfigError, match=expected):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("analysis: [{use: sruvival}]", r":6:18: unknown analysis 'sruvival'.*did you mean 'survival'"),
        ("analysis: [{use: survival, atom: all}]", r":6:28: .*'atom'.*did you mean 'atoms'"),
        ("analysis: [{use: survival, atoms: some}]", r":6:35: atoms is 'some'"),
    ],
)
def test_settings_of_analyses_are_checked_before_the_run(tmp_path, text, expected):
    path = tmp_path / "x.yaml"
    path.write_text(HEAD + text)
    with pytest.raises(labseq.ConfigError, match=expected):
        labseq.Session.open(path)
