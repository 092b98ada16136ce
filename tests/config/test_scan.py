"""``scan:`` in a sequence: its values, its points, and everything that can be wrong with its form."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from labseq.config.addresses import Override
from labseq.config.document import Document
from labseq.config.scan import MAX_POINTS, AdaptiveScan, Scan, read_scan, values_of
from labseq.config.sequence import load_sequence
from labseq.errors import ConfigError
from labseq.units import split_quantity

REST = """labseq: 1
name: s
target: {pattern: compact}
shot:
  - load: {duration: 500 ms}
  - image: {}
  - {name: sort, rearrange: {window: 60 ms}}
"""
N_REST = REST.count("\n")


def scan_of(text: str, *fixed: Override) -> Scan:
    return read_scan(Document.parse(REST + text, "s.yaml"), fixed)


def points(scan: Scan) -> list[list[object]]:
    return [[node.value for _, node in scan.values(point)] for point in range(scan.n_points)]


def plain(text: str) -> list[object]:
    node = Document.parse(f"it: {text}\n", "s.yaml").root.child("it")
    assert node is not None
    return [value.value for value in values_of(node, "a.b")]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("[3, 5]", [3, 5]),
        ("{linspace: [50 um/ms, 200 um/ms, 4]}", ["50 um/ms", "100 um/ms", "150 um/ms", "200 um/ms"]),
        ("{linspace: [0.05 ms, 60 us, 2]}", ["0.05 ms", "0.06 ms"]),
        ("{linspace: [3, 15, 5]}", [3, 6, 9, 12, 15]),
        ("{linspace: [0, 0.3, 4]}", [0.0, 0.1, 0.2, 0.3]),
        ("{geomspace: [1 ms, 0.1 s, 5]}", ["1 ms", "3.16 ms", "10 ms", "31.6 ms", "100 ms"]),
        ("{geomspace: [-8, -1, 4]}", [-8, -4, -2, -1]),
        ("{geomspace: [1, 1.001, 3]}", [1, 1.00049987506, 1.001]),
        ("{range: [60 ms, 200 ms, 50 ms]}", ["60 ms", "110 ms", "160 ms"]),
        ("{range: [0, 1, 0.1]}", [round(0.1 * i, 1) for i in range(11)]),
        ("{range: [9, 3, -3]}", [9, 6, 3]),
        ("{range: [3, 3, 1]}", [3]),
    ],
)
def test_the_values_of_an_address(text: str, values: list[object]) -> None:
    assert plain(text) == values


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.integers(2, 50))
def test_linspace_gives_as_many_values_as_asked_and_both_ends(first: float, last: float, n: int) -> None:
    found = plain(f"{{linspace: [{first!r}, {last!r}, {n}]}}")
    assert len(found) == n
    assert np.allclose(np.array(found, float), np.linspace(first, last, n), rtol=1e-11, atol=1e-6)


@given(st.integers(-1000, 1000), st.integers(1, 100), st.integers(0, 99), st.sampled_from([1, 10, 1000]))
def test_range_includes_its_stop_if_a_step_falls_on_it(start: int, step: int, n: int, per: int) -> None:
    found = plain(f"{{range: [{start / per!r}, {(start + n * step) / per!r}, {step / per!r}]}}")
    assert len(found) == n + 1
    assert math.isclose(float(str(found[-1])), (start + n * step) / per, abs_tol=1e-9)


def test_addresses_of_a_mapping_make_every_combination_the_first_slowest() -> None:
    scan = scan_of("scan: {planner.dop: [3, 5], shot.sort.window: [1 ms, 2 ms]}\nplanner: {use: psca}\n")
    assert scan.shape == (2, 2)
    assert points(scan) == [[3, "1 ms"], [3, "2 ms"], [5, "1 ms"], [5, "2 ms"]]
    assert [axis.loc for axis in scan.axes] == [("planner", "dop"), ("shot", 2, "rearrange", "window")]


def test_addresses_of_one_mapping_of_a_list_go_together() -> None:
    together = "{shot.0.load.duration: [1 s, 2 s], profile.camera.gain: [7, 8]}"
    scan = scan_of(f"scan:\n  - {together}\n  - {{shot.sort.cycles: [1, 2]}}\n")
    assert scan.shape == (2, 2)
    assert points(scan) == [["1 s", 7, 1], ["1 s", 7, 2], ["2 s", 8, 1], ["2 s", 8, 2]]


def test_the_first_point_is_in_the_document_and_shots_follow_from_the_scan(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(REST + "scan: {shot.sort.window: [1 ms, 2 ms]}\nrepeats: 3\n")
    document, spec, _ = load_sequence(path)
    assert spec.shots == 6
    assert document.get(("shot", 2, "rearrange", "window")) == "1 ms"
    path.write_text(path.read_text() + "shots: 6\n")
    assert load_sequence(path)[1].shots == 6
    for n in (4, 6):
        assert load_sequence(path, [Override("shots", str(n), f"--shots {n}")])[1].shots == n


@settings(max_examples=25)
@given(st.integers(1, 40), st.integers(1, 6), st.integers(0, 2**63 - 1))
def test_each_round_of_a_shuffled_scan_takes_every_point_once(n: int, repeats: int, seed: int) -> None:
    listed = ", ".join(f"{i + 1} ms" for i in range(n))
    scan = scan_of(f"scan: {{shot.sort.window: [{listed}]}}\nrepeats: {repeats}\norder: shuffled\n")
    order = scan.points_of_shots(seed, n * repeats)
    assert np.array_equal(np.sort(order.reshape(repeats, n), axis=1), np.tile(np.arange(n), (repeats, 1)))
    # with more shots the first ones stay where they are
    assert np.array_equal(order, scan.points_of_shots(seed, n * (repeats + 2))[: n * repeats])


def test_no_point_of_a_shuffled_scan_comes_early_more_often_than_others() -> None:
    n, repeats = 5, 400
    scan = scan_of(
        f"scan: {{shot.sort.window: {{range: [1 ms, {n} ms, 1 ms]}}}}\nrepeats: {repeats}\norder: shuffled\n"
    )
    position = np.argsort(scan.points_of_shots(3, n * repeats).reshape(repeats, n), axis=1).mean(axis=0)
    error = np.sqrt((n**2 - 1) / 12 / repeats)
    np.testing.assert_allclose(position, (n - 1) / 2, atol=4.5 * error)


@given(st.floats(1.0, 1e3), st.floats(-6, 2), st.floats(0, 1))
def test_a_value_that_a_scanner_chooses_is_rounded_by_less_than_a_thousandth_of_its_range(
    low: float, log_width: float, part: float
) -> None:
    low, width = round(low, 3), float(f"{10**log_width:.3g}")
    over = f"{{shot.sort.window: {{from: {low!r} ms, to: {low + width!r} ms}}}}"
    scan = scan_of(f"scan: {{use: climb, over: {over}, maximise: success, points: 3}}\n")
    assert isinstance(scan, AdaptiveScan)
    ((_, node),) = scan.at([1e-3 * (low + part * width)]).values(0)
    amount, unit = split_quantity(str(node.value))
    assert unit == "ms"
    assert amount == pytest.approx(low + part * width, abs=1e-3 * width)


def test_a_sequential_scan_takes_all_shots_of_a_point_before_the_next() -> None:
    scan = scan_of("scan: {shot.sort.window: [1 ms, 2 ms]}\nrepeats: 2\n")
    assert scan.points_of_shots(1, 4).tolist() == [0, 0, 1, 1]


def test_shots_beyond_a_scan_begin_it_again(tmp_path: Path) -> None:
    scan = scan_of("scan: {shot.sort.window: [1 ms, 2 ms]}\nrepeats: 2\n")
    assert scan.points_of_shots(1, 7).tolist() == [0, 0, 1, 1, 0, 0, 1]
    path = tmp_path / "s.yaml"
    path.write_text(REST + "scan: {shot.sort.window: [1 ms, 2 ms]}\n")
    assert load_sequence(path, [Override("shots", "3", "--shots 3")])[1].shots == 3


def test_an_option_replaces_the_scan_of_its_address_with_a_note() -> None:
    text = "scan: {planner.dop: [3, 5], shot.sort.window: [1 ms, 2 ms]}\nplanner: {use: psca}\n"
    for fixed in (Override("planner.dop", "7"), Override("planner", "{use: lsap}")):
        scan = scan_of(text, fixed)
        assert [axis.address for axis in scan.axes] == ["shot.sort.window"]
        assert scan.notes == (f"--set {fixed.address}={fixed.value} replaces the scan of 'planner.dop'",)
    both = scan_of(text, Override("planner.dop", "7"), Override("shot.2.rearrange.window", "7 ms"))
    assert (both.n_points, points(both)) == (1, [[]])
    profile = scan_of("scan: {profile.camera.gain: [3, 5]}\n", Override("profile.camera.gain", "1"))
    assert not profile.axes


BAD = [
    ("scan: 5", "1:7: the scan is 5; expected a mapping of addresses"),
    ("scan: {}", "1:7: the scan is empty"),
    ("scan: [3]", "1:8: a group of the scan is 3"),
    ("scan: {shot.sort.window: 5 ms}", "1:26: the scan of 'shot.sort.window' is '5 ms'; expected a list"),
    ("scan: {shot.sort.window: {linspce: [1, 2, 3]}}", "1:27: 'linspce' is not a way to give values"),
    ("scan: {shot.sort.window: {linspace: [1, 2]}}", "1:37: linspace is"),
    ("scan: {shot.sort.window: {linspace: [1 ms, 2 ms, 1]}}", "1:50: the number of values is 1"),
    (
        "scan: {shot.sort.window: {linspace: [1 ms, 2, 3]}}",
        "1:44: 2 and '1 ms' have different dimensions; expected a time",
    ),
    ("scan: {shot.sort.window: {linspace: [.nan, 2, 3]}}", "1:38: .nan is not a valid limit"),
    ("scan: {shot.sort.window: {range: [1, 5, 0]}}", "1:41: the step 0 does not lead from start to stop"),
    ("scan: {shot.sort.window: {range: [0, 1, 1e-9]}}", "1:34: the range has 1e+09 values"),
    ("scan: {shot.sort.window: [1 ms, 1 ms]}", "1:33: '1 ms' occurs twice in the scan"),
    (
        "scan: {shot.sort.window: [1], shot.2.rearrange.window: [2]}",
        "1:31: 'shot.2.rearrange.window' and 'shot.sort.window' are both scanned",
    ),
    (
        "scan: {shot.sort: [{}], shot.sort.window: [2]}",
        "1:25: 'shot.sort.window' and 'shot.sort' are both scanned",
    ),
    ("scan: {shots: [1, 2]}", "1:8: a scan cannot change 'shots'; expected an address in 'planner'"),
    ("scan: {shot.2.name: [a, b]}", "1:8: a scan cannot change 'shot.2.name'"),
    ("scan: {shot.srt.window: [1, 2]}", "1:8: 'shot' has no item 'srt'"),
    (
        "scan: [{shot.sort.window: [1, 2], shot.0.load.duration: [1]}]",
        "1:35: 'shot.0.load.duration' has 1 value, but",
    ),
    ("repeats: 3", "1:1: 'repeats' is given without a scan"),
    ("scan: {shot.sort.window: [1, 2]}\nshots: 5", "2:8: shots is 5, but the scan has 2 x 1 = 2"),
    ("scan: {shot.sort.window: [1, 2]}\norder: random", "2:8: order is 'random'"),
]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[text for text, _ in BAD])
def test_a_wrong_scan_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "s.yaml"
    without = "scan" not in text
    path.write_text(REST + text + "\n" + ("shots: 1\n" if without else ""))
    with pytest.raises(ConfigError) as caught:
        load_sequence(path)
    line, rest = message.split(":", 1)
    (problem,) = caught.value.problems
    assert str(problem).startswith(f"{path}:{int(line) + N_REST}:{rest}")


def test_an_option_for_more_shots_than_an_adaptive_scan_has_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    over = "{shot.sort.window: {from: 1 ms, to: 9 ms}}"
    path.write_text(REST + f"scan: {{use: climb, over: {over}, maximise: success, points: 2}}\n")
    with pytest.raises(ConfigError, match=r"--shots 3: shots is 3, .* expected at most 2"):
        load_sequence(path, [Override("shots", "3", "--shots 3")])


def test_an_option_within_what_the_scan_changes_as_a_whole_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"the scan changes the whole of 'shot\.sort'"):
        scan_of("scan: {shot.sort: [{}, {cycles: 2}]}\n", Override("shot.sort.window", "1 ms"))


def test_too_many_points_are_refused() -> None:
    text = "scan: {shot.sort.window: {range: [1, 101, 1]}, shot.sort.exposure: {range: [1, 100, 1]}}\n"
    with pytest.raises(ConfigError, match=f"101 x 100 = 10100 points; expected at most {MAX_POINTS}"):
        scan_of(text)
