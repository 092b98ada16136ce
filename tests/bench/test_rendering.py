from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from labseq.bench.rendering import uniform_program
from labseq.cli import main
from labseq.model import SiteGrid
from labseq.motion.rendering import Renderer, RenderPath

GRID = SiteGrid()


def test_a_table_and_its_rows_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "waveform.json"
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["bench", "waveform", "--repeats", "1", "--json", str(path)])
    table, extent = capsys.readouterr().out.split("\n\n")
    rows = json.loads(path.read_text("utf-8"))["rows"]
    _, *lines = table.splitlines()
    assert [line.split("  ")[0] for line in lines] == [row["name"] for row in rows]
    assert all(row["gigasamples_per_s"] > 0 and row["playing_over_rendering"] > 0 for row in rows)
    assert "624 MHz" in extent


@pytest.mark.parametrize(("directions", "n_groups"), [((0,), 1), ((1,), 1), ((1, 0, -1), 3)])
def test_uniform_programs_have_the_groups_of_their_name(directions: tuple[int, ...], n_groups: int) -> None:
    program = uniform_program(GRID, 7, directions)
    chirps = np.unique((program.column.end_hz - program.column.start_hz)[:7])
    assert len(chirps) == n_groups
    assert (Renderer(program, 624e6).path == RenderPath.COMB).all()
