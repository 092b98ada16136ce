"""What is said before a run's folder is made."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

import labseq
from labseq.console.output import compiling_text
from labseq.errors import ConfigError
from labseq.session.check import check

from .small_runs import PROFILE

IMAGES = """
labseq: 1
name: images
profile: p.yaml
shots: 20
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
"""


def images_only(folder: Path, *changes: tuple[str, str]) -> labseq.Session:
    """A session that only takes images, with a profile that is changed."""
    profile = PROFILE
    for old, new in changes:
        assert old in profile
        profile = profile.replace(old, new)
    (folder / "p.yaml").write_text(profile, encoding="utf-8")
    (folder / "s.yaml").write_text(IMAGES, encoding="utf-8")
    return labseq.Session.open(folder / "s.yaml", output=folder / "data")


@pytest.mark.parametrize("path", ["nothing_here.tif", "p.yaml", "*.png", "."])
def test_files_that_cannot_be_played_are_refused_before_a_run_has_a_folder(tmp_path: Path, path: str) -> None:
    frames = ("camera: {use: virtual}", f"camera: {{use: frames, path: '{path}'}}")
    with images_only(tmp_path, frames) as session, pytest.raises(ConfigError) as caught:
        session.run()
    (problem,) = caught.value.problems
    assert (Path(problem.source).name, problem.line, problem.column) == ("p.yaml", 4, 29)
    assert not (tmp_path / "data").exists()


def test_only_a_disk_that_may_be_too_small_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # what is planned, which is nothing, may have more tweezers than the profile
    few = (
        "mobile_tweezers: {use: virtual}",
        "mobile_tweezers: {use: virtual, max_tweezers: 1, max_row_tones: 1, max_column_tones: 1}",
    )
    session = images_only(tmp_path, few)
    shot_bytes = check(session).shot_bytes
    assert shot_bytes is not None
    free = 20 * shot_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    assert check(session).warnings == ()
    free -= 1
    (warning,) = check(session).warnings
    assert warning.source == str(tmp_path / "data")
    assert "the run may need 2." in warning.what
    assert " free" in warning.what


def test_a_cache_that_cannot_be_written_is_named_where_kernels_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path / "cache"))
    assert compiling_text(40) == "compiling kernels, about 40 s; later runs find them in the cache"
    (tmp_path / "file").touch()
    monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path / "file"))
    assert f"at every start: {tmp_path / 'file'} cannot be written" in compiling_text(40)
    assert "set LABSEQ_CACHE" in compiling_text(40)
