from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import labseq
from labseq.assembly.planning import PlanRequest, plan_moves
from labseq.errors import ConfigError, LimitError
from labseq.model import Plan, SegmentKind
from labseq.plain import dumps
from labseq.plans.plan import PlanReport
from labseq.plans.waveform import (
    DEFAULT_RATE_HZ,
    PlannedWaveform,
    WaveformRequest,
    plan_waveform,
    read_batches,
)
from labseq.plans.waveform_report import WaveformReport

RATE = "250 MHz"
ONE_ATOM = json.dumps(
    {
        "planner": "by hand",
        "grid": {"n_rows": 1, "n_cols": 3, "spacing_m": 4.49e-6, "lattice": "square", "shear": 1},
        "degree_of_parallelism": 1,
        "occupancy": [[1, 0, 0]],
        "target": {"fill": [[0, 0, 1]], "clear": [[0, 0, 0]]},
        "batches": [{"from": [[0, 0]], "to": [[0, 2]]}],
    }
).encode()
REQUEST = PlanRequest("random:6x6@0.7", "{pattern: checkerboard, rows: 4, cols: 4}", seed=3)


def waveform(
    request: PlanRequest = REQUEST, batches: str | None = None, rate: str | None = RATE
) -> PlannedWaveform:
    return plan_waveform(WaveformRequest(request, batches, rate))


@pytest.fixture(scope="module")
def whole() -> PlannedWaveform:
    return waveform()


@pytest.fixture
def plan_json(tmp_path: Path) -> Path:
    path = tmp_path / "plan.JSON"
    path.write_text(dumps(PlanReport.of(plan_moves(REQUEST))), "utf-8")
    return path


def samples_of(made: PlannedWaveform) -> np.ndarray[Any, np.dtype[np.int16]]:
    part = slice(made.samples.start, made.samples.stop)
    return labseq.render(made.program, made.renderer.sample_rate_hz).samples[:, part]


def test_a_plan_in_a_file_gives_the_same_samples(whole: PlannedWaveform, plan_json: Path) -> None:
    read = waveform(PlanRequest(str(plan_json)))
    assert np.array_equal(samples_of(read), samples_of(whole))
    assert replace(WaveformReport.of(read), source="", subject={}) == replace(
        WaveformReport.of(whole), source="", subject={}
    )


@pytest.mark.parametrize(("as_plan", "mark"), [(True, ""), (False, "\ufeff")])
def test_standard_input_holds_a_plan_or_an_occupancy(
    whole: PlannedWaveform, as_plan: bool, mark: str
) -> None:
    rows = whole.moves.occupancy.astype(int).tolist()
    text = dumps(PlanReport.of(whole.moves)) if as_plan else "\n".join(str(row)[1:-1] for row in rows)
    request = PlanRequest("-") if as_plan else PlanRequest("-", "{pattern: checkerboard, rows: 4, cols: 4}")
    made = plan_waveform(WaveformRequest(request, None, RATE), io.BytesIO((mark + text).encode()))
    assert made.moves.source == "standard input"
    assert np.array_equal(made.program.column.phase_rad, whole.program.column.phase_rad)


@pytest.mark.parametrize("batches", [None, "2-3"])
def test_the_numbers_are_those_of_the_samples(batches: str | None) -> None:
    made = waveform(batches=batches)
    samples, rf = samples_of(made), made.moves.motion.rf
    starts = made.renderer.first_sample
    on = np.concatenate(
        [
            np.arange(starts[i], starts[i + 1]) - made.samples.start
            for i in made.segments
            if made.program.kind[i] != SegmentKind.IDLE
        ]
    )
    for channel, axis in enumerate(made.statistics()):
        volts = samples[channel, on] * (rf.full_scale_v / 32767)
        rms_v = float(np.sqrt(np.mean(volts**2)))
        assert axis.peak_v == pytest.approx(np.abs(volts).max())
        carried = [i for i in made.segments if made.program.kind[i] == SegmentKind.TRANSPORT]
        all_samples = labseq.render(made.program, 250e6).samples[channel].astype(float)
        parts = [all_samples[starts[i] : starts[i + 1]] for i in carried]
        crest = max(float(np.abs(part).max() / np.sqrt(np.mean(part**2))) for part in parts)
        assert axis.crest_factor == pytest.approx(crest)
        assert axis.mean_power_w == pytest.approx(rms_v**2 / 50)
        assert axis.aod_mean_power_w == pytest.approx(100 * axis.mean_power_w)  # 20 dB
        assert axis.aod_peak_v == pytest.approx(10 * axis.peak_v)
        assert axis.peak_v <= axis.amplitude_sum * rf.full_scale_v * (1 + 1e-4)
        assert axis.mean_power_w <= axis.highest_power_w * (1 + 1e-4)
        assert sum(axis.path_share.values()) == pytest.approx(1.0)
        low_hz, high_hz = axis.band_hz
        assert low_hz <= axis.frequency_hz[0] <= axis.frequency_hz[1] <= high_hz
    assert made.tones_on_s == pytest.approx(len(on) / made.renderer.sample_rate_hz, rel=1e-4)
    assert made.n_bytes == samples.nbytes


