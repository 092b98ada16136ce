from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from labseq.errors import ConfigError
from labseq.messages import install_hint
from labseq.model import Plan, SiteGrid
from labseq.pictures.figures import (
    HEAD_IN,
    MARGIN,
    Extent,
    cell,
    check_place,
    extent_of_sites,
    make_figure,
    neighbours,
    outline,
    place_sites,
    plan_timelines,
    save_figure,
    show_plain_numbers,
)
from labseq.testing.strategies import grids


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("figure.gif", r"not the name of a PNG or SVG or PDF file.*ends in \.png or \.svg or \.pdf"),
        ("nowhere/figure.png", "no such folder"),
        ("a_folder.png", "this is a folder"),
        ("f" * 300 + ".png", "not the name of a file"),
    ],
)
def test_a_file_that_cannot_be_a_picture_is_refused(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a_folder.png").mkdir()
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        check_place(tmp_path / name)


def test_without_matplotlib_there_is_a_hint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_place(tmp_path / "a.PNG")
    monkeypatch.setattr("labseq.pictures.figures.find_spec", lambda _: None)
    with pytest.raises(
        ConfigError, match=re.escape(f"needs matplotlib, which is not installed; {install_hint('plot')}")
    ):
        check_place(tmp_path / "a.png")


def draw() -> Any:
    figure = make_figure(1.0, 1.0)
    figure.add_subplot().imshow([[0.0, 1.0]])
    figure.suptitle("$\\frac{")
    return figure


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_equal_figures_are_equal_files_in_any_style(kind: str, tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.{kind}" for name in "ab"]
    save_figure(paths[0], draw)
    with mpl.rc_context({"savefig.facecolor": "black", "image.cmap": "hot", "savefig.dpi": 30}):
        save_figure(paths[1], draw)
    assert paths[0].read_bytes() == paths[1].read_bytes() != b""


def test_a_picture_that_cannot_be_written_leaves_the_older_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone.a\.png: the picture cannot be written: No such file"):
        save_figure(tmp_path / "gone" / "a.png", draw)
    (tmp_path / "a.png").write_bytes(b"an older one")
    (tmp_path / "a.png.part").mkdir()
    with pytest.raises(ConfigError, match="the picture cannot be written"):
        save_figure(tmp_path / "a.png", draw)
    assert (tmp_path / "a.png").read_bytes() == b"an older one"


DRAWS = """
import sys
from pathlib import Path
import numpy as np
from labseq.pictures.targets import save_target
import labseq.plans.waveform_picture
from labseq.model import SiteGrid, TargetPattern
assert "matplotlib" not in sys.modules
full = np.ones((2, 2), np.bool_)
save_target(Path("a.png"), TargetPattern(full, ~full), SiteGrid(2, 2))
assert "matplotlib" in sys.modules
assert "matplotlib.pyplot" not in sys.modules
"""


def test_matplotlib_is_imported_to_draw_and_pyplot_never(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", DRAWS], cwd=tmp_path, check=True)
    assert (tmp_path / "a.png").stat().st_size > 0


@settings(max_examples=30)
@given(grids(max_shape=(9, 9)))
def test_sites_stand_as_on_the_lattice(grid: SiteGrid) -> None:
    places = place_sites(np.argwhere(np.ones(grid.shape)), grid)
    expected = (grid.positions_m - grid.positions_m[0, 0]).reshape(-1, 2) / grid.spacing_m
    assert np.allclose(places, expected)


@settings(max_examples=30)
@given(grids(max_shape=(9, 9)))
def test_a_panel_shows_every_site_and_where_atoms_are_ejected(grid: SiteGrid) -> None:
    n_rows, n_cols = grid.shape
    plan = Plan.from_batches([([(0, 0)], [(-1, 0)]), ([(n_rows - 1, n_cols - 1)], [(n_rows - 1, n_cols)])])
    for shown in (plan, Plan.from_batches([])):
        extent = extent_of_sites(shown.moves[:, 2:], grid)
        sites = np.argwhere(np.ones(grid.shape))
        x, y = place_sites(np.concatenate([sites, shown.moves[:, 2:]]), grid).T
        assert (extent.left, extent.right) == pytest.approx((x.min() - MARGIN, x.max() + MARGIN))
        assert (extent.top, extent.bottom) == pytest.approx((y.min() - MARGIN, y.max() + MARGIN))


@settings(max_examples=30)
@given(st.floats(3, 200), st.floats(3, 200), st.integers(2, 40))
def test_panels_stand_on_the_sheet_beside_one_another(width: float, height: float, n_panels: int) -> None:
    sheet = plan_timelines(Extent(0.0, width, 0.0, height), n_panels)
    places = [sheet.place(i) for i in range(n_panels)]
    for left, bottom, across, up in places:
        assert left >= -1e-9
        assert bottom >= -1e-9
        assert left + across <= 1 + 1e-9
        assert bottom + up <= 1 - HEAD_IN / sheet.height_in + 1e-9
        assert across * sheet.width_in / width == pytest.approx(up * sheet.height_in / height)
    for (l1, b1, w, h), (l2, b2, _, _) in combinations(places, 2):
        assert abs(l1 - l2) >= w - 1e-9 or abs(b1 - b2) >= h - 1e-9


CELLS = [(SiteGrid(4, 5), 6), (SiteGrid(4, 5, shear=-1), 6), (SiteGrid(4, 5, lattice="square"), 4)]
"""Grids, and how many neighbours a site has."""


@pytest.mark.parametrize(("grid", "n"), CELLS)
def test_cells_fill_the_plane(grid: SiteGrid, n: int) -> None:
    corners = cell(grid)
    x, y = corners.T
    area = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
    a1, a2 = grid.axes / grid.spacing_m
    assert len(neighbours(grid)) == len(corners) == n
    assert area == pytest.approx(abs(a1[0] * a2[1] - a1[1] * a2[0]))


@settings(max_examples=30)
@given(arrays(np.bool_, (4, 5)), st.sampled_from(CELLS))
def test_borders_are_closed(sites: NDArray[np.bool_], grid_and_n: tuple[SiteGrid, int]) -> None:
    grid, n = grid_and_n
    stretches = outline(sites, grid)
    assert (len(stretches) == n) == (sites.sum() == 1)
    ends = Counter((round(x, 6), round(y, 6)) for x, y in stretches.reshape(-1, 2).tolist())
    assert all(count % 2 == 0 for count in ends.values())


def test_a_logarithmic_axis_has_plain_numbers_below_one() -> None:
    axes = make_figure(4, 3).subplots()
    axes.set(xscale="log", xlim=(0.01, 3))
    show_plain_numbers(axes.xaxis)
    assert {"0.01", "0.1", "1"} <= {label.get_text() for label in axes.get_xticklabels()}
