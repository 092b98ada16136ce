"""The pictures of one shot."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numba
import numpy as np
import pytest

from labseq.analysis.plotting import PlotRequest, plot_run
from labseq.analysis.shot import DPI, ShotDrawing, ShotPanel, save_shot, shot_picture
from labseq.data.reader import Run
from labseq.errors import ConfigError
from labseq.model import SiteGrid, TargetPattern
from labseq.pictures.figures import HEAD_IN
from labseq.pictures.plans import ATOM_LOOK
from tests.pictures.pixels import are_at, decoded, is_colour, on_lattice, spots

from .records import SHAPE, Write, image, make_shot, target

assert numba  # loaded already, so that no animation turns compiling off for the tests after it


def test_every_image_has_a_panel_with_the_moves_that_followed(compact: Run) -> None:
    drawing = shot_picture(compact, 0)
    shot = compact.shots[0]
    assert len(drawing.panels) == len(shot.occupancies)
    assert [len(panel.moves) for panel in drawing.panels] == [
        *(cycle.plan.batch_offsets[cycle.n_batches_played] for cycle in shot.cycles),
        0,
        0,
    ]
    assert drawing.panels[0].title.endswith("batches")
    assert drawing.panels[1].title.startswith("rearrange_cycle_0: ")
    assert drawing.sites_px is not None
    assert drawing.sites_px.shape == (20, 20, 2)


def test_atoms_are_drawn_on_their_sites(write: Write, tmp_path: Path) -> None:
    atoms = target().fill.copy()
    atoms[1, 1], atoms[3, 4] = False, True
    run = write([make_shot(0, n_cycles=0, images=[image(atoms, 1, -1, 0.5)])])
    save_shot(tmp_path / "shot.png", shot_picture(run, 0))
    pixels = decoded((tmp_path / "shot.png").read_bytes(), "RGB")[int(HEAD_IN * DPI) :]
    on_target = spots(is_colour(pixels, ATOM_LOOK.face), least=300)  # those of the key are smaller
    assert are_at(on_target, on_lattice(np.argwhere(atoms & target().fill)))


def test_a_frame_lies_under_its_sites_however_the_camera_is_turned(tmp_path: Path) -> None:
    """The camera sees rows from right to left, and columns downwards."""
    grid = SiteGrid(*SHAPE, lattice="square")
    rows, cols = np.indices(SHAPE)
    sites_px = np.stack([20 * cols + 15, 95 - 20 * rows], axis=-1).astype(np.float64)
    lit = [(0, 1), (1, 3), (3, 0)]
    frame = np.full((110, 120), 100, np.uint16)
    frame[:6, :6] = 1000
    for y, x in sites_px[tuple(np.transpose(lit))].astype(int):
        frame[y - 3 : y + 4, x - 3 : x + 4] = 550
    nothing = np.zeros(SHAPE, np.bool_)
    panel = ShotPanel("image", nothing, frame, np.empty((0, 4), np.int16), np.empty(0, np.int64))
    save_shot(
        tmp_path / "shot.png",
        ShotDrawing("", "", grid, TargetPattern(nothing, nothing), sites_px, (panel,)),
    )
    pixels = decoded((tmp_path / "shot.png").read_bytes(), "RGB")[int(HEAD_IN * DPI) :]
    assert are_at(spots(is_colour(pixels, "0.5"), least=100), [(col, row) for row, col in lit])


def test_a_cycle_is_the_image_before_and_the_one_after_it(write: Write) -> None:
    panels = shot_picture(write([make_shot(0, n_cycles=2)]), 0, cycle=1).panels
    assert [panel.title.partition(":")[0] for panel in panels] == ["rearrange_cycle_0", "rearrange_cycle_1"]


def test_frames_of_another_size_than_the_sites_are_left_out(write: Write) -> None:
    drawing = shot_picture(write([make_shot(0, kept=True)]), 0)
    assert drawing.sites_px is None
    assert drawing.note.endswith("no frames: their size does not fit the sites")


def test_an_interrupted_shot_is_shown_as_far_as_it_came(write: Write) -> None:
    whole = make_shot(0)
    broken = make_shot(0, images=whole.images[:1], status="interrupted", error="StopRequested: enough")
    drawing = shot_picture(write([broken], status="stopped"), 0)
    assert drawing.title == "shot 0, interrupted: StopRequested: enough"
    (panel,) = drawing.panels
    assert panel.title.endswith("then 1 move in 1 batch")


@pytest.mark.parametrize(
    ("index", "cycle", "reported"),
    [
        (2, None, "--shot: the run has no shot 2; expected a shot from 0 to 1"),
        (0, 1, "has no cycle 1; expected a cycle from 0 to 0"),
        (1, 0, "has no cycle 0; expected a shot that rearranges"),
    ],
)
def test_what_is_not_there_is_told(write: Write, index: int, cycle: int | None, reported: str) -> None:
    run = write([make_shot(0), make_shot(1, n_cycles=0)])
    with pytest.raises(ConfigError, match=reported):
        shot_picture(run, index, cycle)


def test_a_cycle_of_a_recorded_shot_is_animated(compact: Run, tmp_path: Path) -> None:
    page = tmp_path / "shot.html"
    plot_run(compact.path, PlotRequest(shot=1, cycle=0), page)
    cycle = compact.shots[1].cycles[0]
    scene = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page.read_text("utf-8"))
    assert scene is not None
    assert len(json.loads(scene[1])["batches"]) == cycle.n_batches_played
    for number, reported in (
        (None, r"shot 1 has \d+ cycles.*expected --cycle with a number from 0 to"),
        (99, "has no cycle 99; expected a cycle from 0 to"),
    ):
        with pytest.raises(ConfigError, match=reported):
            plot_run(compact.path, PlotRequest(shot=1, cycle=number), tmp_path / "other.gif")
    with pytest.raises(ConfigError, match=r"an animation shows one cycle of a shot; expected --shot N"):
        plot_run(compact.path, PlotRequest(), tmp_path / "overview.gif")