def test_one_tone_has_the_numbers_of_a_sine() -> None:
    made = plan_waveform(WaveformRequest(PlanRequest("-"), None, "617 MHz"), io.BytesIO(ONE_ATOM))
    row, _ = made.statistics()
    amplitude_v = 1.6 / 20
    assert (row.max_tones, row.frequency_hz) == (1, (100e6, 100e6))
    assert row.peak_v == pytest.approx(amplitude_v, rel=1e-3)
    assert row.crest_factor == pytest.approx(np.sqrt(2), rel=1e-3)
    assert row.mean_power_w == pytest.approx(amplitude_v**2 / 100, rel=0.02)  # it is switched over 2 us
    assert row.highest_power_w == pytest.approx(amplitude_v**2 / 100)
    assert row.amplitude_sum == pytest.approx(0.05)


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=1, max_size=6), st.integers(0, 5), st.integers(0, 5))
def test_a_range_of_batches_never_cuts_a_chain(linked: list[bool], first: int, last: int) -> None:
    linked[0] = False
    sites = [(0, i) for i in range(len(linked) + 1)]
    batches = [
        labseq.Batch(np.array([a], np.int16), np.array([b], np.int16), on)
        for a, b, on in zip(sites, sites[1:], linked, strict=False)
    ]
    plan = Plan.from_batches(batches)
    fine = first <= last < len(linked) and not linked[first] and not any(linked[last + 1 : last + 2])
    if fine:
        assert read_batches(f"{first}-{last}", plan) == range(first, last + 1)
    else:
        with pytest.raises(ConfigError, match="batches"):
            read_batches(f"{first}-{last}", plan)


SLOW = ("profile.mobile_tweezers.speed=0.5 um/s",)


@pytest.mark.parametrize(
    ("request_", "error", "message"),
    [
        (
            PlanRequest("random:3x3@1", "{pattern: compact, rows: 3, cols: 3}", seed=1),
            ConfigError,
            "nothing to play because the plan has no",
        ),
        (
            PlanRequest(
                "random:20x20@0.75",
                "{pattern: compact, rows: 6, cols: 6}",
                seed=1,
                profile="virtual",
                overrides=SLOW,
            ),
            ConfigError,
            r"the waveform is .* s long; expected at most 60 s; check",
        ),
        (
            PlanRequest("random:30x30@0.6", "{pattern: compact, rows: 20, cols: 20}", seed=1),
            LimitError,
            r"the limit is the band of 82 to 118 MHz; name the machine with --profile",
        ),
    ],
)
def test_what_cannot_be_played_is_refused(request_: PlanRequest, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        waveform(request_)


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        ("200 MHz", "MHz cannot be sampled at 200 MHz; expected more than 211.2 MHz"),
        ("-625e6", "this is not a sample rate"),
        ("5 parsec", "'parsec' in '5 parsec' is not a unit of frequency"),
    ],
)
def test_a_sample_rate_that_makes_no_sense_is_refused(rate: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        waveform(rate=rate)
    assert str(caught.value).startswith(f"--sample-rate {rate}: ")
    assert words in str(caught.value)


PROFILE = """
labseq: 1
name: mine
grid: {{rows: 6, cols: 6, spacing: 4.49 um}}
camera: {{use: no_such_camera}}
static_tweezers: {{use: virtual}}
mobile_tweezers: {tweezers}
detector: {{use: threshold}}
"""


@pytest.mark.parametrize(
    ("tweezers", "rate_hz", "n_warnings"),
    [
        ("{use: spcm, sample_rate: 500 MHz}", 500e6, 0),
        ("{use: virtual}", 625e6, 0),
        ("{use: not_installed, sample_rate: 500 MHz}", 625e6, 1),
    ],
)
def test_the_profiles_mobile_tweezers_choose_the_sample_rate(
    tmp_path: Path, tweezers: str, rate_hz: float, n_warnings: int
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(PROFILE.format(tweezers=tweezers), "utf-8")
    request = PlanRequest(REQUEST.occupancy, REQUEST.target, seed=3, profile=str(path))
    made = waveform(request, rate=None)
    assert made.renderer.sample_rate_hz == rate_hz
    assert len(made.warnings) == n_warnings
    assert waveform(request, rate=RATE).renderer.sample_rate_hz == 250e6
    assert waveform(rate=None).renderer.sample_rate_hz == DEFAULT_RATE_HZ
