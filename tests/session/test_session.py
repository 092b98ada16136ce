"""Whole runs in this process, on the virtual lab."""

from typing import Any

import h5py
import numpy as np
import pytest

import labseq
from labseq.errors import ConfigError
from labseq.testing.fakes import RecordingObserver

from .whole_runs import COMPACT, run


def contents(run):
    """Everything in the shots that must be the same for the same seed."""
    return [
        (
            shot.frames.tobytes(),
            shot.occupancies.tobytes(),
            [(plan.moves.tobytes(), plan.batch_offsets.tobytes()) for plan in shot.plans],
            shot.success,
        )
        for shot in run.shots
    ]


PATIENT = ["profile.timeouts.call=120 s"]
"""The first open() of a process imports a vendor's package, which takes long on a busy computer."""


@pytest.mark.parametrize(
    "options", [{}, {"profile": "lab", "dry_run": "full", "overrides": PATIENT}, {"dry_run": "fast"}]
)
def test_the_same_seed_gives_the_same_data(tmp_path, options):
    first = run(tmp_path, shots=1, seed=11, **options)
    again = run(tmp_path, shots=1, seed=11, **options)
    other = run(tmp_path, shots=1, seed=12, **options)
    assert contents(first) == contents(again)
    assert contents(first) != contents(other)
    assert first.path != again.path


def test_what_has_kernels_compiles_before_anything_is_opened(tmp_path, monkeypatch):
    from labseq_virtual import camera, tweezers as mobile_tweezers

    told: list[str] = []
    for driver in (camera.VirtualCamera, mobile_tweezers.VirtualMobileTweezers):
        driver_open = driver.open
        monkeypatch.setattr(driver, "warm", lambda self: told.append("warm"), raising=False)
        monkeypatch.setattr(driver, "open", lambda self, do=driver_open: (told.append("open"), do(self)))
    run(tmp_path, shots=1, seed=1)
    assert told == ["warm"] * 2 + ["open"] * 2


def test_a_run_reads_back(tmp_path):
    done = run(tmp_path, shots=2, seed=3)
    assert (done.status, len(done.shots), done.seed, done.simulated) == ("complete", 2, 3, True)
    shot = done.shots[0]
    assert shot.frames.shape[1:] == (512, 512)
    assert shot.occupancies.shape[1:] == (20, 20)
    assert len(shot.frames) == len(shot.occupancies) == len(shot.plans) + 2
    assert 0.9 < shot.filling_fraction <= 1.0
    assert {t.stage for t in shot.timing} >= {"expose", "detect", "plan", "check", "prepare", "play", "move"}
    assert shot.parameters == {"shots": "2", "seed": "3"}
    planner = done.record["resolved"]["planner"]
    assert (planner["use"], planner["degree_of_parallelism"], planner["variant"]) == ("psca", 7, "fewest")
    assert done.record["resolved"]["profile"]["mobile_tweezers"]["speed"] == 0.13
    assert done.record["devices"]["camera"]
    assert {p["name"] for p in done.record["plugins"]} == {"labseq_psca", "labseq_virtual", "labseq.builtin"}
    assert done.record["sequence_text"] == COMPACT.read_text(encoding="utf-8")
    assert "numpy" in done.record["provenance"]["packages"]
    assert not done.events[-1]["values"]["error"]


def test_a_shot_file_needs_no_labseq(tmp_path):
    done = run(tmp_path, shots=1, seed=3)
    with h5py.File(next((done.path / "shots").glob("*.h5"))) as file:
        entry: Any = file[file.attrs["default"]]
        view = entry[entry.attrs["default"]]
        assert view[view.attrs["signal"]].shape[1:] == (512, 512)


def test_nothing_is_over_budget_on_the_virtual_lab(tmp_path):
    done = run(tmp_path, shots=3, seed=4)
    assert [t for shot in done.shots for t in shot.timing if t.over_budget] == []


def test_values_can_be_set(tmp_path):
    options: dict[str, Any] = {
        "shots": 1,
        "overrides": [
            "planner.degree_of_parallelism=3",
            "shot.2.rearrange.window=200 ms",
            "profile.mobile_tweezers.speed=100 um/ms",
            "record_frames=last",
        ],
    }
    done = run(tmp_path, seed=1, **options)
    shot = done.shots[0]
    assert max(len(batch) for plan in shot.plans for batch in plan.batches) == 3
    assert shot.cycles[0].window_s == 0.2
    assert done.record["resolved"]["profile"]["mobile_tweezers"]["speed"] == pytest.approx(0.1)
    assert len(shot.frames) == 1
    assert shot.parameters["planner.degree_of_parallelism"] == "3"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["planer.use=psca"], "did you mean 'planner'"),
        (["planner.degree_of_parallelism=0"], "--set planner.degree_of_parallelism=0"),
        (["profile.camera.use=cannon"], "unknown camera 'cannon'"),
        (["target.rows=21"], "21"),
    ],
)
def test_wrong_values_are_refused_before_anything_opens(tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, overrides=overrides)
    assert not (tmp_path / "data").exists()


