"""A run that is taken again, or gets more shots."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.errors import ConfigError

from .small_runs import write


def test_a_run_begins_with_its_note(tmp_path: Path) -> None:
    sequence = write(tmp_path)
    with labseq.Session.open(
        sequence, shots=1, output=tmp_path, note="new lens", tags=["a", " a "]
    ) as session:
        run = session.run()
    assert (run.note, run.tags) == ("new lens", ("a",))
    with pytest.raises(ConfigError, match="is too long; expected at most 60 characters"):
        labseq.Session.open(sequence, tags=["x" * 61])
