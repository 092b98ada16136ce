from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.strategies import DataObject
from numpy.typing import NDArray
from PIL import Image

from labseq.errors import ConfigError
from labseq.model import MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern
from labseq.motion import check_plan
from labseq.pictures.plans import (
    DPI,
    HEIGHT,
    MAX_PANELS,
    MAX_SITES,
    Lines,
    PlanDrawing,
    batch_lines,
    check_picture,
    colour_of,
    heights,
    hops,
    lanes,
    lines_label,
    make_panels,
    occupancies,
    save_plan,
)
from labseq.testing import strategies
from tests.pictures.pixels import decoded, is_colour


@settings(max_examples=30)
@given(st.data())
def test_the_last_occupancy_is_the_one_that_the_check_predicts(data: DataObject) -> None:
    before = data.draw(strategies.occupancies())
    plan = data.draw(strategies.plans(before))
    nothing = np.zeros_like(before)
    grid = SiteGrid(*before.shape)
    report = check_plan(plan, before, TargetPattern(nothing, nothing), 20, grid, MotionSpec(), "any")
    shown = occupancies(plan, before)
    assert len(shown) == plan.n_batches + 1
    assert np.array_equal(shown[0], before)
    assert np.array_equal(shown[-1], report.predicted)


@settings(max_examples=30)
@given(st.data())
def test_the_lines_of_a_batch_are_those_that_its_atoms_stay_on(data: DataObject) -> None:
    before = data.draw(strategies.occupancies())
    plan = data.draw(strategies.plans(before))
    for (axis, lines), batch in zip(batch_lines(plan), plan.batches, strict=True):
        column = 1 if axis == "column" else 0
        assert lines == tuple(sorted(set(batch.from_sites[:, column].tolist())))
        assert np.array_equal(batch.from_sites[:, column], batch.to_sites[:, column])


def test_ejected_atoms_leave_the_array() -> None:
    plan = Plan.from_batches([([(0, 0), (0, 2)], [(0, -1), (0, 3)])])
    assert occupancies(plan, np.ones((1, 3), np.bool_))[1].tolist() == [[False, True, False]]


@settings(max_examples=30)
@given(st.sets(st.integers(0, 30), min_size=1))
def test_line_labels_name_every_line_once(lines: set[int]) -> None:
    words = lines_label("row", lines)
    spans = words.split(" ", 1)[1].split(", ")
    named = [n for span in spans for n in range(int(span.split("-")[0]), int(span.split("-")[-1]) + 1)]
    assert named == sorted(lines)
    assert words.startswith("rows " if len(lines) > 1 else "row ")


BATCHES = st.lists(
    st.tuples(
        st.sampled_from(["row", "column"]),
        st.sets(st.integers(0, 4), min_size=1, max_size=2).map(sorted).map(tuple),
    ),
    max_size=120,
)


@settings(max_examples=30)
@given(BATCHES, st.integers(2, 40))
def test_every_batch_is_in_one_panel_in_order_and_panels_are_few_enough(
    batches: list[Lines], max_panels: int
) -> None:
    panels = make_panels(batches, max_panels)
    assert len(panels) <= max_panels
    assert sum(panel.n_batches for panel in panels) == len(batches)
    assert all(after.first == before.last + 1 for before, after in pairwise(panels))
    assert (panels[0].first if panels else 0) == 0
    for panel in panels:
        named = {(axis, line) for axis, lines in panel.moves_along for line in lines}
        here = batches[panel.first : panel.last + 1]
        assert named == {(axis, line) for axis, lines in here for line in lines}


@settings(max_examples=30)
@given(BATCHES)
def test_a_batch_is_alone_while_there_is_room(batches: list[Lines]) -> None:
    panels = make_panels(batches, max(1, len(batches)))
    assert all(panel.n_batches == 1 for panel in panels)
    assert len(make_panels(batches)) <= MAX_PANELS


LINES = st.lists(
    st.tuples(st.booleans(), st.integers(0, 2), st.integers(-1, 8), st.integers(-1, 8)), max_size=30
)


def as_moves(ways: list[tuple[bool, int, int, int]]) -> NDArray[np.int16]:
    """Moves along rows and columns from (along a column, line, start, end)."""
    rows = [
        (start, line, end, line) if along_column else (line, start, line, end)
        for along_column, line, start, end in ways
        if start != end
    ]
    return np.array(rows, np.int16).reshape(-1, 4)


@settings(max_examples=30)
@given(LINES.map(as_moves))
def test_ways_that_share_a_stretch_lie_in_different_lanes(moves: NDArray[np.int16]) -> None:
    found = lanes(moves)
    assert set(found.tolist()) == set(range(found.max(initial=-1) + 1))
    by_place = defaultdict[object, list[tuple[int, int]]](list)
    for (r0, c0, r1, c1), lane in zip(moves.tolist(), found.tolist(), strict=True):
        along_column = r0 != r1
        line, start, end = (c0, r0, r1) if along_column else (r0, c0, c1)
        by_place[along_column, line, start < end, lane].append((min(start, end), max(start, end)))
    for taken in by_place.values():
        assert all(a[1] <= b[0] or b[1] <= a[0] for a, b in combinations(taken, 2))


