from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from labseq.assembly.planning import PlanRequest
from labseq.messages import install_hint
from labseq.plans.waveform import PlannedWaveform, WaveformRequest, plan_waveform
from labseq.plans.waveform_report import WaveformOutput, WaveformReport, note, show_waveform, title

assert numba  # loaded already, so that a command does not turn compiling off for the tests after it

REQUEST = WaveformRequest(
    PlanRequest("random:6x6@0.7", "{pattern: checkerboard, rows: 4, cols: 4}", seed=3), None, "250 MHz"
)
WORDS = [
    "random:6x6@0.7",
    "--seed",
    "3",
    "--target",
    "{pattern: checkerboard, rows: 4, cols: 4}",
    "--sample-rate",
    "250 MHz",
]


@pytest.fixture(scope="module")
def made() -> PlannedWaveform:
    return plan_waveform(REQUEST)


def test_the_report_reports_what_is_played(made: PlannedWaveform) -> None:
    lines = WaveformReport.of(made).as_text()
    n = made.moves.plan.n_batches
    assert all(fact in lines[0] for fact in ("random:6x6@0.7", "seed 3", "27 atoms on 6 x 6 sites"))
    assert f"batches    {n}" in lines
    assert any(line.startswith("samples    ") and " per channel at 250 MHz, " in line for line in lines)
    (crest,) = (line for line in lines if line.startswith("crest factor"))
    assert all(f"{axis.crest_factor:.2f}" in crest for axis in made.statistics())
    assert any("(limit 2 V)" in line for line in lines)
    assert lines[-1].count("comb ") == 2


def test_some_batches_are_named_in_report_and_title() -> None:
    made = plan_waveform(WaveformRequest(REQUEST.plan, "1-2", REQUEST.sample_rate))
    n = made.moves.plan.n_batches
    report = WaveformReport.of(made)
    assert all(f"1 to 2 (2 of {n})" in text for text in (title(report), "\n".join(report.as_text())))


def test_samples_that_are_all_zero_have_no_crest_factor(tmp_path: Path) -> None:
    faint = [f"profile.mobile_tweezers.rf.row_amplitudes={[1e-9] * 20}"]
    plan = PlanRequest(
        "random:20x20@0.75",
        "{pattern: compact, rows: 3, cols: 3}",
        seed=1,
        profile="virtual",
        overrides=faint,
    )
    request = WaveformRequest(plan, "0", "250 MHz")
    made = plan_waveform(request)
    row, column = made.statistics()
    assert (row.crest_factor, row.peak_v, row.mean_power_w) == (None, 0.0, 0.0)
    assert column.crest_factor is not None
    assert "crest factor -," in note(row)
    show_waveform(request, WaveformOutput(str(tmp_path / "a.json"), tmp_path / "a.png"))
    assert json.loads((tmp_path / "a.json").read_text("utf-8"))["row"]["crest_factor"] is None


def test_everything_can_be_written_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = WaveformOutput(str(tmp_path / "a.json"), tmp_path / "a.png", tmp_path / "a.npz")
    show_waveform(REQUEST, output)
    out, err = capsys.readouterr()
    assert "crest factor" in out
    assert err == ""
    document = json.loads((tmp_path / "a.json").read_text("utf-8"))
    assert list(document)[-2:] == ["row", "column"]
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with np.load(tmp_path / "a.npz") as file:
        assert file["samples"].shape == (2, document["n_samples"])
        largest = np.abs(file["samples"]).max(axis=1) * file["volts_per_sample"]
    assert largest.tolist() == pytest.approx([document["row"]["peak_v"], document["column"]["peak_v"]])


def test_the_command_passes_every_option_on(monkeypatch: pytest.MonkeyPatch, call: Any) -> None:
    got: list[Any] = []
    monkeypatch.setattr(
        "labseq.plans.waveform_report.show_waveform", lambda *arguments: got.extend(arguments)
    )
    planned = [
        "--target",
        "{pattern: a, rows: 3, cols: 3}",
        "--origin",
        "-1,2",
        "--planner",
        "p",
        "--dop",
        "4",
        "--set",
        "a=1",
    ]
    rest = ["--seed", "5", "-p", "lab", "--batches", "1-3", "--sample-rate", "5 MHz"]
    files = ["--json", "-", "--png", "x.png", "--npz", "x.npz"]
    assert call("waveform", "-", *planned, *rest, *files)[0] == 0
    request = PlanRequest("-", "{pattern: a, rows: 3, cols: 3}", "p", 4, ("a=1",), 5, "-1,2", "lab")
    output = WaveformOutput(json="-", png=Path("x.png"), npz=Path("x.npz"))
    assert got == [WaveformRequest(request, "1-3", "5 MHz"), output]


BAD = [
    (["gone.json"], "gone.json: there is no such file; did you mean 'one.json'?"),
    (["one.json"], "one.json: this is not a plan; expected what 'labseq plan --json' writes"),
    (["half.json"], "half.json:1:13: this is not JSON: expecting value"),
    (["random:6x6@0.7"], "--target is missing"),
    ([*WORDS, "--batches", "9-99"], "there are no such batches; expected a number from 0 to "),
    ([*WORDS, "--batches", "first"], "--batches first: these are not batches"),
    ([*WORDS, "--sample-rate", "1"], "cannot be sampled at 1 Hz; expected more than 211.2 MHz"),
    ([*WORDS, "--png", "gone/a.png"], "gone: there is no such folder; expected an existing folder"),
    ([*WORDS, "--npz", "a.npy"], "a.npy: this is not the name of an NPZ file"),
    (
        ["one.json", "--json", "one.json"],
        "one.json: this file is given for two outputs, and one would replace the",
    ),
    ([*WORDS, "--json", "folder.json", "--npz", "a.npz"], "folder.json: it cannot be written: Is a"),
    (
        ["random:3x3@1", "--seed", "1", "--target", "{pattern: compact, rows: 3, cols: 3}"],
        "there is nothing to play",
    ),
]


@pytest.mark.parametrize(("arguments", "words"), BAD)
def test_every_mistake_is_reported_as_text(
    tmp_path: Path,
    arguments: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    call: Any,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.json").write_text("{}", "utf-8")
    (tmp_path / "half.json").write_text('{"batches": ', "utf-8")
    (tmp_path / "folder.json").mkdir()
    before = sorted(path.name for path in tmp_path.iterdir())
    code, out, err = call("waveform", *arguments)
    assert (code, out) == (2, "")
    assert words in err
    assert "Traceback" not in err
    assert "internal error" not in err
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_picture_without_matplotlib_is_refused_before_anything_is_done(
    monkeypatch: pytest.MonkeyPatch, call: Any, tmp_path: Path
) -> None:
    monkeypatch.setattr("labseq.pictures.figures.find_spec", lambda _: None)
    code, _, err = call("waveform", *WORDS, "--png", str(tmp_path / "a.png"))
    assert code == 2
    assert f"needs matplotlib, which is not installed; {install_hint('plot')}" in err
