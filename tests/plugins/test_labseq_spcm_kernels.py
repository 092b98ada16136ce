"""The kernels of the Spectrum driver against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from labseq_spcm._kernels import interleave
from labseq_spcm.interleaved import CHUNK, InterleavedRenderer
from numpy.typing import NDArray

from labseq import Plan
from labseq.motion import render, tone_program


@given(st.integers(0, 100).flatmap(lambda n: arrays(np.int16, (2, n))))
def test_interleaving_puts_the_samples_of_both_outputs_side_by_side(samples: NDArray[np.int16]) -> None:
    first, second = samples.view(np.uint16)
    frames = np.empty(samples.shape[1], np.uint32)
    interleave(first, second, frames)
    assert np.array_equal(frames.view(np.int16).reshape(-1, 2), samples.T)


@pytest.mark.parametrize("row_channel", [0, 1])
def test_any_stretch_of_a_program_is_rendered_as_in_the_whole(row_channel: int) -> None:
    program = tone_program(Plan.from_batches([([(0, 0)], [(0, 3)]), ([(2, 1)], [(4, 1)])]))
    whole = render(program, 625e6).samples
    renderer = InterleavedRenderer(program, 625e6, row_channel)
    assert 0 <= renderer.n_samples - whole.shape[1] < 32
    wanted = np.zeros((renderer.n_samples + CHUNK, 2), np.int16)
    wanted[: whole.shape[1]] = whole.T if row_channel == 0 else whole[::-1].T
    for start, n_samples in [(0, len(wanted)), (0, 1), (12345, CHUNK), (CHUNK - 7, CHUNK + 100)]:
        out = np.full((n_samples, 2), 99, np.int16)
        renderer.write(start, out)
        assert np.array_equal(out, wanted[start : start + n_samples])
