"""Everything that a user may get wrong with ``labseq plan``: exit code 2 and a sentence that helps."""

from __future__ import annotations

from pathlib import Path

import h5py
import numba
import numpy as np
import pytest

from labseq.cli import main

assert numba  # loaded already, so that the command does not turn compiling off for the tests after it

RANDOM = "random:20x20@0.75"
COMPACT = ("--target", "compact:15x15")

BAD = [
    (["nowhere.npy", *COMPACT], "nowhere.npy: there is no such file; expected a .npy file, a text file"),
    (["complex.npy", *COMPACT], "complex.npy: it holds an array of shape (2, 2) and type complex128"),
    (["cube.npy", *COMPACT], "cube.npy: it holds an array of shape (2, 2, 2)"),
    (["twos.npy", *COMPACT], "twos.npy: an occupancy holds only 0 and 1"),
    (["pickled.npy", *COMPACT], "pickled.npy: it cannot be read"),
    (["ragged.txt", *COMPACT], "ragged.txt:2:1: this row has 2 sites; expected 3, as in line 1"),
    (["letters.txt", *COMPACT], "letters.txt:1:2: 'x' is no site; expected 0 or '.'"),
    ([".", *COMPACT], "this is a folder"),
    (["random:20x@0.75", *COMPACT], "random:20x@0.75: this is no occupancy; expected random:ROWSxCOLS@P"),
    (["random:20x20@1.2", *COMPACT], "the filling fraction is '1.2'; expected a number from 0 to 1"),
    (["random:9999x20@0.5", *COMPACT], "it has 9999 x 20 sites; expected 1 to 1000 rows and columns"),
    (["text.h5#1", *COMPACT], "text.h5: "),
    (["empty.h5#1", *COMPACT], "empty.h5: "),
    ([RANDOM], "--target is missing; expected a pattern such as kagome:15x15"),
    ([RANDOM, "--target", "compact:21x21"], "the limit is the grid of 20 rows x 20 columns"),
    ([RANDOM, "--target", "kagomee:5x5"], "unknown pattern 'kagomee'; expected one of"),
    ([RANDOM, "--target", "kagomee:5x5"], "did you mean 'kagome'?"),
    ([RANDOM, "--target", "15x15"], "--target 15x15: this is no target"),
    ([RANDOM, "--target", "compact:5x5,orgin=[0, 0]"], "did you mean 'origin'?"),
    ([RANDOM, *COMPACT, "--planner", "pcsa"], "unknown planner 'pcsa'; expected"),
    ([RANDOM, *COMPACT, "--set", "degree_of_paralelism=2"], "did you mean 'degree_of_parallelism'?"),
    ([RANDOM, *COMPACT, "--dop", "0"], "--dop 0: degree_of_parallelism is 0; expected at least 1"),
    ([RANDOM, *COMPACT, "--dop", "many"], "--dop"),
    ([RANDOM, *COMPACT, "--origin", "9,9"], "row 9, column 9; the limit is rows 0 to 5 and columns 0 to 5"),
    ([RANDOM, *COMPACT, "--origin", "here"], "--origin here: this is no site"),
    ([RANDOM, *COMPACT, "--profile", "virtul"], "did you mean 'virtual'?"),
    ([RANDOM, *COMPACT, "--png", "a.jpg"], "a.jpg: this is no name of a PNG file"),
    ([RANDOM, *COMPACT, "--png", "gone/a.png"], "gone: there is no such folder; expected one that exists"),
    ([RANDOM, *COMPACT, "--json", "gone/a.json"], "gone/a.json: it cannot be written"),
    ([RANDOM, *COMPACT, "--json", "."], "it cannot be written"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder full of files that are no occupancies."""
    folder = tmp_path_factory.mktemp("bad")
    np.save(folder / "complex.npy", np.ones((2, 2), complex))
    np.save(folder / "cube.npy", np.ones((2, 2, 2)))
    np.save(folder / "twos.npy", np.full((2, 2), 2))
    np.save(folder / "pickled.npy", np.array([[print, None]], dtype=object), allow_pickle=True)
    (folder / "ragged.txt").write_text("101\n10\n", "utf-8")
    (folder / "letters.txt").write_text("1x1\n", "utf-8")
    (folder / "text.h5").write_text("no HDF5", "utf-8")
    h5py.File(folder / "empty.h5", "w").close()
    return folder


@pytest.mark.parametrize(("arguments", "words"), BAD)
def test_every_mistake_is_reported_as_text(
    folder: Path,
    arguments: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as leaving:
        main(["plan", *arguments])
    out, err = capsys.readouterr()
    assert (leaving.value.code, out) == (2, "")
    assert words in err
    assert "Traceback" not in err
    assert "internal error" not in err
