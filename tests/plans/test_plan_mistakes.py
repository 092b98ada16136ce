"""Everything that a user may get wrong with ``labseq plan``: exit code 2 and a sentence that helps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

assert numba  # loaded already, so that the command does not turn compiling off for the tests after it

RANDOM = "random:20x20@0.75"
COMPACT = ("--target", "{pattern: compact, rows: 15, cols: 15}")

BAD = [
    (["nowhere.npy", *COMPACT], "nowhere.npy: there is no such file; expected a text file of 0 and 1"),
    (["complex.npy", *COMPACT], "complex.npy: it holds an array of shape (2, 2) and type complex128"),
    (["ragged.txt", *COMPACT], "ragged.txt:2:3: this row has 2 sites; expected 3, as in line 1"),
    (
        ["long.txt", *COMPACT],
        "long.txt:2:7: this row has 4 sites; expected 3, as in line 1\n    2 | # . # #\n      |       ^",
    ),
    (
        ["letter.txt", *COMPACT],
        "letter.txt:2:5: 'o' is not a site; expected 0 or '.' for an empty site, 1 or '#'",
    ),
    (["random:20x@0.75", *COMPACT], "random:20x@0.75: this is not an occupancy; expected random:ROWSxCOLS@P"),
    (["text.h5#1", *COMPACT], "text.h5: "),
    (
        [RANDOM],
        "--target is missing; expected a pattern as in a sequence file, '{pattern: kagome, ",
    ),
    (
        [RANDOM, "--target", "{pattern: compact, rows: 21, cols: 21}"],
        "the limit is the grid of 20 rows x 20 columns",
    ),
    ([RANDOM, "--target", "{pattern: kagomee, rows: 5, cols: 5}"], "did you mean 'kagome'?"),
    ([RANDOM, "--target", "{pattern: compact, rows: 5, cols: 5, orgin: [0, 0]}"], "did you mean 'origin'?"),
    ([RANDOM, *COMPACT, "--planner", "pcsa"], "unknown planner 'pcsa'; expected"),
    ([RANDOM, *COMPACT, "--dop", "0"], "--dop 0: degree_of_parallelism is 0; expected at least 1"),
    ([RANDOM, *COMPACT, "--origin", "9,9"], "row 9, column 9; the limit is rows 0 to 5 and columns 0 to 5"),
    ([RANDOM, *COMPACT, "--profile", "virtul"], "did you mean 'virtual'?"),
    ([RANDOM, *COMPACT, "--png", "a.jpg"], "a.jpg: this is not the name of a PNG file"),
    ([RANDOM, *COMPACT, "--json", "gone/a.json"], "gone/a.json: it cannot be written"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder full of files that are not occupancies."""
    folder = tmp_path_factory.mktemp("bad")
    np.save(folder / "complex.npy", np.ones((2, 2), complex))
    (folder / "ragged.txt").write_text("101\n10\n", "utf-8")
    (folder / "long.txt").write_text("# . #\n# . # #\n", "utf-8")
    (folder / "letter.txt").write_text("# . #\n# . o\n", "utf-8")
    (folder / "text.h5").write_text("no HDF5", "utf-8")
    return folder


@pytest.mark.parametrize(("arguments", "words"), BAD)
def test_every_mistake_is_reported_as_text(
    folder: Path,
    arguments: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    call: Any,
) -> None:
    monkeypatch.chdir(folder)
    code, out, err = call("plan", *arguments)
    assert (code, out) == (2, "")
    assert words in err
    assert "Traceback" not in err
    assert "internal error" not in err
