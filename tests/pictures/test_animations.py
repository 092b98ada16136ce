"""Animations as the commands write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from PIL import Image

from labseq.pictures.animations import COLOURS
from tests.pictures.pixels import are_at, is_colour, on_lattice, spots

assert numba  # loaded already, so that no command turns compiling off for the tests after it

PLAN = ("plan", "random:7x7@0.6", "--seed=3", "--target={pattern: checkerboard, rows: 4, cols: 4}")


def test_a_gif_begins_with_the_atoms_before_and_ends_with_those_after(tmp_path: Path, call: Any) -> None:
    gif, saved = tmp_path / "plan.gif", tmp_path / "plan.json"
    assert call(*PLAN, "--animate", str(gif), "--json", str(saved))[0] == 0
    plan = json.loads(saved.read_text("utf-8"))
    with Image.open(gif) as image:
        n_frames = getattr(image, "n_frames", 1)
        frames = list[Any]()
        for index in (0, n_frames // 3, n_frames - 1):
            image.seek(index)
            frames.append(np.asarray(image.convert("RGB")).astype(np.int64)[:-75])  # without the key
    for pixels, name in ((frames[0], "occupancy"), (frames[-1], "predicted")):
        atoms = spots(is_colour(pixels, COLOURS["atom"]), least=50)
        assert are_at(atoms, on_lattice(np.argwhere(np.array(plan[name]))))
        assert not is_colour(pixels, COLOURS["move"]).any()
    assert is_colour(frames[1], COLOURS["move"]).any()
    assert n_frames > 40


def test_a_page_needs_no_matplotlib_and_says_what_a_gif_needs(
    tmp_path: Path, call: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labseq.pictures.figures.find_spec", lambda _: None)
    assert call(*PLAN, "--animate", str(tmp_path / "plan.html"))[0] == 0
    code, _, err = call(*PLAN, "--animate", str(tmp_path / "plan.gif"))
    assert (code, "needs matplotlib, which is not installed" in err) == (2, True)


def test_names_of_other_kinds_and_large_arrays_are_refused(tmp_path: Path, call: Any) -> None:
    code, _, err = call(*PLAN, "--animate", str(tmp_path / "plan.mp4"))
    assert (code, "expected a file that ends in .gif or .html" in err) == (2, True)
    code, _, err = call(PLAN[0], "random:2x129@0.5", PLAN[-1], "--animate", str(tmp_path / "plan.gif"))
    assert (code, "2 x 129 sites are too many for a picture" in err) == (2, True)
    assert not [*tmp_path.iterdir()]


def test_a_text_from_outside_stays_text(tmp_path: Path, call: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = "<b>&amp;.txt"
    (tmp_path / name).write_text("1 0\n0 0\n", "utf-8")
    code, _, err = call("plan", name, "--target={pattern: compact, rows: 1, cols: 1}", "--animate=a.html")
    assert code == 0, err
    assert "&lt;b&gt;&amp;amp;.txt" in (tmp_path / "a.html").read_text("utf-8")
