"""Calibrations from the store of a profile to the devices, the record and every shot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.assembly.calibrations import open_store
from labseq.calibration_store import Store, read_entry
from labseq.errors import ConfigError
from labseq.model import CalibrationEntry, CalibrationKind, SiteGrid
from labseq.motion import correct_overlay
from labseq.testing.fakes import fake_calibration

from .small_runs import PROFILE

SEQUENCE = """labseq: 1
name: look
profile: bench
shots: 2
seed: 1
target: {pattern: compact, rows: 2, cols: 2}
planner: {use: psca}
record_frames: none
shot: [{load: {}}, {image: {}}]
"""

GRID = SiteGrid(6, 6)


class Bench:
    """A profile with a store, and a sequence."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.sequence = folder / "look.yaml"
        self.store = Store(folder / "calibrations" / "bench")
        self.sequence.write_text(SEQUENCE, "utf-8")
        self.write("")

    def write(self, text: str) -> None:
        (self.folder / "bench.yaml").write_text(PROFILE + text, "utf-8")

    def use(self, kind: CalibrationKind, grid: SiteGrid = GRID, **given: Any) -> CalibrationEntry:
        stored = self.store.add(fake_calibration(kind, grid, **given))
        self.store.use(stored, grid)
        return stored.entry

    def session(self, *overrides: str, **options: Any) -> labseq.Session:
        return labseq.Session.open(self.sequence, overrides=overrides, output=self.folder / "data", **options)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def shifted_hz(grid: SiteGrid) -> np.ndarray[Any, Any]:
    return grid.column_frequency_hz + 2e5


def test_frequencies_reach_every_role_but_the_simulation(bench: Bench) -> None:
    bench.use("frequencies", values={"column_hz": shifted_hz(GRID)})
    lab = bench.session().build_lab()
    assert {*lab.calibrations} == {"frequencies"}
    assert np.array_equal(lab.grid.column_frequency_hz, shifted_hz(GRID))
    bench.use("frequencies", values={"column_hz": GRID.column_frequency_hz + 8e5})  # half a site beside
    moves = ["shots=1", "target.rows=3", "target.cols=3"]
    moves.append("shot=[{load: {}}, {image: {}}, {rearrange: {cycles: 1, window: 60 ms}}]")
    n_defects = [
        bench.session(*moves, *overrides).run().shots[0].readings["simulation.n_defects_true"]
        for overrides in ((), ("profile.calibrations.use.frequencies=off",))
    ]
    assert n_defects[0] > n_defects[1] == 0, "the atoms are where they were without the calibration"


def test_an_overlay_counts_on_top_of_the_frequencies_that_it_was_measured_with(bench: Bench) -> None:
    frequencies = bench.use("frequencies", values={"column_hz": shifted_hz(GRID)})
    origin = {"calibrations": {"frequencies": frequencies.id}}
    bench.use("overlay", values={"offset_m": [1e-7, -2e-7]}, origin=origin)
    expected = correct_overlay(SiteGrid(6, 6, column_frequency_hz=shifted_hz(GRID)), [1e-7, -2e-7])
    grid = bench.session().assembly.hardware.grid
    assert np.array_equal(grid.column_frequency_hz, expected.column_frequency_hz)
    assert np.array_equal(grid.row_frequency_hz, expected.row_frequency_hz)


def test_an_overlay_of_other_frequencies_is_left_out_with_a_warning(bench: Bench) -> None:
    overlay = bench.use("overlay", values={"offset_m": [1e-7, 0.0]})
    bench.use("frequencies")
    assembly = bench.session().assembly
    assert {*assembly.hardware.calibrations} == {"frequencies"}
    assert (
        f"calibration overlay {overlay.id} is not used: it was measured with other frequencies"
        in assembly.warnings[0]
    )
    assert np.array_equal(assembly.hardware.grid.column_frequency_hz, GRID.column_frequency_hz)


def test_thresholds_of_other_sites_are_used_with_a_warning(bench: Bench) -> None:
    bench.use("thresholds")
    assert bench.session().assembly.warnings == ()
    bench.use(
        "thresholds", values={"thresholds": np.full((6, 6), 1700.0)}, origin={"calibrations": {"sites": "x"}}
    )
    assembly = bench.session().assembly
    assert {*assembly.hardware.calibrations} == {"thresholds"}
    assert "was measured with other sites" in assembly.warnings[0]


