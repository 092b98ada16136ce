from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.errors import ConfigError
from labseq.model import MotionSpec, Occupancy, Plan, SiteGrid, TargetPattern
from labseq.motion import check_plan
from labseq.pictures.plans import DPI, MAX_SITES, PlanDrawing, check_picture, colour_of, save_plan

MATPLOTLIB = pytest.importorskip("matplotlib")
PIL = pytest.importorskip("PIL.Image")

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
        path = tmp_path / "plan.png"
        save_plan(path, what)
        with PIL.open(path) as image:
            assert image.info["dpi"] == pytest.approx((DPI, DPI), rel=1e-3)
            return np.asarray(image.convert("RGB")).astype(int)

    return save


def count(pixels: np.ndarray[Any, Any], colour: Any) -> int:
    """Pixels of about this colour."""
    wanted = np.round(255 * np.array(MATPLOTLIB.colors.to_rgb(colour)))
    return int(np.count_nonzero(np.abs(pixels - wanted).max(axis=2) < 12))


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


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (5, 5), (40, 40)])
@pytest.mark.parametrize("grid", [{}, {"shear": -1}, {"lattice": "square"}])
def test_arrays_of_all_shapes_can_be_drawn(save: Save, shape: tuple[int, int], grid: Any) -> None:
    occupancy, plan = np.ones(shape, np.bool_), Plan.from_batches([])
    pixels = save(drawing(occupancy, plan, **grid))
    assert max(pixels.shape[:2]) < 8000
    assert count(pixels, "white") < pixels[..., 0].size


def test_the_same_plan_gives_the_same_bytes_whatever_the_users_style(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = drawing(*row_plan(3, 3))
    save_plan(tmp_path / "a.png", what)
    monkeypatch.setitem(MATPLOTLIB.rcParams, "savefig.facecolor", "black")
    monkeypatch.setitem(MATPLOTLIB.rcParams, "font.size", 30.0)
    save_plan(tmp_path / "b.png", what)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_titles_are_shown_as_they_are(save: Save) -> None:
    occupancy, plan = row_plan(2, 2)
    what = drawing(occupancy, plan)
    odd = PlanDrawing("a $x", "$\\frac{", what.grid, occupancy, what.target, plan, what.report)
    save(odd)


DRAWS = """
import sys
from pathlib import Path
import numpy as np
from labseq.pictures.plans import PlanDrawing, save_plan
from labseq.model import Plan, PlanReport, SiteGrid, TargetPattern
assert "matplotlib" not in sys.modules
full = np.ones((2, 2), np.bool_)
report = PlanReport(full, np.empty(0), np.empty(0, np.int32), 0, 0)
plan, target = Plan.from_batches([]), TargetPattern(full, ~full)
save_plan(Path("a.png"), PlanDrawing("", "", SiteGrid(2, 2), full, target, plan, report))
assert "matplotlib" in sys.modules
assert "matplotlib.pyplot" not in sys.modules
"""


def test_matplotlib_is_imported_to_draw_and_pyplot_never(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", DRAWS], cwd=tmp_path, check=True)
    assert (tmp_path / "a.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("plan.svg", (5, 5), "this is no name of a PNG file; expected a file that ends in .png"),
        ("plan", (5, 5), "this is no name of a PNG file"),
        ("nowhere/plan.png", (5, 5), "nowhere: there is no such folder; expected one that exists"),
        ("folder.png", (5, 5), "this is a folder"),
        ("plan.png", (5, MAX_SITES + 1), f"5 x {MAX_SITES + 1} sites are too many for a picture"),
    ],
)
def test_what_cannot_be_drawn_is_told_before(tmp_path: Path, name: str, shape: Any, words: str) -> None:
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ConfigError) as caught:
        check_picture(tmp_path / name, shape)
    assert words in str(caught.value)


def test_without_matplotlib_there_is_a_hint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_picture(tmp_path / "a.PNG", (5, 5))
    monkeypatch.setattr("labseq.pictures.figures.find_spec", lambda _: None)
    with pytest.raises(
        ConfigError, match=r"needs matplotlib, which is not installed; pip install 'labseq\[plot\]'"
    ):
        check_picture(tmp_path / "a.png", (5, 5))


def test_a_picture_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the picture cannot be written"):
        save_plan(tmp_path / "gone" / "a.png", drawing(*row_plan(2, 2)))
