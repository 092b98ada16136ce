"""A run that is taken again, or gets more shots."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.errors import ConfigError
from labseq.testing.fakes import RecordingObserver

from .small_runs import changed, write


def test_a_run_begins_with_its_note(tmp_path: Path) -> None:
    sequence = write(tmp_path)
    with labseq.Session.open(
        sequence, shots=1, output=tmp_path, note="new lens", tags=["a", " a "]
    ) as session:
        run = session.run()
    assert (run.note, run.tags) == ("new lens", ("a",))
    with pytest.raises(ConfigError, match="is too long; expected at most 60 characters"):
        labseq.Session.open(sequence, tags=["x" * 61])


def test_a_complete_run_gets_more_shots(tmp_path: Path) -> None:
    sequence = write(tmp_path, "steps")
    options: dict[str, Any] = {"seed": 4, "output": tmp_path}
    whole = labseq.Session.open(sequence, shots=8, **options).run()
    run = labseq.Session.open(sequence, shots=5, **options).run()
    with pytest.raises(ConfigError, match="it has 5 shots; expected a larger number"):
        labseq.Session.resume(run.path, shots=5)
    with labseq.Session.resume(run.path, shots=8) as session:
        more = session.run()
    assert (more.status, more.n_shots, len(more.shots)) == ("complete", 8, 8)
    for name in ("scan", "overrides", "resolved"):
        assert more.record[name] == whole.record[name]
    for shot, other in zip(more.shots, whole.shots, strict=True):
        assert np.array_equal(shot.occupancies, other.occupancies)
    with pytest.raises(ConfigError, match="no shot is missing; --shots N adds more"):
        labseq.Session.resume(run.path)


def test_more_shots_leave_the_settings_of_the_first_on_record(tmp_path: Path) -> None:
    run = labseq.Session.open(write(tmp_path), shots=1, output=tmp_path).run()
    changed(run.path, lambda record: record["resolved"]["planner"].update(degree_of_parallelism=3))
    with labseq.Session.resume(run.path, shots=2, accept_changes=True) as session:
        record = session.run().record
    assert (record["n_shots"], record["resolved"]["shots"]) == (2, 2)
    assert record["resolved"]["planner"]["degree_of_parallelism"] == 3
    assert [change["what"] for change in record["resumed"][0]["changes"]] == ["planner.degree_of_parallelism"]


def test_a_run_is_taken_again(tmp_path: Path) -> None:
    sequence = write(tmp_path)
    change = "planner.degree_of_parallelism=3"
    first = labseq.Session.open(sequence, shots=1, output=tmp_path, overrides=[change]).run()
    sequence.write_text("no longer a sequence", encoding="utf-8")
    seen = RecordingObserver()
    with labseq.Session.rerun(first.path, same_seed=True, output=tmp_path, observer=seen) as session:
        again = session.run()
    assert (again.seed, again.changes) == (first.seed, {**first.changes, "seed": str(first.seed)})
    assert np.array_equal(again.shots[0].occupancies, first.shots[0].occupancies)
    assert again.note == f"rerun of {first.path.parent.name}/{first.path.name}"
    assert not [values for values in seen.of("warning") if "changed since" in values["text"]]
    record = json.loads((first.path / "run.json").read_text("utf-8"))
    record["provenance"]["labseq"] = "0.1.9"
    (first.path / "run.json").write_text(json.dumps(record), "utf-8")
    other = labseq.Session.rerun(first.path, shots=2, output=tmp_path, observer=seen).run()
    assert (other.n_shots, other.seed == first.seed) == (2, False)
    with pytest.raises(ConfigError, match="shots is 0"):
        labseq.Session.rerun(first.path, shots=0)
    (text,) = [values["text"] for values in seen.of("warning") if "changed since" in values["text"]]
    assert text == f"changed since {first.path.name}: labseq was 0.1.9 and is now {labseq.__version__}"
