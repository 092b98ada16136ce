from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import pytest

from labseq.cli import main
from labseq.recording import RunWriter


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


def called(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["export", *arguments])
    return int(str(ended.value.code or 0))


def test_the_newest_run_is_exported_under_its_own_name(
    run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called() == 0
    name = f"{run_dir.parent.name}_{run_dir.name}"
    assert capsys.readouterr().out.splitlines() == [f"written: {name}.csv", f"written: {name}.units.csv"]
    assert Path(f"{name}.csv").read_text("utf-8").startswith("shot,attempt,status,")


def test_a_file_that_is_there_is_replaced_by_force_only(
    run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("a.csv").write_text("old")
    assert called(str(run_dir), "-o", "a.csv") == 2
    assert "a.csv: this file is there already" in capsys.readouterr().err
    assert Path("a.csv").read_text() == "old"
    assert called(str(run_dir), "-o", "a.csv", "--force") == 0
    assert Path("a.csv").read_text() != "old"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--to", "xls"), "--to: a run cannot be exported as 'xls'"),
        (("--frames",), "--frames: a csv file holds no frames; use --to archive"),
        (("no/run",), "no/run"),
        (("-o", "no/a.csv"), "there is no such folder"),
    ],
)
def test_what_cannot_be_exported_is_reported(
    run_dir: Path, arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(*arguments) == 2
    assert message in capsys.readouterr().err
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("status", "printed"),
    [
        (None, "warning: the run is still in progress; exported are the 1 shot of 2 taken so far\n"),
        ("stopped", "warning: the run did not complete (stopped); exported are 1 shot of 2\n"),
    ],
)
def test_a_run_that_did_not_complete_is_exported_as_far_as_it_came(
    run_dir: Path, fake: Any, status: Any, printed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    writer = RunWriter.create(run_dir.parents[1], fake.run(n_shots=2))
    writer.write_shot(fake.shot(0))
    if status is not None:
        writer.finish(status)
    assert called("-o", "a.csv") == 0
    assert capsys.readouterr().err == printed
    assert len(Path("a.csv").read_text("utf-8").splitlines()) == 2


def test_shots_left_out_of_an_archive_are_reported(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run_dir / "shots" / "shot_000001.h5").unlink()
    assert called("--to", "archive", "-o", "a.h5") == 1
    captured = capsys.readouterr()
    assert "warning: left out: " in captured.err
    assert "shot_000001.h5: cannot be read" in captured.err
    assert captured.out == "written: a.h5\n"
    with h5py.File("a.h5") as file:
        assert list(file["shots"]) == ["shot_000000"]  # pyright: ignore[reportArgumentType]
