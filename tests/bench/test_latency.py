from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from labseq.bench.latency import (
    BETWEEN,
    FALLBACK_RATE_HZ,
    HAND_OVER,
    HOST_STAGES,
    LatencyReport,
    LatencyRequest,
    measure_latency,
)
from labseq.errors import ConfigError

ROOT = Path(__file__).parents[2]
SMALL = LatencyRequest(ROOT / "sequences" / "compact_225.yaml", n_loadings=3)


def measure(*overrides: str, profile: str | None = None) -> LatencyReport:
    return measure_latency(replace(SMALL, overrides=overrides, profile=profile))


@pytest.fixture(scope="module")
def report() -> LatencyReport:
    return measure()


def test_every_stage_is_listed_and_they_make_up_the_total(report: LatencyReport) -> None:
    assert [stage.name for stage in report.stages] == [*HOST_STAGES, HAND_OVER, BETWEEN]
    for stage in (*report.stages, report.total, report.planned, report.prepare, report.start):
        assert 0.0 < stage.median_s <= stage.p99_s, stage.name
    assert report.total.median_s > report.planned.median_s > max(s.median_s for s in report.stages[:4])


def test_the_way_to_the_light_adds_up(report: LatencyReport) -> None:
    here_s = sum(stage.median_s for stage in (report.planned, report.prepare, report.start))
    assert (report.readout_s, report.trigger_s, report.prepare.modelled_s) == (5e-3, 0.0, 0.0)
    assert report.to_light_s == pytest.approx(report.readout_s + here_s)


def test_what_was_measured_is_told(report: LatencyReport) -> None:
    assert (report.profile, report.planner, report.degree_of_parallelism) == ("virtual", "psca", 7)
    assert (report.device, report.mode, report.warnings) == ("virtual mobile tweezers", "", ())
    assert report.sample_rate_hz == 624e6
    assert 25 < report.n_batches < 50
    assert report.playing_s > report.n_batches * 0.5e-3
    values = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert [stage["name"] for stage in values["stages"]] == [stage.name for stage in report.stages]
    assert values["to_light_s"] == report.to_light_s


def test_the_same_seed_gives_the_same_loadings(report: LatencyReport) -> None:
    assert measure().playing_s == report.playing_s
    assert measure_latency(replace(SMALL, seed=2)).playing_s != report.playing_s


def test_a_higher_degree_of_parallelism_makes_fewer_batches(report: LatencyReport) -> None:
    parallel = measure("planner.degree_of_parallelism=15")
    assert parallel.degree_of_parallelism == 15
    assert parallel.n_batches < report.n_batches


def test_a_simulated_card_takes_modelled_time_too() -> None:
    report = measure("profile.mobile_tweezers.sample_rate=400 MHz", profile="bench_awg")
    assert (report.device, report.mode, report.sample_rate_hz) == ("M4i.6631-x8", "replay", 400e6)
    n_bytes = 4 * 400e6 * report.playing_s
    assert report.prepare.modelled_s == pytest.approx(n_bytes / 2.8e9, rel=0.1)
    assert 0.0 < report.trigger_s < 10e-6
    assert report.to_light_s > report.prepare.modelled_s + report.readout_s


def test_a_profile_whose_hardware_is_not_there_is_measured_with_warnings() -> None:
    report = measure("profile.camera={use: cannon}")
    assert any("camera" in text for text in report.warnings)


def test_tones_that_suit_no_sample_rate_get_a_common_one() -> None:
    steps = [
        f"profile.grid.{axis}_frequency.step={hz} Hz" for axis, hz in (("row", 1.6e6), ("column", 1618034))
    ]
    assert measure(*steps).sample_rate_hz == FALLBACK_RATE_HZ


def test_progress_is_told_up_to_the_end() -> None:
    seen: list[tuple[int, int]] = []
    measure_latency(SMALL, progress=lambda done, wanted: seen.append((done, wanted)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_a_sequence_without_an_image_is_refused(tmp_path: Path) -> None:
    text = SMALL.sequence.read_text("utf-8")
    path = tmp_path / "blind.yaml"
    path.write_text(text[: text.index("shot:")] + "shot:\n  - load: {duration: 500 ms}\n", "utf-8")
    with pytest.raises(ConfigError, match=r"blind\.yaml:11:3: there is no image before"):
        measure_latency(replace(SMALL, sequence=path))


def test_a_target_that_needs_no_moves_is_refused() -> None:
    with pytest.raises(ConfigError, match="there is nothing to move"):
        measure("profile.simulation.loading=0 %")
