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
from labseq.cli import main
from labseq.errors import ConfigError

SMALL = LatencyRequest(Path(__file__).parents[2] / "sequences" / "compact_225.yaml", n_loadings=3)
SEQUENCE = str(SMALL.sequence)


def measure(*overrides: str, profile: str | None = None) -> LatencyReport:
    return measure_latency(replace(SMALL, overrides=overrides, profile=profile))


@pytest.fixture(scope="module")
def report() -> LatencyReport:
    return measure()


def test_the_stages_make_up_the_total_and_the_way_to_the_light(report: LatencyReport) -> None:
    assert [stage.name for stage in report.stages] == [*HOST_STAGES, HAND_OVER, BETWEEN]
    for stage in (*report.stages, report.total, report.planned, report.prepare, report.start):
        assert 0.0 < stage.median_s <= stage.p99_s, stage.name
    assert report.total.median_s > report.planned.median_s > max(s.median_s for s in report.stages[:4])
    here_s = sum(stage.median_s for stage in (report.planned, report.prepare, report.start))
    assert (report.readout_s, report.trigger_s, report.prepare.modelled_s) == (5e-3, 0.0, 0.0)
    assert report.to_light_s == pytest.approx(report.readout_s + here_s)


def test_the_report_names_what_was_measured(report: LatencyReport) -> None:
    assert (report.profile, report.planner, report.degree_of_parallelism) == ("virtual", "psca", 7)
    assert (report.device, report.mode, report.warnings) == ("virtual mobile tweezers", "", ())
    assert report.sample_rate_hz == 624e6
    assert 25 < report.n_batches < 50
    assert report.playing_s > report.n_batches * 0.5e-3


def test_seed_and_settings_change_the_plans(report: LatencyReport) -> None:
    assert measure().playing_s == report.playing_s
    assert measure_latency(replace(SMALL, seed=2)).playing_s != report.playing_s
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


def test_a_profile_whose_hardware_is_missing_is_measured_with_warnings() -> None:
    report = measure("profile.camera={use: cannon}")
    assert any("camera" in text for text in report.warnings)


def test_tones_that_suit_no_sample_rate_get_a_common_one() -> None:
    steps = [
        f"profile.grid.{axis}_frequency.step={hz} Hz" for axis, hz in (("row", 1.6e6), ("column", 1618034))
    ]
    assert measure(*steps).sample_rate_hz == FALLBACK_RATE_HZ


def test_a_sequence_without_an_image_is_refused(tmp_path: Path) -> None:
    text = SMALL.sequence.read_text("utf-8")
    path = tmp_path / "blind.yaml"
    path.write_text(text[: text.index("shot:")] + "shot:\n  - load: {duration: 500 ms}\n", "utf-8")
    with pytest.raises(ConfigError, match=r"blind\.yaml:11:3: there is no image before"):
        measure_latency(replace(SMALL, sequence=path))


def test_the_command_prints_two_tables_and_writes_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "latency.json"
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["bench", "latency", SEQUENCE, "--loadings", "2", "--seed", "3", "--json", str(path)])
    out, err = capsys.readouterr()
    to_chunk, to_light, notes = out.split("\n\n")
    header, *rows = to_chunk.splitlines()
    assert header.split() == ["stage", "median", "99", "%", "share"]
    assert [row.split("  ")[0] for row in rows] == [
        *HOST_STAGES, HAND_OVER, BETWEEN, "frame to first chunk",
    ]  # fmt: skip
    assert rows[-1].endswith("100 %")
    assert [row.split("  ")[0] for row in to_light.splitlines()] == [
        *("to the light", "camera read-out", "frame to tone program", "prepare", "start", "trigger"),
        "end of exposure to light",
    ]
    assert "the goal is 2 ms" in notes
    assert "psca, degree of parallelism 7: " in notes
    progress = [line for line in err.splitlines() if not line.startswith("compiling")]
    assert progress == ["1 of 2 loadings", "2 of 2 loadings"]
    values = json.loads(path.read_text("utf-8"))
    assert (values["n_loadings"], values["seed"], values["profile"]) == (2, 3, "virtual")
    assert values["to_light_s"] > values["readout_s"] + values["planned"]["median_s"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.yaml"], "nowhere.yaml"),
        ([SEQUENCE, "--loadings", "0"], "--loadings"),
        ([SEQUENCE, "--set", "planner.degree_of_parallelism=0"], "degree_of_parallelism"),
        ([SEQUENCE, "--json", "nowhere/out.json"], "it cannot be written"),
        ([SEQUENCE, "--set", "profile.simulation.loading=0 %"], "there is nothing to move"),
    ],
)
def test_mistakes_end_with_a_message_and_no_table(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^2$"):
        main(["bench", "latency", *arguments])
    out, err = capsys.readouterr()
    assert words in err
    assert out == ""
    assert "Traceback" not in err
