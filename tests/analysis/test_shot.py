"""The pictures of one shot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from labseq.analysis.shot import save_shot, shot_picture
from labseq.errors import ConfigError
from labseq.recording import Run

from .records import make_shot

Write = Callable[..., Run]


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


def test_frames_lie_under_the_sites(compact: Run, tmp_path: Path) -> None:
    save_shot(tmp_path / "shot.png", shot_picture(compact, 1, cycle=0))
    assert (tmp_path / "shot.png").read_bytes().startswith(b"\x89PNG")


def test_a_cycle_is_the_image_before_and_the_one_after_it(write: Write) -> None:
    panels = shot_picture(write([make_shot(0, n_cycles=2)]), 0, cycle=1).panels
    assert [panel.title.partition(":")[0] for panel in panels] == ["rearrange_cycle_0", "rearrange_cycle_1"]


def test_frames_of_another_size_than_the_sites_are_left_out(write: Write) -> None:
    drawing = shot_picture(write([make_shot(0, kept=True)]), 0)
    assert drawing.sites_px is None
    assert drawing.note.endswith("no frames: not of the sites' size")


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
        (2, None, "--shot: the run has no shot 2; expected one from 0 to 1"),
        (0, 1, "has no cycle 1; expected one from 0 to 0"),
        (1, 0, "has no cycle 0; expected a shot that rearranges"),
    ],
)
def test_what_is_not_there_is_told(write: Write, index: int, cycle: int | None, reported: str) -> None:
    run = write([make_shot(0), make_shot(1, n_cycles=0)])
    with pytest.raises(ConfigError, match=reported):
        shot_picture(run, index, cycle)
