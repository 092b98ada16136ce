"""`labseq runs`, and the names by which commands accept a run."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.console.runs import folder_of_run
from labseq.data import described
from labseq.recording.notes import Notes, write_notes
from labseq.recording.writer import RunWriter

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
    rows = [line.split() for line in out.splitlines()]
    names = [f"{DAYS[0]}/{n}" for n in (1, 2, 3, 4, 10_000)] + [f"{DAYS[1]}/{n}" for n in (1, 10_000)]
    assert (code, err, [row[0] for row in rows[1:8]]) == (0, "", names)
    assert out.splitlines()[9] == "3 runs cannot be read; `labseq doctor` says why"
    assert rows[1][2:] == ["compact-225", "-", "filling", "100", "%", "2", "of", "2", "complete"]
    assert rows[2][2:] == ["0002_half", "-", "-", "-", "damaged"]

    code, out, _ = call("runs", "runs", "--search", "COMPACT stopped", "--limit", "1", "--json")
    answer = json.loads(out)
    assert (code, answer["has_more"]) == (0, True)
    (run,) = answer["runs"]
    assert (run["number"], run["shots"], run["n_shots"], run["status"]) == (names[-1], 1, 2, "stopped")
    assert run["results"][0] == {"name": "filling", "value": 1.0, "error": None, "unit": "", "at": ""}
    shots = list(Path(run["path"]).glob("shots/*.h5"))
    assert run["bytes"] == sum(path.stat().st_size for path in shots) > 0
    assert call("runs", "--search", "x?") == (0, "no such runs in runs\n", "")
    code, _, err = call("runs", "nowhere")
    assert (code, err[:9]) == (2, "nowhere: ")


def test_runs_are_chosen_and_sorted(data: Path, call: Any) -> None:
    write_notes(data / DAYS[0] / "0001_compact-225", Notes.of("new lens", ["good"]))

    def numbers(*options: str) -> list[str]:
        code, out, err = call("runs", "--json", *options)
        assert (code, err) == (0, "")
        return [run["number"][8:] for run in json.loads(out)["runs"]]

    assert numbers("--tag", "good") == numbers("--search", "LENS") == ["02/1"]
    assert numbers("--since", DAYS[1]) == ["03/1", "03/10000"]
    assert numbers("--until", DAYS[0], "--sequence", "compact_225", "--where", "shots < 2") == ["02/10000"]
    assert numbers("--status", "stopped", "--sort", "shots") == ["02/10000", "03/10000"]
    assert numbers("--sort=-shots", "--limit", "2") == ["02/10000", "03/10000"]
    for option, message in {
        "--sort=tau": "--sort: none of the runs has a value 'tau'; expected one of 'defect_free', 'filling'",
        "--since=May": "since: 'May' is not a date; expected a date, for example 2026-11-20",
        "--where=shots < 1 parsec": "--where: '1 parsec' is not a number",
    }.items():
        code, _, err = call("runs", option)
        assert (code, err[: len(message)]) == (2, message)


def test_what_is_kept_of_a_run_follows_its_files(
    data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("LABSEQ_CACHE", str(tmp_path / "cache"))
    read, reader = list[str](), described.read_entry
    monkeypatch.setattr(described, "read_entry", lambda folder: read.append(folder.name) or reader(folder))
    two_minutes_ago = time.time() - 120
    folders = [folder for folder in data.glob("*/*") if (folder / "run.json").is_file()]
    for path in (path for folder in folders for path in (*folder.iterdir(), folder)):
        os.utime(path, (two_minutes_ago, two_minutes_ago))
    first = [*labseq.runs(since=DAYS[1])]
    read.clear()
    assert [*map(repr, labseq.runs(since=DAYS[1]))] == [*map(repr, first)]  # nan is not itself
    assert read == []
    write_notes(first[0].path, Notes.of("later"))
    assert next(labseq.runs()).note == "later"
    assert read == ["10000_compact-225"]  # and no older one
    (cache,) = (tmp_path / "cache" / "runs").iterdir()
    cache.write_bytes(b"damaged " * 1000)
    assert len([*labseq.runs()]) == 7
    assert [run.note for run in labseq.runs(where=["shots == 1"])] == ["later", ""]
    for _ in range(2):  # the second time of what is kept
        assert [run.note for run in labseq.runs(search="later")] == ["later"]


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
