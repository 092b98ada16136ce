"""Whole runs in this process, on the virtual lab."""

import importlib.util
from typing import Any

import pytest

import labseq
from labseq.assembly.profile import resolve_profile
from labseq.errors import ConfigError
from labseq.testing.fakes import RecordingObserver

from .small_runs import write
from .whole_runs import COMPACT, SMALL_FRAMES, run


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


def test_the_same_seed_gives_the_same_data(tmp_path):
    first, again, other = (run(tmp_path, shots=1, seed=seed, overrides=SMALL_FRAMES) for seed in (11, 11, 12))
    assert contents(first) == contents(again)
    assert contents(first) != contents(other)
    assert first.path != again.path


def test_the_lab_in_a_dry_run_gives_the_same_data_for_the_same_seed(tmp_path):
    seen = RecordingObserver()
    few = ["profile.timeouts.call=120 s", "shot.2.rearrange.cycles=1"]  # the first open() imports a package
    few += ["profile.mobile_tweezers.sample_rate=312.5 MHz", "target.rows=6", "target.cols=6"]
    options: dict[str, Any] = {"profile": "lab", "dry_run": "full", "overrides": few, "shots": 1, "seed": 11}
    first, again = (run(tmp_path, observer=seen, **options) for _ in range(2))
    assert contents(first) == contents(again)
    assert first.simulated
    assert first.shots[0].frames.shape[1:] == (512, 512)
    assert not [values for values in seen.of("warning") if "virtual twin" in values["text"]]


def test_kernels_are_compiled_before_anything_is_opened(tmp_path, monkeypatch):
    from labseq_virtual import camera, tweezers

    calls: list[str] = []
    for driver in (camera.VirtualCamera, tweezers.VirtualMobileTweezers):
        driver_open = driver.open
        monkeypatch.setattr(driver, "warm", lambda self: calls.append("warm"), raising=False)
        monkeypatch.setattr(driver, "open", lambda self, do=driver_open: (calls.append("open"), do(self)))
    sequence = write(tmp_path)
    assert run(tmp_path, sequence, shots=1).seed != run(tmp_path, sequence, shots=1).seed
    assert calls == (["warm"] * 4 + ["open"] * 2) * 2  # the check warms devices of its own


def test_a_run_reads_back(tmp_path):
    done = run(tmp_path, shots=2, seed=3)
    assert (done.status, len(done.shots), done.seed, done.simulated) == ("complete", 2, 3, True)
    shot = done.shots[0]
    assert shot.frames.shape[1:] == (512, 512)
    assert shot.occupancies.shape[1:] == (20, 20)
    assert len(shot.frames) == len(shot.occupancies) == len(shot.plans) + 2
    assert 0.9 < shot.filling_fraction <= 1.0
    assert {t.stage for t in shot.timing} >= {"expose", "detect", "plan", "check", "prepare", "play", "move"}
    assert [t for shot in done.shots for t in shot.timing if t.over_budget] == []
    assert shot.parameters == {"shots": 2, "seed": 3}
    planner = done.record["resolved"]["planner"]
    assert (planner["use"], planner["degree_of_parallelism"], planner["variant"]) == ("psca", 7, "fewest")
    assert done.record["devices"]["camera"]
    assert {p["name"] for p in done.record["plugins"]} == {"labseq_psca", "labseq_virtual", "labseq.builtin"}
    assert done.record["sequence_text"] == COMPACT.read_text(encoding="utf-8")
    assert "numpy" in done.record["provenance"]["packages"]
    assert not done.events[-1]["values"]["error"]


def test_values_can_be_set(tmp_path):
    changes = {
        "planner.degree_of_parallelism": "3",
        "shot.2.rearrange.window": "200 ms",
        "profile.mobile_tweezers.speed": "100 um/ms",
        "record_frames": "last",
    }
    done = run(tmp_path, seed=1, shots=1, overrides=[f"{key}={value}" for key, value in changes.items()])
    shot = done.shots[0]
    assert max(len(batch) for plan in shot.plans for batch in plan.batches) == 3
    assert shot.cycles[0].window_s == 0.2
    assert done.record["resolved"]["profile"]["mobile_tweezers"]["speed"] == pytest.approx(0.1)
    assert len(shot.frames) == 1
    values = [3, 0.2, pytest.approx(0.1), "last", 1, 1]
    assert shot.parameters == dict(zip((*changes, "shots", "seed"), values, strict=True))


@pytest.mark.parametrize(
    ("override", "message"),
    [("planner.degree_of_parallelism=0", "--set planner.degree_of_parallelism=0"), ("target.rows=21", "21")],
)
def test_a_wrong_value_is_refused_before_anything_opens(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        run(tmp_path, overrides=[override])
    assert not (tmp_path / "data").exists()


def test_a_session_runs_once(tmp_path):
    with labseq.Session.open(write(tmp_path), shots=1, output=tmp_path) as session:
        session.run()
        with pytest.raises(ConfigError, match="runs once"):
            session.run()


def test_a_missing_plugin_is_replaced_in_a_dry_run_with_a_warning(tmp_path):
    seen = RecordingObserver()
    options: dict[str, Any] = {"overrides": ["profile.camera={use: cannon}"], "dry_run": "full"}
    run(tmp_path, write(tmp_path), seen, shots=1, **options)
    warnings = [v["text"] for v in seen.of("warning")]
    assert any("cannon" in w and "settings were not checked" in w for w in warnings)


def test_a_dry_run_needs_no_vendors_package(monkeypatch):
    missing = {"mobile_tweezers": "spcm_core"}
    find = importlib.util.find_spec
    find_some = lambda name: None if name in missing.values() else find(name)  # noqa: E731
    monkeypatch.setattr("labseq.messages.find_spec", find_some)
    lab = resolve_profile("lab", dry_run="full")
    for role, package in missing.items():
        assert lab.chosen[role].entry.name == "virtual"
        assert any(role in text and package in text and "virtual twin" in text for text in lab.warnings)


def test_a_rehearsed_loss_of_frames_repeats_shots(tmp_path):
    options: dict[str, Any] = {"overrides": ["profile.camera.faults={transient: 0.2}", "attempts=50"]}
    done = run(tmp_path, write(tmp_path), shots=4, seed=2, **options)
    assert [s.index for s in done.shots] == [0, 1, 2, 3]
    assert done.attempts
    assert all("TransientError" in attempt.row.error for attempt in done.attempts)


def test_an_unwritable_place_is_named_before_anything_opens(tmp_path):
    (tmp_path / "data").write_text("a file, not a folder")
    seen = RecordingObserver()
    with pytest.raises(labseq.RecordingError, match="data"):
        run(tmp_path, write(tmp_path), seen, shots=1)
    assert "state" not in seen.names
