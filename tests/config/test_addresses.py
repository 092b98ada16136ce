# ruff: noqa: E501 - messages stand here as they are printed

from __future__ import annotations

import pytest

from labseq.config.addresses import Override, find, profile_overrides, split_overrides
from labseq.config.document import Document
from labseq.errors import ConfigError, Loc

DOCUMENT = Document.parse(
    """\
shots: 20
shot:
  - load: {duration: 1}
  - name: sort
    rearrange: {window: [1, 2]}
  - name: odd
    a: {x: 1}
    b: {x: 1}
single: [{name: only, kind: {}}]
none: []
""",
    "f.yaml",
)


def locate(address: str) -> Loc:
    return find(DOCUMENT.root, address, "--set")


@pytest.mark.parametrize(
    ("address", "loc"),
    [
        ("new", ("new",)),
        ("shot.0.load.duration", ("shot", 0, "load", "duration")),
        ("shot.0.load.new", ("shot", 0, "load", "new")),
        ("shot.sort", ("shot", 1, "rearrange")),
        ("shot.sort.window.1", ("shot", 1, "rearrange", "window", 1)),
        ("shot.odd.b.x", ("shot", 2, "b", "x")),
        ("single.only.new", ("single", 0, "kind", "new")),
    ],
)
def test_found(address: str, loc: Loc) -> None:
    assert locate(address) == loc


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (
            "shoot.0",
            "there is no 'shoot' in f.yaml; expected one of shots, shot, single, none; did you mean 'shot'?",
        ),
        ("shot.3.load", "'shot' has no item '3'; expected an index from 0 to 2 or a name (sort, odd)"),
        ("shot.\u0661", "'shot' has no item '\u0661'; expected an index from 0 to 2 or a name (sort, odd)"),
        (
            "shot.srt.window",
            "'shot' has no item 'srt'; expected an index from 0 to 2 or a name (sort, odd); did you mean 'sort'?",
        ),
        ("shot.sort.winow.1", "there is no 'winow' in 'shot.sort'; expected window; did you mean 'window'?"),
        ("single.2", "'single' has no item '2'; expected the index 0 or a name (only)"),
        ("none.0", "'none' has no item '0'; expected nothing"),
        ("shots.x", "'shots' is 20 and has no 'x' in it"),
        ("shot.0." + "x" * 100 + ".y", f"there is no '{'x' * 57}...' in 'shot.0'; expected load"),
    ],
)
def test_lost(address: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        locate(address)
    assert str(caught.value) == f"--set: {message}"


@pytest.mark.parametrize(
    ("address", "loc"),
    [
        ("policy.retry", ("policy", "retry")),
        ("shot.0.load.light.power", ("shot", 0, "load", "light", "power")),
        ("single.only.a.b.c", ("single", 0, "kind", "a", "b", "c")),
    ],
)
def test_optional_mappings_are_added_by_an_override(address: str, loc: Loc) -> None:
    assert find(DOCUMENT.root, address, "--set", ("policy",)) == loc
    with pytest.raises(ConfigError, match=r"there is no 'shoot' in f\.yaml"):
        find(DOCUMENT.root, f"shoot.{address}", "--set", ("policy",))


def test_split() -> None:
    assert split_overrides(["shots=5", "profile=lab", "profile.grid.rows=3", " a.b = c=d"]) == (
        [
            Override("shots", "5", "--set shots=5"),
            Override("profile", "lab", "--set profile=lab"),
            Override("a.b", " c=d", "--set  a.b = c=d"),
        ],
        [Override("grid.rows", "3", "--set profile.grid.rows=3")],
    )


def test_split_names_every_wrong_option() -> None:
    with pytest.raises(ConfigError) as caught:
        split_overrides(["shots", "=5", "a..b=5", "good=1", "profile.=3"])
    assert [problem.source for problem in caught.value.problems] == [
        "--set shots",
        "--set =5",
        "--set a..b=5",
        "--set profile.=3",
    ]
    assert "address=value" in caught.value.problems[0].what


def test_where_only_a_profile_can_be_changed() -> None:
    assert profile_overrides(["profile.grid.rows=3"]) == [
        Override("grid.rows", "3", "--set profile.grid.rows=3")
    ]
    with pytest.raises(ConfigError) as caught:
        profile_overrides(["camera.x=1", "profile.camera.x=1", "shots=3"])
    assert [problem.source for problem in caught.value.problems] == ["--set camera.x=1", "--set shots=3"]
    assert str(caught.value.problems[0]).endswith("write --set profile.camera.x=...")
