"""Durations that hardware keeps, and those that the computer cannot: in `check`, a run, and its files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import labseq
from labseq.data.fits import fit_points
from labseq.data.points import scan_points
from labseq.session.check import check
from labseq.testing.fakes import RecordingObserver

from .whole_runs import SMALL_FRAMES

ROOT = Path(__file__).parents[2]
SHOT = """labseq: 1
name: free flight
shots: 1
target: {pattern: compact, rows: 15, cols: 15}
planner: {use: psca}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
"""
BY_HAND = """  - ramp: {depth: 0, duration: 10 us}
  - wait: {duration: WAIT}
  - ramp: {depth: 1, duration: 10 us}
  - image: {exposure: 45 ms}
"""
BY_HARDWARE = "  - release: {duration: 20 us}\n  - image: {exposure: 45 ms}\n"
BOX = "{use: ttl, channels: {traps_off: {channel: 7, on: [release], turns_off: static_tweezers}}}"
RADIO = (
    "{use: soapy, device: simulated, sample_rate: 40 MHz, row_frequency: {centre: 100 MHz, step: 1.6 MHz}, "
    "column_frequency: {centre: 100 MHz, step: 1.6 MHz}}"
)


def written(folder: Path, steps: str) -> Path:
    path = folder / "s.yaml"
    path.write_text(SHOT + steps, "utf-8")
    return path


@pytest.mark.parametrize("profile", ["lab", "bench", "virtual"])
def test_a_wait_that_the_computer_cannot_keep_is_refused(profile: str, tmp_path: Path) -> None:
    path = written(tmp_path, BY_HAND.replace("WAIT", "10 us"))
    options: dict[str, Any] = {"profile": profile, "dry_run": "fast" if profile == "lab" else "off"}
    with labseq.Session.open(path, output=tmp_path / "data", shots=1, **options) as session:
        for refused in (lambda: check(session), session.run):
            with pytest.raises(labseq.ConfigError) as caught:
                refused()
            (problem,) = caught.value.problems
            assert (problem.line, problem.column) == (10, 22)
            assert "10 us" in problem.what
            assert problem.expected == "at least 1 ms"
            assert "`release`" in problem.hint
            assert "'static_tweezers'" in problem.hint
    assert not (tmp_path / "data").exists()


def test_a_wait_that_is_kept_roughly_is_a_warning_of_check_and_run(tmp_path: Path) -> None:
    path, observer = written(tmp_path, BY_HAND.replace("WAIT", "5 ms")), RecordingObserver()
    with labseq.Session.open(path, profile="virtual", output=tmp_path, shots=1, observer=observer) as session:
        (warning,) = check(session).warnings
        session.run()
    assert "cannot time 5 ms exactly, so it may last about 1 ms longer" in str(warning)
    assert [values["text"] for values in observer.of("warning")] == [str(warning)]
    (late,) = check(labseq.Session.open(path, profile="lab")).warnings
    assert "about 31 ms longer, because 'ramp to 1' begins late at the outputs of 'static" in late.what
    on_a_line = ["profile.lines={use: ttl, channels: {push: {channel: 7, on: [wait]}}}"]
    timed = labseq.Session.open(path, profile="virtual", overrides=on_a_line)
    assert not check(timed).warnings


@pytest.mark.parametrize(
    ("override", "duration", "message"),
    [
        (f"profile.lines={BOX}", "4 us", "'lines' cannot release for 4 us; expected at least 5 us"),
        (f"profile.static_tweezers={RADIO}", "0.4 us", "'static_tweezers' cannot release for 400 ns"),
        (
            "profile.static_tweezers={use: slow}",
            "10 us",
            "a line with `on: [release]` and `turns_off: static",
        ),
    ],
)
def test_a_release_that_the_profile_cannot_make_is_refused(
    override: str, duration: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "slow.py").write_text(
        "from labseq.testing.fakes import RecordingStaticTweezers\nimport labseq\nLABSEQ_API = 1\n"
        "class Slow(RecordingStaticTweezers):\n    facts = labseq.plugin.TweezersFacts()\n"
        "@labseq.plugin.hookimpl\ndef labseq_register(registry):\n"
        "    registry.static_tweezers('slow', lambda settings, context: Slow(context))\n",
        "utf-8",
    )
    path = written(tmp_path, BY_HARDWARE.replace("20 us", duration) + "plugin_folders: [.]\n")
    with pytest.raises(labseq.ConfigError, match=r"s\.yaml:9:") as caught:
        check(labseq.Session.open(path, profile="virtual", overrides=[override]))
    assert message in str(caught.value)


def recaptured(path: Path, folder: Path, *overrides: str) -> tuple[float, labseq.Run]:
    """The fraction of atoms that a release leaves, and the run."""
    with labseq.Session.open(
        path,
        profile="virtual",
        shots=4,
        seed=3,
        output=folder,
        overrides=["record_frames=none", *SMALL_FRAMES, *overrides],
    ) as session:
        run = session.run()
    before = sum(np.count_nonzero(shot.occupancies[0]) for shot in run.shots)
    lost = sum(shot.readings["simulation.lost.release"] for shot in run.shots)
    return 1 - lost / before, run


def test_the_recaptured_fraction_follows_the_temperature_of_the_profile(tmp_path: Path) -> None:
    temperature_k = 30e-6  # that of the profile, 15 uK, is found in tests/analysis/test_quantities.py
    overrides = [f"profile.simulation.temperature={temperature_k} K", "repeats=1", "record_frames=none"]
    overrides += SMALL_FRAMES
    sequence = ROOT / "sequences" / "release_recapture.yaml"
    with labseq.Session.open(sequence, output=tmp_path, seed=2, overrides=overrides) as session:
        run = session.run()
    survival, points = run.quantity("survival:before,after"), scan_points(run)
    x = [point.parameters["shot.recapture.duration"] for point in points]
    y = [survival.over(point.shots) for point in points]
    light = {"static_depth": 300e-6, "static_waist": 0.98e-6, "static_wavelength": 808e-9}
    found = fit_points("release_recapture", x, y, ("s", "%"), settings=light).parameters["temperature"]
    assert abs(found.value - temperature_k) < 3 * found.error
    assert found.error < 0.06 * temperature_k


def test_the_box_and_the_radio_release_as_the_virtual_tweezers_do(tmp_path: Path) -> None:
    path, ways = (
        written(tmp_path, BY_HARDWARE.replace("20 us", "20.2 us")),
        {"virtual": [], "box": [f"lines={BOX}"]},
    )
    ways["radio"] = [f"static_tweezers={RADIO}"]
    kept = dict[str, float]()
    for way, overrides in ways.items():
        kept[way], run = recaptured(path, tmp_path, *(f"profile.{one}" for one in overrides))
        for shot in run.shots:
            (step,) = [step for step in shot.steps if step.name == "release"]
            assert step.timed_by == ("lines" if way == "box" else "static_tweezers")
            achieved_s = 20e-6 if way == "box" else 20.2e-6  # the box counts in steps of 0.5 us
            assert (step.planned_s, step.achieved_s) == pytest.approx((20.2e-6, achieved_s))
            after = np.count_nonzero(shot.occupancies[1])  # the light is on again
            assert after > 0.8 * kept[way] * np.count_nonzero(shot.occupancies[0])
    assert max(kept.values()) - min(kept.values()) < 0.06
    assert 0.6 < kept["virtual"] < 0.95