def test_all_problems_are_told_in_one_go(tmp_path):
    text = COMPACT.read_text(encoding="utf-8")
    text = (
        text.replace("rows: 15", "rows: 25").replace("psca", "pcsa").replace("window: 60 ms", "windw: 60 ms")
    )
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        run(tmp_path, wrong)
    assert len(caught.value.problems) == 3
    assert [p.line for p in caught.value.problems] == sorted(p.line for p in caught.value.problems)


def test_an_option_is_named_as_the_user_gave_it(tmp_path):
    with pytest.raises(ConfigError, match=r"--shots 0: shots is 0"):
        run(tmp_path, shots=0)


def test_a_session_runs_once(tmp_path):
    with labseq.Session.open(COMPACT, shots=1, output=tmp_path) as session:
        session.run()
        with pytest.raises(ConfigError, match="runs once"):
            session.run()


def test_without_a_seed_every_run_is_another(tmp_path):
    assert run(tmp_path, shots=1).seed != run(tmp_path, shots=1).seed


def test_a_missing_plugin_is_replaced_in_a_dry_run_with_a_warning(tmp_path):
    seen = RecordingObserver()
    run(tmp_path, observer=seen, shots=1, overrides=["profile.camera={use: cannon}"], dry_run="full")
    warnings = [v["text"] for v in seen.of("warning")]
    assert any("cannon" in w and "settings were not checked" in w for w in warnings)


def test_a_rehearsed_loss_of_frames_repeats_shots(tmp_path):
    options: dict[str, Any] = {"overrides": ["profile.camera.faults={transient: 0.05}", "attempts=50"]}
    done = run(tmp_path, shots=4, seed=2, **options)
    assert [s.index for s in done.shots] == [0, 1, 2, 3]
    assert done.attempts
    assert all("TransientError" in attempt.row["error"] for attempt in done.attempts)


def test_too_few_atoms_fill_what_can_be_filled_from_the_centre(tmp_path):
    options: dict[str, Any] = {
        "overrides": ["profile.simulation.loading=0.3", "shot.2.rearrange.window=500 ms"]
    }
    done = run(tmp_path, shots=1, seed=2, **options)
    shot = done.shots[0]
    loaded = shot.occupancies[0].sum()
    assert loaded < 225
    assert shot.row["n_missing_atoms"] == 225 - loaded
    first = shot.cycles[0]
    assert first.report.n_defects == 225 - loaded
    sites_m = labseq.SiteGrid().positions_m
    fill = done.target.fill
    from_centre_m = np.linalg.norm(sites_m - sites_m[fill].mean(axis=0), axis=-1)
    filled = fill & first.report.predicted
    assert from_centre_m[filled].max() <= from_centre_m[fill & ~filled].min() + 1e-9


def test_an_unwritable_place_is_named_before_anything_opens(tmp_path):
    (tmp_path / "data").write_text("a file, not a folder")
    seen = RecordingObserver()
    with pytest.raises(labseq.RecordingError, match="data"):
        run(tmp_path, shots=1, observer=seen)
    assert "state" not in seen.names


def test_a_disk_that_fills_up_stops_the_run_and_keeps_what_is_there(tmp_path, monkeypatch):
    from labseq.recording import RunWriter

    real, n_written = RunWriter.write_shot, 0

    def write(self, shot):
        nonlocal n_written
        if n_written == 2:
            raise labseq.RecordingError(self.run_dir, "no space left on device")
        n_written += 1
        return real(self, shot)

    monkeypatch.setattr(RunWriter, "write_shot", write)
    seen = RecordingObserver()
    with pytest.raises(labseq.RecordingError, match="no space left"):
        run(tmp_path, shots=5, seed=1, observer=seen)
    assert len(seen.of("safe_state")) == 4
    (state,) = (tmp_path / "data").glob("*/*/STATE")
    done = labseq.open_run(state.parent)
    assert (done.status, len(done.shots)) == ("failed", 2)
    assert done.shots[1].frames.size
