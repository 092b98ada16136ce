from __future__ import annotations

import json
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from labseq.bench import latency
from labseq.bench.latency import (
    BETWEEN,
    HOST_STAGES,
    LatencyReport,
    LatencyRequest,
    measure_latency,
)
from labseq.cli import main
from labseq.errors import ConfigError

SMALL = LatencyRequest(Path(__file__).parents[2] / "sequences" / "compact_225.yaml", n_loadings=3)
SEQUENCE = str(SMALL.sequence)


def measure(*overrides: str, **options: Any) -> LatencyReport:
    return measure_latency(replace(SMALL, overrides=overrides, **options))


@pytest.fixture(scope="module", autouse=True)
def few_cold_loadings() -> Generator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(latency, "N_WARM", 1)
        yield


@pytest.fixture(scope="module")
def report() -> LatencyReport:
    return measure()


def test_the_stages_make_up_the_way_to_the_light(report: LatencyReport) -> None:
    assert [stage.name for stage in report.stages] == [*HOST_STAGES, BETWEEN]
    for stage in (*report.stages, report.total, report.start, report.light):
        assert 0.0 < stage.median_s <= stage.p99_s, stage.name
    assert report.light.median_s > report.total.median_s > max(s.median_s for s in report.stages[:4])
    assert (report.readout_s, report.delay_s, report.light.modelled_s) == (5e-3, 0.0, 0.0)
    assert len(report.light_s) == 3
    assert min(report.light_s) <= report.light_quantiles_s[0] <= max(report.light_s)


def test_the_report_names_what_was_measured(report: LatencyReport) -> None:
    assert (report.profile, report.planner, report.degree_of_parallelism) == ("virtual", "psca", 7)
    assert (report.device, report.mode, report.warnings) == ("virtual mobile tweezers", "", ())
    assert 25 < report.n_batches < 50
    assert report.playing_s > report.n_batches * 0.5e-3


def test_seed_and_settings_change_the_plans(report: LatencyReport) -> None:
    assert measure().playing_s == report.playing_s
    assert measure_latency(replace(SMALL, seed=2)).playing_s != report.playing_s
    parallel = measure("planner.degree_of_parallelism=15")
    assert parallel.degree_of_parallelism == 15
    assert parallel.n_batches < report.n_batches


@pytest.mark.parametrize(
    ("mode", "modelled"),
    [("replay", (1e-3, 5e-3)), ("sequence", (0.4e-3, 1e-3)), ("stream", (0.2e-3, 0.5e-3))],
)
def test_a_simulated_card_takes_modelled_time_too(mode: str, modelled: tuple[float, float]) -> None:
    settings = ("sample_rate=312 MHz", f"mode={mode}")
    overrides = [f"profile.mobile_tweezers.{one}" for one in settings]
    if mode != "replay":  # how long it is silent does not depend on how much is played
        overrides += ["target.rows=9", "target.cols=9", "planner.degree_of_parallelism=15"]
    report = measure(*overrides, profile="bench_awg", n_loadings=1)
    assert (report.device, report.mode) == ("M4i.6631-x8", mode)
    low_s, high_s = modelled  # the transfer, in sequence of the beginning; stream: the silence ahead
    assert low_s < report.light.modelled_s < high_s
    if mode == "replay":
        n_bytes = 4 * 312e6 * report.playing_s
        assert report.light.modelled_s == pytest.approx(n_bytes / 2.8e9, rel=0.1)
    assert report.delay_s <= report.light.modelled_s


def test_a_profile_whose_hardware_is_missing_is_measured_with_warnings() -> None:
    report = measure("profile.camera={use: cannon}")
    assert any("camera" in text for text in report.warnings)


def test_a_sequence_without_an_image_is_refused(tmp_path: Path) -> None:
    text = SMALL.sequence.read_text("utf-8")
    path = tmp_path / "blind.yaml"
    path.write_text(text[: text.index("shot:")] + "shot:\n  - load: {duration: 500 ms}\n", "utf-8")
    with pytest.raises(ConfigError, match=r"blind\.yaml:11:3: .*no image"):
        measure_latency(replace(SMALL, sequence=path))


def test_the_command_prints_a_table_and_writes_json_and_a_histogram(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, picture = tmp_path / "latency.json", tmp_path / "latency.png"
    options = ["--loadings", "2", "--seed", "3", "--json", str(path), "--picture", str(picture)]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["bench", "latency", SEQUENCE, *options])
    out, err = capsys.readouterr()
    table, notes = out.split("\n\n")
    _, *rows = table.splitlines()
    names = [*HOST_STAGES, BETWEEN, "frame to first samples", "start", "frame to light"]
    assert [row.split("  ")[0] for row in rows] == names
    assert "psca, degree of parallelism 7: " in notes
    progress = [line for line in err.splitlines() if not line.startswith("compiling")]
    assert progress == ["1 of 2 loadings", "2 of 2 loadings"]
    values = json.loads(path.read_text("utf-8"))
    assert (values["n_loadings"], values["seed"], values["profile"]) == (2, 3, "virtual")
    assert len(values["light_s"]) == 2
    assert picture.read_bytes().startswith(b"\x89PNG")


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
