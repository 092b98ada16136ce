"""Documents: overrides, places of problems, fallbacks for wrong values."""

from __future__ import annotations

import json
from itertools import starmap
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st

from labseq.config.addresses import Override
from labseq.config.document import Document, FallbackValues, StoredText, load_checked
from labseq.config.profile import load_profile
from labseq.config.sequence import SequenceSpec, load_sequence
from labseq.config.validation import node_of
from labseq.errors import ConfigError, ProblemCollector

TEXT = """\
shots: 20
planner: {use: psca}
shot:
  - load:
  - name: sort
    rearrange: {cycles: 2, window: [1, 2]}
empty:
"""


@pytest.fixture
def document() -> Document:
    return Document.parse(TEXT, "f.yaml")


@pytest.mark.parametrize(
    ("address", "value", "expected"),
    [
        ("shots", "5", {"shots": 5}),
        ("shots", "", {"shots": None}),
        ("new", "[1, {a: b}]", {"new": [1, {"a": "b"}]}),
        ("planner.degree_of_parallelism", "7", {"planner": {"use": "psca", "degree_of_parallelism": 7}}),
        ("empty.within", "1", {"empty": {"within": 1}}),
    ],
)
def test_override(document: Document, address: str, value: str, expected: dict[str, Any]) -> None:
    changed = document.override(address, value, "--set")
    assert changed.data == document.data | expected
    assert changed.text == TEXT
    assert document.data == Document.parse(TEXT, "f.yaml").data


def test_overrides_of_a_step_of_an_empty_step_and_of_a_list_item(document: Document) -> None:
    options = {"shot.sort.cycles": "3", "shot.0.load.duration": "1 s", "shot.1.rearrange.window.1": "9"}
    changed = document.override_all(starmap(Override, options.items()), ProblemCollector())
    assert changed.data["shot"] == [
        {"load": {"duration": "1 s"}},
        {"name": "sort", "rearrange": {"cycles": 3, "window": [1, 9]}},
    ]


def test_problems_of_an_override_name_the_option(document: Document) -> None:
    changed = document.override("planner.use", "x", "--set planner.use=x")
    assert str(changed.problem(("planner", "use"), "wrong")) == "--set planner.use=x: wrong"
    assert str(changed.problem(("planner", "use", "deeper"), "wrong")) == "--set planner.use=x: wrong"
    assert changed.locate(("planner", "use")) == (0, 0)
    # The key stands in the file, and so does everything around it.
    assert str(changed.problem(("planner",), "wrong")) == "f.yaml:2:10: wrong"
    assert str(changed.problem(("shot", 1, "name"), "wrong")) == "f.yaml:5:11: wrong"


def test_a_problem_of_a_key_that_an_option_adds_names_the_option(document: Document) -> None:
    changed = document.override("empty.a", "{b: 1}", "--set empty.a={b: 1}")
    assert str(changed.problem(("empty", "a"), "unknown", key=True)) == "--set empty.a={b: 1}: unknown"
    assert str(changed.problem(("empty", "a", "b"), "unknown", key=True)) == "--set empty.a={b: 1}: unknown"
    assert str(changed.problem(("empty",), "unknown", key=True)) == "f.yaml:7:1: unknown"


def test_missing_parents_are_made_where_allowed(document: Document) -> None:
    changed = document.override("timeouts.call", "3", "--set", may_add=["timeouts"])
    assert changed.data["timeouts"] == {"call": 3}
    with pytest.raises(ConfigError):
        document.override("timeouts.call", "3", "--set", may_add=["other"])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("[1", "o: the '[' that opens here is not closed; expected ',' or ']'"),
        ("a: b", "o: this is YAML of several lines; expected one value: 5, '45 ms', [a, b] or {key: value}"),
        ("{a: 1, a: 2}", "o: 'a' is given twice; remove one of them"),
        ("\udcb5", "o: a byte that is not UTF-8; expected plain text; delete it"),
    ],
)
def test_override_that_is_no_value(document: Document, value: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        document.override("shots", value, "o")
    assert str(caught.value).startswith(message)


def test_all_wrong_overrides_are_reported(document: Document) -> None:
    problems = ProblemCollector()
    document.override_all(starmap(Override, [("a.b", "1"), ("shots", "5"), ("shots", "{")]), problems)
    assert [problem.source for problem in problems.problems] == ["--set a.b=1", "--set shots={"]


plain_text = st.text(st.characters(min_codepoint=32, max_codepoint=0x2FFF, exclude_categories=["C", "Z"]))
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | plain_text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(plain_text, inner, max_size=3),
    max_leaves=10,
)


@settings(max_examples=40)
@given(st.dictionaries(plain_text, json_values, max_size=4))
def test_json_is_yaml(data: dict[str, Any]) -> None:
    text = json.dumps(data, ensure_ascii=False)
    assert json.dumps(Document.parse(text, "f.json").data) == json.dumps(data)


def test_a_stored_text_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "gone.yaml"
    document = Document.read(path, StoredText("\ufeffshots: 3\n", "copy/sequence.yaml"))
    assert (document.path, document.name, document.text) == (path, "copy/sequence.yaml", "shots: 3\n")
    assert str(document.problem(("shots",), "wrong")) == "copy/sequence.yaml:1:8: wrong"
    kept = StoredText("labseq: 1\nname: 5\n", "copy.yaml")
    with pytest.raises(ConfigError, match=r"(?m)^copy\.yaml:2:7: name is 5"):
        load_sequence(path, kept=kept)
    with pytest.raises(ConfigError, match=r"(?m)^copy\.yaml:2:7: name is 5"):
        load_profile(path, kept=kept)


FALLBACKS = FallbackValues(
    values={
        "labseq": 1,
        "name": "x",
        "shots": 1,
        "target": {"pattern": "compact"},
        "planner": {"use": "psca"},
        "shot": [{"image": {}}],
    },
    items={"shot": {"image": {}}},
)
GOOD = {**FALLBACKS.values, "name": "mine", "shots": 7}
SCALARS = st.none() | st.booleans() | st.integers(-9, 9) | st.sampled_from(["", "mine", "45 ms"])
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner) | st.dictionaries(st.text("abc"), inner))
KEYS = st.sampled_from([*GOOD, "seed", "attempts", "record_frames", "unknown"])


@settings(max_examples=20)
@given(st.dictionaries(KEYS, VALUES))
def test_what_is_right_beside_something_wrong_is_kept(changes: dict[str, Any]):
    base = Document.parse("labseq: 1\n", "s.yaml")
    root = node_of({**GOOD, **changes}, base.root.mark)
    found = ProblemCollector()
    document, spec = load_checked(
        Document(Path("s.yaml"), "", root), SequenceSpec, "a sequence", FALLBACKS, found
    )
    assert document.validate(SequenceSpec) == spec
    for key in GOOD.keys() - changes.keys():
        assert document.get((key,)) == GOOD[key]
    assert ("unknown" not in changes) or found.problems


def test_a_wrong_step_leaves_the_others_in_their_places(tmp_path: Path):
    path = tmp_path / "s.yaml"
    path.write_text(
        "labseq: 1\nname: x\nshots: 1\ntarget: {pattern: compact}\nshot: [load, {wait: {}}, 5, {load: {}}]\n"
    )
    found = ProblemCollector()
    _, spec, _ = load_sequence(path, problems=found)
    assert [step.loc for step in spec.shot] == [
        ("shot", 0, "image"),
        ("shot", 1, "wait"),
        ("shot", 2, "image"),
        ("shot", 3, "load"),
    ]
    assert [problem.line for problem in found.problems] == [5, 5]
