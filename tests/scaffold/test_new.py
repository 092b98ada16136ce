"""What cannot be made is refused, and nothing that exists is touched."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings, strategies as st

import labseq
from labseq.console.options import measurements
from labseq.errors import ConfigError
from labseq.plugins.host import PluginHost
from labseq.scaffold.new import check_file_name, check_plugin_name, make_file, make_plugin


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("my-planner", "not a valid name for a Python package; expected .* for example 'my_planner'"),
        ("Spiral", "for example 'spiral'"),
        ("", "a lower-case word"),
        ("x" * 41, "at most 40 letters"),
        ("class", "Python itself uses this word; .*'my_class'"),
        ("json", "a part of Python or labseq"),
        ("nul", "Windows allows no file of this name"),
        ("psca", "the plugin 'labseq_psca' offers a planner of that name"),
        ("pydantic", "there is a Python package 'pydantic'"),
    ],
)
def test_names_that_a_plugin_cannot_have(name: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"a planner cannot be called '.*': .*{why}"):
        make_plugin("planner", name, tmp_path)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("kind", "name", "why"),
    [
        ("sequence", "a.yaml", "without an ending; for example 'a'"),
        ("sequence", "Con", "Windows allows no file of this name"),
        ("sequence", "True", "YAML does not read it as text"),
        ("profile", "virtual", "yours would hide it"),
    ],
)
def test_names_that_a_file_cannot_have(kind: str, name: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"cannot be called '.*': .*{why}"):
        make_file("sequence" if kind == "sequence" else "profile", name, tmp_path)
    assert [*tmp_path.iterdir()] == []


def test_a_name_can_be_had_again_by_another_kind(tmp_path: Path) -> None:
    make_plugin("planner", "mine", tmp_path)
    with pytest.raises(ConfigError, match="there is a plugin 'mine'"):
        make_plugin("camera", "mine", tmp_path)
    with pytest.raises(ConfigError, match="the plugin 'mine' offers a planner of that name"):
        make_plugin("planner", "mine", tmp_path, package=True)
    make_plugin("camera", "mine", tmp_path, package=True)


def test_what_exists_is_never_written_over(tmp_path: Path) -> None:
    (tmp_path / "plugins" / "spiral").mkdir(parents=True)
    (tmp_path / "first.yaml").write_text("mine")
    with pytest.raises(ConfigError, match="spiral: this already exists; choose another name"):
        make_plugin("planner", "spiral", tmp_path)
    with pytest.raises(ConfigError, match=r"first\.yaml: this already exists"):
        make_file("sequence", "first", tmp_path)
    assert (tmp_path / "first.yaml").read_text() == "mine"
    assert [*(tmp_path / "plugins").iterdir()] == [tmp_path / "plugins" / "spiral"]


@pytest.mark.parametrize("name", ["plugins", ".labseq"])
def test_a_file_in_the_way_of_a_folder_is_reported(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("")
    with pytest.raises(ConfigError, match=rf"{name}.*: this (already exists|cannot be made)"):
        make_file("sequence", "first", tmp_path)
    assert not (tmp_path / "first.yaml").exists()
    assert (tmp_path / name).read_text() == ""


@pytest.mark.parametrize("like", measurements(""))
def test_a_sequence_begins_with_a_measurement_that_comes_with_labseq(like: str, tmp_path: Path) -> None:
    """Also outside the folder of that one, whose files it does not have."""
    made = make_file("sequence", "mine", tmp_path, like=like)
    with labseq.Session.open(made.path) as session:
        assembly = session.assembly
        assert assembly.sequence.name == "mine"
        assert any("fit" in one for one in assembly.resolved["measure"])
    assert f"{like}.yaml" not in made.path.read_text("utf-8")


def test_a_measurement_that_there_is_not_is_answered_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no measurement 'raby'.*ramsey.*did you mean 'rabi'"):
        make_file("sequence", "mine", tmp_path, like="raby")


@given(name=st.text(max_size=50))
@example(name="x\n")
@settings(max_examples=25)
def test_any_text_is_a_name_or_refused_as_text(name: str) -> None:
    host = PluginHost()
    for check in (
        lambda: check_plugin_name("planner", name, name, host),
        lambda: check_file_name("sequence", name, Path()),
    ):
        try:
            check()
        except ConfigError as error:
            assert "cannot be called" in str(error)
            assert str(error).isprintable()
        else:
            assert name.replace("-", "_").isidentifier()


def test_a_disk_that_is_full_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, *_: object, **__: object) -> int:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", fail)
    with pytest.raises(ConfigError, match=r"spiral: this cannot be made \(No space left on device"):
        make_plugin("planner", "spiral", tmp_path)
    assert not list(tmp_path.rglob("*spiral*"))


def test_a_sequence_may_be_made_for_a_profile(tmp_path: Path) -> None:
    make_file("profile", "mine", tmp_path)
    made = make_file("sequence", "first", tmp_path, profile="mine")
    assert "\nprofile: mine\n" in made.path.read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match="no hardware profile 'yours'"):
        make_file("sequence", "second", tmp_path, profile="yours")


def test_a_new_plugin_is_in_the_schemas_that_are_there(tmp_path: Path) -> None:
    make_file("sequence", "first", tmp_path)
    schema = tmp_path / ".labseq" / "sequence.schema.json"
    assert "spiral" not in schema.read_text(encoding="utf-8")
    make_plugin("planner", "spiral", tmp_path)
    assert '"spiral"' in schema.read_text(encoding="utf-8")
    assert not (tmp_path / ".labseq" / "profile.schema.json").exists()