@settings(max_examples=30)
@given(st.integers(1, 50))
def test_all_lanes_have_room(n_lanes: int) -> None:
    height = heights(np.arange(n_lanes))
    assert (np.diff(height) > 0).all()
    assert HEIGHT[0] == height.min() <= height.max() <= HEIGHT[1] + 1e-12


def test_arrows_start_and_end_beside_their_sites_and_bulge_to_one_side() -> None:
    start, end = np.array([[0.0, 0.0], [5.0, 0.0]]), np.array([[5.0, 0.0], [0.0, 0.0]])
    shafts, heads = hops(start, end, np.array([0.3, 0.3]))
    assert np.allclose(shafts[:, 0], [[0.16, 0.0], [4.84, 0.0]])
    assert np.allclose(heads[:, 0], [[4.84, 0.0], [0.16, 0.0]])
    assert (shafts[0, 1:-1, 1] < 0).all()
    assert (shafts[1, 1:-1, 1] > 0).all()


Save = Callable[..., np.ndarray[Any, Any]]


def drawing(occupancy: Occupancy, plan: Plan, fill: Any = None, **grid: Any) -> PlanDrawing:
    sites = SiteGrid(*occupancy.shape, **grid)
    wanted = np.zeros_like(occupancy) if fill is None else np.array(fill, np.bool_)
    target = TargetPattern(wanted, np.zeros_like(wanted))
    report = check_plan(plan, occupancy, target, 20, sites, MotionSpec(), "any")
    return PlanDrawing("title", "source", sites, occupancy, target, plan, report)


@pytest.fixture
def save(tmp_path: Path) -> Save:
    def save(what: PlanDrawing) -> np.ndarray[Any, Any]:
        save_plan(tmp_path / "plan.png", what)
        with Image.open(tmp_path / "plan.png") as image:
            assert image.info["dpi"] == pytest.approx((DPI, DPI), rel=1e-3)
        return decoded((tmp_path / "plan.png").read_bytes(), "RGB")

    return save


def count(pixels: np.ndarray[Any, Any], colour: Any) -> int:
    return int(np.count_nonzero(is_colour(pixels, colour)))


def row_plan(n_rows: int, n_cols: int) -> tuple[Occupancy, Plan]:
    """One atom per row, that goes from the first to the last column."""
    occupancy = np.zeros((n_rows, n_cols), np.bool_)
    occupancy[:, 0] = True
    return occupancy, Plan.from_batches([([(row, 0)], [(row, n_cols - 1)]) for row in range(n_rows)])


def test_every_batch_has_the_colour_of_its_place(save: Save) -> None:
    pixels = save(drawing(*row_plan(4, 4)))
    assert all(count(pixels, colour_of(i, 4)) > 20 for i in range(4))


def test_batches_that_share_a_panel_have_colours_of_their_own(save: Save) -> None:
    occupancy, plan = np.zeros((2, 3), np.bool_), [([(0, 0)], [(0, 2)]), ([(0, 2)], [(0, 0)])] * 30
    occupancy[0, 0] = True
    pixels = save(drawing(occupancy, Plan.from_batches(plan)))
    assert count(pixels, colour_of(0, 2)) > 20
    assert pixels.shape[0] < 60 * DPI


def test_an_ejected_atom_is_marked(save: Save) -> None:
    occupancy = np.ones((3, 3), np.bool_)
    red = "#c8102e"
    assert count(save(drawing(occupancy, Plan.from_batches([]))), red) == 0
    gone = Plan.from_batches([([(0, 0)], [(-1, 0)])])
    assert count(save(drawing(occupancy, gone)), red) > 50


def test_a_target_site_that_stays_empty_is_marked(save: Save) -> None:
    occupancy = np.array([[True, False, False]])
    plan = Plan.from_batches([])
    assert count(save(drawing(occupancy, plan, [[1, 1, 0]])), "#c8102e") > 10
    assert count(save(drawing(occupancy, plan, [[1, 0, 0]])), "#c8102e") == 0


@pytest.mark.parametrize(
    ("shape", "grid"),
    [((1, 1), {}), ((9, 1), {"shear": -1}), ((1, 9), {"lattice": "square"}), ((40, 40), {})],
)
def test_arrays_of_all_shapes_can_be_drawn(save: Save, shape: tuple[int, int], grid: Any) -> None:
    pixels = save(drawing(np.ones(shape, np.bool_), Plan.from_batches([]), **grid))
    assert max(pixels.shape[:2]) < 8000
    assert count(pixels, "white") < pixels[..., 0].size


def test_only_png_files_and_arrays_of_a_visible_size_can_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="this is not the name of a PNG file"):
        check_picture(tmp_path / "plan.svg", (5, 5))
    with pytest.raises(ConfigError, match=f"5 x {MAX_SITES + 1} sites are too many for a picture"):
        check_picture(tmp_path / "plan.png", (5, MAX_SITES + 1))
