"""`labseq runs`, and the names by which commands accept a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.console.runs import folder_of_run
from labseq.recording import RunWriter
from labseq.recording.notes import Notes, write_notes

DAYS = ("2026-01-02", "2026-01-03")


@pytest.fixture
def data(fake: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two days with a complete and a stopped run each, and what is left of three others."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LABSEQ_DATA", "runs")
    root = tmp_path / "runs"
    for day in DAYS:
        for number, n_written in ((1, 2), (10_000, 1)):
            writer = RunWriter.create(tmp_path / "made", fake.run(n_shots=2))
            for index in range(n_written):
                writer.write_shot(fake.shot(index))
            writer.finish("complete" if n_written == 2 else "stopped")
            (root / day).mkdir(parents=True, exist_ok=True)
            writer.run_dir.rename(root / day / f"{number:04}_compact-225")
    for name, text in (("0002_half", b'{"format"'), ("0003_old", b'{"format": "labseq-run"}')):
        (root / DAYS[0] / name).mkdir()
        (root / DAYS[0] / name / "run.json").write_bytes(text)
    (root / DAYS[0] / "0004_empty" / "shots").mkdir(parents=True)
    with (root / DAYS[1] / "0001_compact-225" / "index.jsonl").open("ab") as index:
        index.write(b'{"shot": "x", "counts": true, "bytes": "many"}\n[]\nnoise\n{"shot": 3')
    return root


def test_the_runs_of_a_folder(data: Path, call: Any) -> None:
    code, out, err = call("runs")
    lines = [line.split("  ")[0] for line in out.splitlines()]
    names = [f"{DAYS[0]}/{name}" for name in ("0001_compact-225", "0002_half", "0003_old", "0004_empty")]
    names += [f"{DAYS[0]}/10000_compact-225", f"{DAYS[1]}/0001_compact-225", f"{DAYS[1]}/10000_compact-225"]
    assert (code, err, lines[1:8]) == (0, "", names)
    assert lines[9] == "3 runs cannot be read: `labseq doctor` says why"
    table = {line.split()[0]: line.split() for line in out.splitlines()[1:8]}
    assert table[names[0]][2:8] == ["-", "2", "of", "2", "complete", "simulated"]
    assert table[names[1]][4] == "damaged"
    assert table[names[-1]][3:7] == ["1", "of", "2", "stopped"]

    code, out, _ = call("runs", "runs", "--name", "COMPACT", "--limit", "1", "--json")
    answer = json.loads(out)
    assert (code, answer["n_runs"]) == (0, 4)
    (run,) = answer["runs"]
    assert (run["run"], run["shots"], run["n_shots"], run["status"]) == (names[-1], 1, 2, "stopped")
    shots = list(Path(run["run_dir"]).glob("shots/*.h5"))
    assert run["bytes"] == sum(path.stat().st_size for path in shots) > 0
    code, out, _ = call("runs", "--limit", "2")
    assert out.splitlines()[-1] == "the newest of 7 runs; --limit 7 lists all"
    assert call("runs", "--name", "x") == (0, "no runs with 'x' in their name in runs\n", "")
    code, _, err = call("runs", "nowhere")
    assert (code, err[:9]) == (2, "nowhere: ")


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("2026-01-02/0001_compact-225", "2026-01-02/0001_compact-225"),
        ("2026-01-02/1", "2026-01-02/0001_compact-225"),
        ("0001_compact-225", "2026-01-03/0001_compact-225"),
        ("0001", "2026-01-03/0001_compact-225"),
        ("compact-225", "2026-01-03/10000_compact-225"),
        ("2026-01-02/compact-225", "2026-01-02/10000_compact-225"),
        ("runs/2026-01-02/0001_compact-225", "2026-01-02/0001_compact-225"),
    ],
)
def test_a_run_is_found_by_its_name_or_number(name: str, folder: str, data: Path) -> None:
    assert folder_of_run(Path(name)).resolve() == (data / folder).resolve()


def test_a_name_of_no_run(data: Path, call: Any) -> None:
    for command in ("show", "doctor", "resume"):
        code, out, err = call(command, "2026-01-04/1")
        assert (code, out) == (2, "")
        assert err.startswith("2026-01-04/1: ")
        assert "`labseq runs`" in err


def test_note_and_tags_are_those_of_the_page(data: Path, call: Any) -> None:
    folder = data / DAYS[1] / "10000_compact-225"
    write_notes(folder, Notes.of("from the page", ["lens", "good"]))
    code, out, err = call("note", "10000", "--tag", "new", "--untag", "lens")
    assert (code, err) == (0, "")
    assert out.splitlines()[1:] == ["note  from the page", "tags  good, new"]
    code, _, err = call("note", "10000", "--untag", "lens")
    assert (code, err) == (2, "--untag: the run has no tag 'lens'; expected one of good, new\n")
    assert call("note", "10000", "two\nlines")[0] == 0
    run = labseq.open_run("10000")
    assert (run.note, run.tags) == ("two\nlines", ("good", "new"))
