"""What came of many shots, against numbers worked out by hand."""

from __future__ import annotations

import json
import math
import statistics as by_hand
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from labseq.analysis.statistics import statistics_of
from labseq.data.best import best_shot
from labseq.data.reader import Run, open_run
from labseq.model import CycleRecord, ImageRecord, Plan, PlanReport, ShotRecord
from labseq.model.estimate import Rate
from labseq.plain import to_plain
from labseq.recording.writer import RunWriter

from .records import make_run, make_shot

Defects = Sequence[int | None]
"""Empty target sites on the image of each cycle; None: full, but with an atom where none may be."""


@pytest.fixture
def of_defects() -> Callable[..., ShotRecord]:
    """Build a shot whose cycles leave so many defects; the k-th cycle moves k atoms in k batches of k + 1."""
    target = make_run().target

    def image(n_defects: int | None, cycle: int, t_start_s: float) -> ImageRecord:
        occupancy = target.fill.copy()
        if n_defects is None:
            occupancy |= target.clear
        else:
            occupancy[tuple(np.argwhere(target.fill)[:n_defects].T)] = False
        return ImageRecord(None, occupancy, np.ones(target.shape, np.float32), 2, cycle, t_start_s, 0.045)

    def cycle(k: int) -> CycleRecord:
        offsets = np.arange(k + 2, dtype=np.int32)
        plan = Plan(np.zeros((k + 1, 4), np.int16), offsets, np.zeros(k + 1, np.bool_))
        report = PlanReport(target.fill, np.arange(1.0, k + 2), np.ones(k + 1, np.int32), 0, 0)
        return CycleRecord(2, k - 1, plan, report, k, 0.06, 0.5, 0.01)

    def shot(index: int, cycles: Defects, last: int | None = None, **readings: float) -> ShotRecord:
        images = [image(4, -1, 0.5), *(image(d, k, 0.6 + 0.1 * k) for k, d in enumerate(cycles))]
        if last is not None:
            images.append(image(last, -1, 2.0))
        return make_shot(
            index,
            images=images,
            cycles=[cycle(k) for k in range(1, len(cycles) + 1)],
            success=last == 0,
            filling_fraction=math.nan if last is None else 1 - last / 6,
            seen_defect_free_cycle=cycles.index(0) if 0 in cycles else -1,
            readings={f"simulation.{name.replace('__', '.')}": value for name, value in readings.items()},
        )

    return shot


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Run]:
    """Write shots as a run, and read it back."""

    def record(*shots: ShotRecord) -> Run:
        writer = RunWriter.create(tmp_path, make_run())
        for shot in shots:
            writer.write_shot(shot)
        writer.finish("complete")
        return open_run(writer.run_dir)

    return record


def test_each_cycle_is_judged_on_its_own_image(of_defects: Any, recorded: Any) -> None:
    run = recorded(
        *(of_defects(i, one) for i, one in enumerate([(2, 0, 1), (1, 1, 0), (0, 0, 2), (3, 0, 0)]))
    )
    found = statistics_of(run.shots, run.target)
    assert [cycle.defect_free for cycle in found.cycles] == [Rate(1, 4), Rate(3, 4), Rate(2, 4)]
    assert [cycle.seen for cycle in found.cycles] == [Rate(1, 4), Rate(3, 4), Rate(4, 4)]
    written = json.loads(json.dumps(to_plain(found)))
    assert written["filling"] == {"mean": None, "error": None}
    assert written["cycles"][0]["defect_free"] == {
        "n": 1, "n_trials": 4, "rate": 0.25, "interval": [*Rate(1, 4).interval]
    }  # fmt: skip
    assert found.defect_free == Rate(0, 0)
    assert math.isnan(found.filling.value)
    assert found.seen == Rate(4, 4)
    assert found.cycles[2].defects == (2, 1, 1)
    assert found.defects == ()
    fillings = [1 - n / 6 for n in (2, 1, 0, 3)]
    assert found.cycles[0].filling.value == pytest.approx(by_hand.fmean(fillings))
    assert found.cycles[0].filling.error == pytest.approx(by_hand.stdev(fillings) / 2)
    assert [cycle.period_s.value for cycle in found.cycles] == pytest.approx([0.1, 0.1, 0.1])


def test_only_what_was_played_counts_as_moved(of_defects: Any, recorded: Any) -> None:
    run = recorded(of_defects(0, (2, 1)), of_defects(1, (2, 1)))
    found = statistics_of(run.shots, run.target)
    assert [cycle.n_batches.value for cycle in found.cycles] == [1, 2]
    assert [cycle.n_atom_moves.value for cycle in found.cycles] == [1, 2]
    assert [cycle.n_left_out.value for cycle in found.cycles] == [1, 1]
    assert found.too_short == Rate(2, 2)


def test_shots_that_ended_early_leave_later_cycles_to_the_others(of_defects: Any, recorded: Any) -> None:
    run = recorded(of_defects(0, (0,), last=1), of_defects(1, (2, 0), last=0), of_defects(2, (1, 1), last=3))
    found = statistics_of(run.shots, run.target)
    assert [(cycle.n_shots, cycle.defect_free) for cycle in found.cycles] == [
        (3, Rate(1, 3)),
        (2, Rate(1, 2)),
    ]
    assert [cycle.seen for cycle in found.cycles] == [Rate(1, 3), Rate(2, 3)]
    assert found.defect_free == Rate(1, 3)
    assert found.seen == Rate(2, 3)
    assert found.defects == (1, 1, 0, 1)


def test_the_best_shot_met_the_target_with_the_fewest_cycles(of_defects: Any, recorded: Any) -> None:
    nearly = [of_defects(0, (2,), last=2), of_defects(1, (1, 1), last=1), of_defects(2, (0,))]
    best = best_shot(recorded(*nearly))
    assert best is not None
    assert (best.shot, best.success, best.filling) == (1, False, pytest.approx(5 / 6))
    best = best_shot(recorded(*nearly, of_defects(3, (2, 0), last=0), of_defects(4, (0,), last=0)))
    assert best is not None
    assert (best.shot, best.success, best.n_cycles) == (4, True, 1)
    assert best_shot(recorded(of_defects(0, (0,)))) is None  # nothing was judged


def test_a_surplus_atom_is_no_success(of_defects: Any, recorded: Any) -> None:
    run = recorded(of_defects(0, (None,)))
    (cycle,) = statistics_of(run.shots, run.target).cycles
    assert cycle.defect_free == Rate(0, 1)
    assert (cycle.filling.value, cycle.defects) == (1.0, (1,))


def test_the_truth_of_a_simulation_is_told_where_it_is_known(of_defects: Any, recorded: Any) -> None:
    run = recorded(
        of_defects(0, (2,), last=1, lost__vacuum=3, lost__imaging=0, n_defects_true=2),
        of_defects(1, (2,), last=2, lost__vacuum=1, lost__imaging=0, n_defects_true=2),
        of_defects(2, (2,), last=0),
    )
    found = statistics_of(run.shots, run.target)
    assert {cause: loss.value for cause, loss in found.losses.items()} == {"vacuum": 2.0, "imaging": 0.0}
    assert found.losses["vacuum"].error == 1.0
    assert (found.defects_true.value, found.defects_seen.value) == (2.0, 1.5)
