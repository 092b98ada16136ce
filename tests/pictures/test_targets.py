"""Pictures of targets."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Literal

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

from labseq import ConfigError, SiteGrid, TargetPattern
from labseq.pictures.plans import FILL_LOOK, SITE_IN, TARGET_DPI as DPI, save_target, target_text

SITE_PX = SITE_IN * DPI
WHITE = (255, 255, 255)


def a_target() -> TargetPattern:
    fill = np.zeros((4, 6), np.bool_)
    clear = np.zeros((4, 6), np.bool_)
    fill[0, 0] = fill[2, 3] = fill[3, 5] = True
    clear[1, 1:4] = True
    return TargetPattern(fill, clear, "odd one")


def rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


@pytest.mark.parametrize("lattice", ["triangular", "square"])
@pytest.mark.parametrize("shear", [1, -1])
def test_atoms_are_where_the_camera_sees_them(
    tmp_path: Path, lattice: Literal["triangular", "square"], shear: Literal[1, -1]
) -> None:
    grid, target = SiteGrid(4, 6, lattice=lattice, shear=shear), a_target()
    save_target(tmp_path / "target.png", target, grid)
    with Image.open(tmp_path / "target.png") as opened:
        picture = opened.convert("RGB")
    places = grid.positions_m / grid.spacing_m * SITE_PX + (picture.width / 2, picture.height / 2)
    for fill, clear, (x, y) in zip(target.fill.flat, target.clear.flat, places.reshape(-1, 2), strict=True):
        pixel = picture.getpixel((int(x), int(y)))
        assert (pixel == rgb(FILL_LOOK.face)) == fill
        assert (pixel == WHITE) == clear


def test_a_picture_says_in_words_what_it_shows(tmp_path: Path) -> None:
    save_target(tmp_path / "target.png", a_target(), SiteGrid(4, 6))
    with Image.open(tmp_path / "target.png") as picture:
        assert picture.info["Title"] == "odd one"
        assert picture.info["Description"] == "#.....\n.ooo..\n...#..\n.....#"
        assert "Software" not in picture.info
    assert target_text(a_target()) == "#.....\n.ooo..\n...#..\n.....#"


def test_the_users_own_style_does_not_matter(tmp_path: Path) -> None:
    files = [tmp_path / "one.png", tmp_path / "two.png"]
    save_target(files[0], a_target(), SiteGrid(4, 6))
    with mpl.rc_context({"axes.facecolor": "black", "savefig.dpi": 30, "savefig.transparent": True}):
        save_target(files[1], a_target(), SiteGrid(4, 6))
    assert files[0].read_bytes() == files[1].read_bytes()


def test_a_target_of_another_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"the target has \(4, 6\) sites and the grid \(20, 20\)"):
        save_target(tmp_path / "target.png", a_target(), SiteGrid())


def test_a_picture_that_cannot_be_written_is_an_error_with_its_place(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none.target\.png: the picture cannot be written: No such file"):
        save_target(tmp_path / "none" / "target.png", a_target(), SiteGrid(4, 6))


def test_matplotlib_is_imported_only_to_draw() -> None:
    code = "import sys, labseq.pictures.plans; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
