"""The figures of a run as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from labseq.analysis.paper import CyclesDrawing, ParallelismDrawing, save_cycles, save_parallelism
from labseq.errors import ConfigError
from labseq.pictures.figures import QUOTED, Series, check_place

NAN = np.full(3, np.nan)


def series(label: str, n: int = 10, top: float = 0.33, error: float = 0.02) -> Series:
    x = np.arange(1.0, n + 1)
    y = top * (1 - np.exp(-x))
    return Series(label, x, y, (y - error).clip(0.0), y + error)


def cycles(**changes: Any) -> CyclesDrawing:
    parts: dict[str, Any] = {
        "title": "figure 5",
        "note": "a run",
        "series": (series("400 shots"),),
        "defects": (np.array([130, 120, 80, 40, 0, 2]),),
        "quoted": series("Tian et al.", 2),
        "max_defect_free": series("max_defect_free", top=0.36, error=0.0),
    }
    return CyclesDrawing(**{**parts, **changes})


def parallelism(**changes: Any) -> ParallelismDrawing:
    parts: dict[str, Any] = {
        "title": "figure 4",
        "note": "a run",
        "fixed": (series("window 200 ms", 14),),
        "optimised": (series("windows 60 ms to 98 ms", 14),),
        "survival": series("survival", 14, error=0.0),
        "quoted": series("Tian et al.", 2),
    }
    return ParallelismDrawing(**{**parts, **changes})


def n_pixels(path: Path, colour: str) -> int:
    rgb = tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5))
    with Image.open(path) as image:
        return int((np.asarray(image.convert("RGB")) == rgb).all(axis=-1).sum())


@pytest.mark.parametrize(
    "drawing",
    [
        cycles(),
        cycles(series=(series("one"), series("other", 4)), defects=(np.array([1]), np.array([0, 3]))),
        cycles(quoted=None, max_defect_free=None),
        cycles(series=(series("one cycle", 1, error=0.0),), defects=(np.array([0, 0, 5]),)),
        cycles(title="50 $ a shot", note="$x$ \\alpha"),
    ],
)
def test_whatever_came_of_cycles_can_be_drawn(drawing: CyclesDrawing, tmp_path: Path) -> None:
    save_cycles(tmp_path / "figure.png", drawing)
    assert (n_pixels(tmp_path / "figure.png", QUOTED) > 0) is (drawing.quoted is not None)


@pytest.mark.parametrize(
    "drawing",
    [
        parallelism(),
        parallelism(optimised=(None,)),
        parallelism(fixed=(series("a"), None), optimised=(series("b"), series("c"))),
        parallelism(quoted=None),
        parallelism(fixed=(Series("a shot each", np.array([2.0, 7, 15]), np.full(3, 0.97), NAN, NAN),)),
        parallelism(survival=Series("flat", np.arange(2.0), np.ones(2), np.ones(2), np.ones(2))),
    ],
)
def test_whatever_came_of_the_degrees_of_parallelism_can_be_drawn(
    drawing: ParallelismDrawing, tmp_path: Path
) -> None:
    save_parallelism(tmp_path / "figure.png", drawing)
    assert (n_pixels(tmp_path / "figure.png", QUOTED) > 0) is (drawing.quoted is not None)


@pytest.mark.parametrize(("ending", "start"), [("png", b"\x89PNG"), ("SVG", b"<?xml"), ("pdf", b"%PDF")])
def test_the_ending_says_what_kind_of_picture(ending: str, start: bytes, tmp_path: Path) -> None:
    path = tmp_path / f"figure.{ending}"
    save_cycles(path, cycles())
    first = path.read_bytes()
    assert first.startswith(start)
    save_cycles(path, cycles())
    assert path.read_bytes() == first  # the same picture, the same bytes


def test_a_vector_picture_is_whole(tmp_path: Path) -> None:
    save_parallelism(tmp_path / "figure.svg", parallelism())
    assert ET.parse(tmp_path / "figure.svg").getroot().tag.endswith("svg")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("figure.gif", r"no name of a PNG or SVG or PDF file.*ends in \.png or \.svg or \.pdf"),
        ("nowhere/figure.png", "no such folder"),
        ("a_folder.png", "this is a folder"),
        ("f" * 300 + ".png", "no name of a file"),
    ],
)
def test_where_no_picture_can_go_is_told_before_it_is_drawn(name: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "a_folder.png").mkdir()
    with pytest.raises(ConfigError, match=f"(?s){told}"):
        check_place(tmp_path / name)
