"""Results of analyses: one file of lines for each, readable in whatever state it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from labseq.data.reader import open_run
from labseq.errors import RecordingError
from labseq.recording.results import ResultsLog, read_results, results_file, rows_of, shots_with_result
from labseq.recording.writer import RunWriter

from .records import make_run

ABOUT = {"analysis": "mine", "settings": {"width": 1.0}, "again": False}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return results_file(tmp_path, "mine")


def test_rows_come_back_in_the_order_of_the_shots(path):
    log = ResultsLog(path, ABOUT)
    for shot in (2, 0, 1):
        log.write(shot, {"mean": np.float64(shot / 2), "sites": np.eye(2, dtype=np.int64)})
    rows, about = read_results(path)
    assert [row["shot"] for row in rows] == [0, 1, 2]
    assert rows[1] == {"shot": 1, "mean": 0.5, "sites": [[1, 0], [0, 1]]}
    assert about == ABOUT


def test_of_several_rows_of_a_shot_the_last_counts(path):
    log = ResultsLog(path, ABOUT)
    log.fail(0, ValueError("too dark"))
    assert read_results(path)[0] == [{"shot": 0, "error": "ValueError: too dark"}]
    assert shots_with_result(read_results(path)[0]) == set()
    log.write(0, {"mean": 1})
    assert read_results(path)[0] == [{"shot": 0, "mean": 1}]
    assert shots_with_result(read_results(path)[0]) == {0}


def test_what_was_before_results_that_are_begun_again_does_not_count(path):
    ResultsLog(path, ABOUT).write(0, {"mean": 1})
    ResultsLog(path, ABOUT).write(1, {"mean": 2})
    ResultsLog(path, {**ABOUT, "again": True}).write(5, {"mean": 3})
    assert read_results(path)[0] == [{"shot": 5, "mean": 3}]


def test_a_torn_last_line_is_no_result_and_takes_none_with_it(path):
    ResultsLog(path, ABOUT).write(0, {"mean": 1})
    with path.open("ab") as file:
        file.write(b'{"shot": 1, "me')
    assert [row["shot"] for row in read_results(path)[0]] == [0]
    ResultsLog(path, ABOUT).write(2, {"mean": 2})
    assert [row["shot"] for row in read_results(path)[0]] == [0, 2]


@pytest.mark.parametrize("result", [None, 5, [1], {"shot": 1}, {"error": 1}, {3: 1}])
def test_what_is_no_result_is_refused(result):
    with pytest.raises(TypeError, match="the result"):
        ResultsLog.checked(result)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (1 + 2j, "'x' is of the type complex; .*real and imaginary part under two names"),
        (np.zeros(3, np.complex128), "'x' is of the type array of complex128; .*two names"),
        ({"a": [1, {"b": object()}]}, "'x', 'a', number 1, 'b' is of the type object; expected numbers"),
        (np.zeros(3, [("a", "f8")]), "array of void"),
        ([0.5] * 300_000, r"the result has 1\.5 MB of text, .*return numpy arrays"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused_where_it_is(value, words):
    with pytest.raises(TypeError, match=words):
        ResultsLog.checked({"good": 1, "x": value})


def test_large_arrays_are_in_files_of_their_own(path):
    image, log = np.arange(2e6, dtype=np.float32).reshape(1000, 2000), ResultsLog(path, ABOUT)
    log.write(0, ResultsLog.checked({"light": np.float64(3), "an/image": image, "map": np.eye(3)}))
    assert path.stat().st_size < 1000
    (row,) = rows_of(path.parent.parent, "mine")
    assert (row["light"], row["map"]) == (3.0, np.eye(3).tolist())
    assert (row["an/image"].shape, row["an/image"].dtype) == ((1000, 2000), "float32")
    assert np.array_equal(np.asarray(row["an/image"]), image)
    (path.parent / "mine" / "shot_000000.h5").unlink()
    with pytest.raises(RecordingError, match="--again"):
        np.asarray(row["an/image"])


def test_a_line_that_an_earlier_labseq_wrote_much_too_long_hides_no_other(path):
    log = ResultsLog(path, ABOUT)
    log.write(0, {"mean": 1})
    with path.open("ab") as file:
        file.write(b'{"shot": 1, "image": [' + b"[0.123456789]," * 1_300_000 + b"[0]]}\n")
    ResultsLog(path, ABOUT).write(2, {"mean": 2})
    assert path.stat().st_size > 17 << 20
    assert [row["shot"] for row in read_results(path)[0]] == [0, 2]


def test_a_run_finds_its_results(tmp_path):
    writer = RunWriter.create(tmp_path, make_run())
    ResultsLog(results_file(writer.run_dir, "my µ/analysis"), ABOUT).write(0, {"mean": 1})
    assert open_run(writer.run_dir).analysis("my µ/analysis") == [{"shot": 0, "mean": 1}]
    expected = (
        r"of the analysis 'other', only of my_µ_analysis; make them with 'labseq analyse .* --use other'"
    )
    with pytest.raises(RecordingError, match=expected):
        open_run(writer.run_dir).analysis("other")
