"""What cannot be rendered is refused in words."""

from __future__ import annotations

from typing import Any

import pytest

from labseq.errors import LimitError
from labseq.motion import Renderer, render, render_chunks

from .programs import program_of


@pytest.mark.parametrize(
    ("tone", "message"),
    [
        (
            (320e6, 1e8, 0.1, 0.1, 0.0),
            r"start_hz of a row tone in batch 1 is 320000000.0; the limit is 0 to 312500000",
        ),
        ((1e8, -1.0, 0.1, 0.1, 0.0), "end_hz of a row tone in batch 1 is -1.0"),
        ((1e8, 1e8, float("nan"), 0.1, 0.0), "start_amplitude of a row tone in batch 1 is nan"),
        ((1e8, 1e8, 0.1, -0.1, 0.0), "end_amplitude of a row tone in batch 1 is -0.1"),
        ((1e8, 1e8, 0.1, 0.1, float("inf")), "phase_rad of a row tone in batch 1 is inf"),
        (
            (1e8, 1e8, 0.1, 0.96, 0.0),
            "sum of the amplitudes of the row tones in batch 1 is 1.01; the limit is 1",
        ),
    ],
)
def test_what_cannot_be_played_is_refused(tone: Any, message: str) -> None:
    program = program_of((1e-6, [(1e8, 1e8, 0.05, 0.05, 0.0), tone]))
    with pytest.raises(LimitError, match=message):
        render(program)


@pytest.mark.parametrize("duration_s", [-1e-6, float("nan"), float("inf")])
def test_wrong_durations_are_refused(duration_s: float) -> None:
    with pytest.raises(LimitError, match="duration of segment 0 in batch 1"):
        render(program_of((duration_s, [])))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("durations_s", [(1e300,), (1e308, 1e308), (1e9,)])
def test_more_samples_than_can_be_counted_are_refused(durations_s: tuple[float, ...]) -> None:
    with pytest.raises(LimitError, match=r"the number of samples is .*; the limit is less than 9\.01e\+15"):
        Renderer(program_of(*((duration_s, []) for duration_s in durations_s)), 10e9)


@pytest.mark.parametrize("sample_rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_wrong_sample_rates_are_refused(sample_rate_hz: float) -> None:
    with pytest.raises(LimitError, match="sample rate"):
        render(program_of((1e-6, [])), sample_rate_hz)


def test_chunks_have_samples() -> None:
    with pytest.raises(LimitError, match="samples in a chunk is 0"):
        next(render_chunks(program_of((1e-6, [])), chunk_samples=0))
