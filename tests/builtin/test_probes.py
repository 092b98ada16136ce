"""The step that holds atoms in place, on fakes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.builtin.probes import ProbeSettings, ProbeStep
from labseq.builtin.steps import ImageSettings, ImageStep
from labseq.errors import ConfigError, LimitError
from labseq.model import MotionSpec, SegmentKind, SiteGrid, ToneProgram
from labseq.roles import StepContext
from labseq.sequencer.run import Sequencer
from labseq.testing.fakes import FakeLab, ListSink, RecordingObserver, fake_lab

GRID = SiteGrid(4, 6)
SEEN = np.array([[1, 0, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 1]], np.bool_)


def run(step: ProbeStep, lab: FakeLab, *, before: bool = True) -> ListSink:
    image = ("image", ImageStep(ImageSettings(exposure=0.045)))
    steps = [*([image] if before else []), ("probe", step)]
    sink = ListSink()
    sequencer = Sequencer(lab, steps, lab.stop, sink, RecordingObserver(), seed=1)
    try:
        sequencer.open()
        sequencer.take(0)
    finally:
        sequencer.shut_down()
    return sink


def played(lab: FakeLab) -> list[ToneProgram]:
    return [call.args[0] for call in lab.calls.of("mobile_tweezers.prepare")]


def held(program: ToneProgram) -> dict[tuple[int, int], tuple[float, float]]:
    """Site -> where its tweezer is beside it, along a1 and a2, in metres."""
    found: dict[tuple[int, int], tuple[float, float]] = {}
    for segment in np.flatnonzero(program.kind == SegmentKind.TRANSPORT):
        rows, cols = (
            (axis.start_hz[slice(*axis.offsets[segment : segment + 2])] - hz[0]) / 1.6e6
            for axis, hz in ((program.row, GRID.row_frequency_hz), (program.column, GRID.column_frequency_hz))
        )
        for row in rows:
            for col in cols:
                site = round(row), round(col)
                assert site not in found
                found[site] = (col - site[1]) * GRID.spacing_m, (row - site[0]) * GRID.spacing_m
    return found


def sites(mask: NDArray[np.bool_]) -> set[tuple[int, int]]:
    return {(int(row), int(col)) for row, col in np.argwhere(mask)}


def test_the_atoms_that_were_seen_are_held_beside_their_sites() -> None:
    lab = fake_lab([SEEN], grid=GRID)
    (shot,) = run(ProbeStep(ProbeSettings(offset=(0.3e-6, -0.2e-6), hold=1e-3)), lab).shots
    assert len(shot.images) == 1
    (program,) = played(lab)
    found = held(program)
    assert found.keys() == sites(SEEN)
    assert np.array(list(found.values())) == pytest.approx(np.tile([0.3e-6, -0.2e-6], (len(found), 1)))
    assert set(program.duration_s[program.kind == SegmentKind.TRANSPORT]) == {1e-3}
    assert lab.calls.names("mobile_tweezers")[1:4] == [
        "mobile_tweezers.prepare",
        "mobile_tweezers.play",
        "mobile_tweezers.wait",
    ]


@pytest.mark.parametrize(("which", "n_programs"), [("all", 1), ("seen", 0)])
def test_without_atoms_seen_only_all_sites_are_held(which: Any, n_programs: int) -> None:
    lab = fake_lab([np.zeros(GRID.shape, np.bool_)], grid=GRID)
    run(ProbeStep(ProbeSettings(sites=which)), lab)
    assert len(played(lab)) == n_programs
    for program in played(lab):
        assert held(program).keys() == sites(np.ones(GRID.shape, np.bool_))


def test_a_cross_goes_four_ways() -> None:
    lab = fake_lab([np.ones(GRID.shape, np.bool_)], grid=GRID)
    run(ProbeStep(ProbeSettings(offset=(0.9e-6, 0.8e-6), pattern="cross")), lab)
    found = held(played(lab)[0])
    for site, offset in {
        (0, 0): (0.9e-6, 0.0),
        (2, 3): (-0.9e-6, 0.0),
        (1, 2): (0.0, 0.8e-6),
        (3, 5): (0.0, -0.8e-6),
    }.items():
        assert found[site] == pytest.approx(offset, abs=1e-12)


def test_an_image_is_needed() -> None:
    with pytest.raises(ConfigError, match="probe needs an image before it"):
        run(ProbeStep(ProbeSettings()), fake_lab([SEEN], grid=GRID), before=False)


@pytest.mark.parametrize(("which", "least"), [("seen", 0.0), ("all", 1.0)])
def test_the_timeline_is_that_of_all_sites(which: Any, least: float) -> None:
    lab = fake_lab([np.ones(GRID.shape, np.bool_)], grid=GRID)
    step = ProbeStep(ProbeSettings(offset=(0.1e-6, 0.0), sites=which))
    (bar,) = step.plan_timeline(lab.step_context)
    assert bar.duration_s == pytest.approx(13e-3 + 4 * (60e-6 + 0.2e-3 + 5e-6))
    assert bar.min_duration_s == least * bar.duration_s
    sink = run(step, lab)
    (took,) = [t for t in sink.shots[0].timing if t.stage == "step_1_probe"]
    assert took.duration_s == pytest.approx(bar.duration_s)


def test_an_offset_out_of_the_band_is_refused_before_anything_plays() -> None:
    step = ProbeStep(ProbeSettings(offset=(60e-6, 0.0)))
    lab = fake_lab([SEEN], grid=GRID)
    with pytest.raises(LimitError, match=r"column 1 at an offset of 60 um is 11.* MHz"):
        step.plan_timeline(StepContext(GRID, MotionSpec(), lab.target))
