"""Where profiles and runs are."""

from __future__ import annotations

from pathlib import Path

import pytest

from labseq import files as places
from labseq.files import data_root, packaged_profiles_dir


def test_packaged_profiles() -> None:
    folder = packaged_profiles_dir()
    assert folder.name == "hardware_profiles"
    assert (folder / "virtual.yaml").is_file()


def test_packaged_profiles_of_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "__file__", str(tmp_path / "labseq" / "places.py"))
    assert packaged_profiles_dir() == tmp_path.resolve() / "hardware_profiles"
    inside = tmp_path / "labseq" / "config" / "hardware_profiles"
    inside.mkdir(parents=True)
    assert packaged_profiles_dir() == inside.resolve()


def test_the_data_root_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LABSEQ_DATA", raising=False)
    assert data_root() == Path("data")
    monkeypatch.setenv("LABSEQ_DATA", "")
    assert data_root() == Path("data")
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path))
    assert data_root() == tmp_path
