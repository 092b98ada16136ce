from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import pytest

from labseq.recording.writer import RunWriter


@pytest.fixture
def run_dir(fake: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A finished run in LABSEQ_DATA; the current folder is empty."""
    writer = RunWriter.create(tmp_path / "data", fake.run(n_shots=2))
    for index in range(2):
        writer.write_shot(fake.shot(index))
    writer.finish("complete")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path / "data"))
    return writer.run_dir


def test_the_newest_run_is_exported_under_its_own_name(run_dir: Path, call: Any) -> None:
    name = f"{run_dir.parent.name}_{run_dir.name}"
    assert call("export") == (0, f"written: {name}.csv\nwritten: {name}.units.csv\n", "")
    assert Path(f"{name}.csv").read_text("utf-8").startswith("shot,attempt,status,")


def test_an_existing_file_is_replaced_by_force_only(run_dir: Path, call: Any) -> None:
    Path("a.csv").write_text("old")
    code, _, err = call("export", str(run_dir), "-o", "a.csv")
    assert code == 2
    assert "a.csv: this file already exists" in err
    assert Path("a.csv").read_text() == "old"
    assert call("export", str(run_dir), "-o", "a.csv", "--force")[0] == 0
    assert Path("a.csv").read_text() != "old"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--to", "xls"), "--to: a run cannot be exported as 'xls'"),
        (("--frames",), "--frames: a csv file holds no frames; use --to archive"),
        (("-o", "no/a.csv"), "there is no such folder"),
    ],
)
def test_what_cannot_be_exported_is_reported(
    run_dir: Path, arguments: tuple[str, ...], message: str, call: Any
) -> None:
    code, _, err = call("export", *arguments)
    assert code == 2
    assert message in err
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("status", "printed"),
    [
        (None, "warning: the run is still in progress, so only the 1 shot of 2 taken so far are exported\n"),
        ("stopped", "warning: the run is stopped, so only 1 shot of 2 are exported\n"),
    ],
)
def test_a_run_that_did_not_complete_is_exported_as_far_as_it_came(
    run_dir: Path, fake: Any, status: Any, printed: str, call: Any
) -> None:
    writer = RunWriter.create(run_dir.parents[1], fake.run(n_shots=2))
    writer.write_shot(fake.shot(0))
    if status is not None:
        writer.finish(status)
    code, _, err = call("export", "-o", "a.csv")
    assert (code, err) == (0, printed)
    assert len(Path("a.csv").read_text("utf-8").splitlines()) == 2


def test_shots_left_out_of_an_archive_are_reported(run_dir: Path, call: Any) -> None:
    (run_dir / "shots" / "shot_000001.h5").unlink()
    code, out, err = call("export", "--to", "archive", "-o", "a.h5")
    assert (code, out) == (1, "written: a.h5\n")
    assert "warning: left out: " in err
    assert "shot_000001.h5: cannot be read" in err
    with h5py.File("a.h5") as file:
        assert list(file["shots"]) == ["shot_000000"]  # pyright: ignore[reportArgumentType]