def test_the_ids_are_in_the_run_and_in_every_shot_and_the_entries_beside_it(bench: Bench) -> None:
    overlay = bench.use("overlay", values={"offset_m": [1e-7, 0.0]})
    run = bench.session().run()
    assert run.record["calibrations"] == {"overlay": overlay.id}
    assert [shot.calibrations for shot in run.shots] == [{"overlay": overlay.id}] * 2
    assert read_entry(run.path / "calibration_overlay.json").id == overlay.id
    table = run.record["resolved"]["profile"]["grid"]["column_frequency"]["table"]
    moved = correct_overlay(GRID, [1e-7, 0.0])
    assert table == moved.column_frequency_hz.tolist()
    assert run.record["resolved"]["profile"]["grid"]["row_frequency"]["table"] == []


def test_what_is_put_to_use_during_a_run_does_not_change_it(bench: Bench) -> None:
    old = bench.use("overlay", values={"offset_m": [1e-7, 0.0]})

    class Meddler:
        def event(self, name: str, values: Any) -> None:
            if name == "shot_finished":
                bench.use("overlay", values={"offset_m": [2e-7, 0.0]})

    run = bench.session(observer=Meddler()).run()
    assert [shot.calibrations["overlay"] for shot in run.shots] == [old.id] * 2
    assert bench.session().assembly.hardware.calibrations["overlay"].id != old.id


def test_calibrations_may_be_put_aside(bench: Bench) -> None:
    bench.use("overlay", values={"offset_m": [1e-7, 0.0]})
    assembly = bench.session("profile.calibrations.use.overlay=off").assembly
    assert not assembly.hardware.calibrations
    assert np.array_equal(assembly.hardware.grid.column_frequency_hz, GRID.column_frequency_hz)


def test_another_one_than_that_in_use_may_be_chosen(bench: Bench) -> None:
    old = bench.use("overlay", values={"offset_m": [1e-7, 0.0]})
    bench.use("overlay", values={"offset_m": [2e-7, 0.0]})
    bench.write(f"calibrations: {{use: {{overlay: {old.id[:6]}}}}}\n")
    assert bench.session().assembly.hardware.calibrations["overlay"].id == old.id
    bench.write("calibrations: {use: {overlay: abc}}\n")
    with pytest.raises(ConfigError, match="there is no calibration of overlay 'abc'") as caught:
        bench.session()
    (note,) = caught.value.problems[0].notes
    assert note.startswith("it is chosen by the key 'calibrations.use.overlay' of ")


def test_a_dry_run_of_a_real_lab_has_a_store_of_its_own(bench: Bench) -> None:
    path = bench.folder / "bench.yaml"
    path.write_text(PROFILE.replace("camera: {use: virtual}", "camera: {use: andor}"), "utf-8")
    real, rehearsed = (open_store(str(path), mode)[0].folder for mode in ("off", "full"))
    assert real == bench.folder / "calibrations" / "bench"
    assert rehearsed == real / "dry-run"


def test_one_of_another_grid_is_refused(bench: Bench) -> None:
    bench.use("overlay", SiteGrid(6, 7))
    with pytest.raises(ConfigError, match=r"is for another grid: 6 x 7 sites.*; expected 6 x 6 sites"):
        bench.session()


@pytest.mark.parametrize("kind", ["sites", "overlay"])
def test_a_damaged_one_that_is_in_use_is_refused(bench: Bench, kind: CalibrationKind) -> None:
    entry = bench.use(kind)
    path = bench.store.find(entry.id).path
    path.write_text("{", "utf-8")
    with pytest.raises(ConfigError, match="this file is damaged") as caught:
        bench.session()
    (problem,) = caught.value.problems
    assert problem.source == str(path)
    assert f"'labseq calibration use {kind}=off --profile " in problem.notes[0]
    assert "bench.yaml' turns it off" in problem.notes[0]


def test_a_tone_program_is_made_with_them(bench: Bench) -> None:
    plan = labseq.Plan.from_batches([([(0, 0)], [(0, 3)])])
    profile = bench.folder / "bench.yaml"
    before = labseq.tone_program(plan, profile=profile).tones_at(60e-6).column.frequency_hz
    bench.use("frequencies", values={"column_hz": shifted_hz(GRID)})
    after = labseq.tone_program(plan, profile=profile).tones_at(60e-6).column.frequency_hz
    assert after - before == pytest.approx([2e5])
