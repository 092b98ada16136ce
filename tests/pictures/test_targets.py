from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from PIL import Image

from labseq.model import SiteGrid, TargetPattern
from labseq.pictures.targets import DPI, FILL_LOOK, SITE_IN, save_target

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


def test_a_file_holds_the_target_as_text(tmp_path: Path) -> None:
    save_target(tmp_path / "target.png", a_target(), SiteGrid(4, 6))
    with Image.open(tmp_path / "target.png") as picture:
        assert picture.info["Title"] == "odd one"
        assert picture.info["Description"] == "#.....\n.ooo..\n...#..\n.....#"
        assert "Software" not in picture.info
