from __future__ import annotations

from pathlib import Path

import pytest

from labseq import files as places
from labseq.config import find
from labseq.config.document import Document
from labseq.config.find import find_profile, find_sequence
from labseq.errors import ConfigError
from labseq.files import packaged_profiles_dir, profile_dir


@pytest.fixture(autouse=True)
def shelves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The three places where profiles are looked for."""
    for folder in ("sequences", "hardware_profiles", "packaged"):
        (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(find, "packaged_profiles_dir", lambda: tmp_path / "packaged")
    monkeypatch.setattr(find, "packaged_sequences_dir", lambda: tmp_path / "packaged")
    return tmp_path


def refusal(name: str, named_in: Document | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        find_profile(name, Path("sequences"), named_in=named_in)
    return str(caught.value)


def test_order_of_the_places(shelves: Path) -> None:
    files = [shelves / "packaged/lab.yaml", Path("hardware_profiles/lab.yml"), Path("sequences/lab.yaml")]
    for file in files:
        file.touch()
        assert find_profile("lab", Path("sequences")) == file


@pytest.mark.parametrize("name", ["../mine/lab.yaml", "sub/lab.YML"])
def test_paths_are_relative_to_the_file_that_names_them(name: str) -> None:
    path = Path("sequences") / name
    path.parent.mkdir(exist_ok=True)
    path.touch()
    assert find_profile(name, Path("sequences")) == path


def test_unknown_name(shelves: Path) -> None:
    Path("hardware_profiles/lab.yaml").touch()
    (shelves / "packaged" / "virtual.yaml").touch()
    (shelves / "packaged" / "notes.txt").touch()
    Path("sequences/other.yaml").touch()  # a sequence, most likely
    places = f"sequences, hardware_profiles, {shelves / 'packaged'}"
    assert f"'virtul' in {places}; expected one of lab, virtual; did you mean 'virtual'?" in refusal("virtul")


def test_the_place_of_the_name_is_named() -> None:
    document = Document.parse("labseq: 1\nprofile: virtul\n", "s.yaml")
    assert refusal("virtul", document).startswith("s.yaml:2:10: ")
    document = document.override("profile", "lab_onn.yaml", "--set profile=lab_onn.yaml")
    Path("sequences/lab_one.yaml").touch()
    reported = refusal("lab_onn.yaml", document)
    assert reported.startswith("--set profile=lab_onn.yaml: ")
    assert reported.endswith(f" at {Path('sequences') / 'lab_onn.yaml'}; did you mean 'lab_one.yaml'?")


def test_a_file_that_only_ends_alike_is_not_meant() -> None:
    Path("sequences/other.yaml").touch()
    assert "did you mean" not in refusal("./nope.yaml")
    assert refusal("./").startswith("there is a folder, not a hardware profile, at ")


@pytest.mark.parametrize("name", ["", "..", "a\0b", "x" * 5000, "~nobody-of-this-name/x.yaml"])
def test_odd_names(name: str) -> None:
    assert refusal(name).startswith("there is no hardware profile ")
    assert refusal(name).isprintable()


def test_what_belongs_to_a_profile_of_labseq_is_kept_in_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "hardware_profiles"
    assert profile_dir(Path("mine/lab.yaml")) == Path("mine")
    assert profile_dir(packaged_profiles_dir() / "virtual.yaml") == own  # of a checkout
    inside = tmp_path / "labseq" / "config" / "hardware_profiles"
    inside.mkdir(parents=True)
    monkeypatch.setattr(places, "__file__", str(inside.parents[1] / "places.py"))
    assert profile_dir(inside / "practice.yaml") == own  # of a wheel


def refused_sequence(name: str) -> str:
    with pytest.raises(ConfigError) as caught:
        find_sequence(Path(name))
    return str(caught.value)


def test_order_of_the_places_of_a_sequence(shelves: Path) -> None:
    for place in (shelves / "packaged", Path("sequences"), Path()):
        (place / "kagome.yaml").touch()
        assert find_sequence(Path("kagome")) == place / "kagome.yaml"
    Path("kagome").mkdir()
    assert find_sequence(Path("kagome")) == Path("kagome.yaml")
    Path("kagome").rmdir()
    Path("kagome").touch()
    assert find_sequence(Path("kagome")) == Path("kagome")


@pytest.mark.parametrize("path", ["kagome.yaml", "sequences/gone.YML", "..", "sequences", "a/b"])
def test_a_path_of_a_sequence_is_taken_as_it_is(path: str) -> None:
    assert find_sequence(Path(path)) == Path(path)


def test_a_packaged_sequence_is_not_far(shelves: Path) -> None:
    (shelves / "packaged" / "kagome.yaml").touch()
    reported = refused_sequence("sequences/kagome.yaml")
    assert reported.startswith(f"{Path('sequences/kagome.yaml')}: ")
    assert all(remedy in reported for remedy in ("'kagome'", "'labseq demo --copy .'"))
    Path("sequences/kagome.yaml").mkdir()  # then it is said that this is a folder
    assert find_sequence(Path("sequences/kagome.yaml")) == Path("sequences/kagome.yaml")


def test_unknown_name_of_a_sequence(shelves: Path) -> None:
    (shelves / "packaged" / "kagome.yaml").touch()
    places = f"., sequences, {shelves / 'packaged'}"
    assert f"'kagme' in {places}; expected kagome; did you mean 'kagome'?" in refused_sequence("kagme")
    Path("my_scan.yaml").touch()
    assert refused_sequence("my_scann").endswith("; did you mean 'my_scan.yaml'?")
