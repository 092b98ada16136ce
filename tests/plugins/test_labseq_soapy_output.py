"""The samples that go to the radio: ramps, fades, and the loop that runs on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_soapy.output import BLOCK, Output, Samples
from labseq_soapy.streamer import repeated

N_LOOP = 96


def loop(scale: float = 1.0) -> Samples:
    wave = np.exp(2j * np.pi * 5 * np.arange(N_LOOP) / N_LOOP).astype(np.complex64)
    return repeated(scale * np.stack([wave, wave.conj()]).view(np.float32))


def played(output: Output, n: int) -> np.ndarray:
    """The next n samples or more, complex64 (2, n)."""
    blocks: list[np.ndarray] = []
    while sum(block.shape[1] for block in blocks) < n:
        blocks.append(output.block().copy().view(np.complex64))
    return np.concatenate(blocks, axis=1)


def on(output: Output) -> np.ndarray:
    """One loop's worth at full depth, from the loop's start."""
    output.load(loop(), 1)
    output.ramp(1.0, 1)
    return played(output, 1)


def test_nothing_but_silence_comes_before_a_loop_is_on() -> None:
    output = Output()
    assert not played(output, 10).any()
    output.load(loop(), 100)
    assert not played(output, 10).any()
    assert output.steady


def test_a_loop_at_full_depth_is_sent_as_it_is_without_a_copy() -> None:
    output = Output()
    mine = loop()
    output.load(mine, 1)
    output.ramp(1.0, 1)
    output.block()
    assert np.shares_memory(output.block(), mine)


@given(
    st.lists(
        st.tuples(st.floats(0.0, 1.0), st.integers(1, 3 * BLOCK)),
        min_size=1,
        max_size=4,
    )
)
def test_the_depth_is_linear_to_the_sample_and_phases_run_on(ramps: list[tuple[float, int]]) -> None:
    output = Output()
    output.load(loop(), 1)
    start, at = 0.0, 0
    wave = loop().view(np.complex64)
    for end, n in ramps:
        output.ramp(end, n)
        samples = played(output, n)
        factor = samples / wave[:, (at + np.arange(samples.shape[1])) % wave.shape[1]]
        expected = start + (end - start) * np.minimum(1.0, np.arange(1, samples.shape[1] + 1) / n)
        assert np.abs(factor.imag).max() < 1e-5
        assert np.abs(factor.real**4 - expected).max() < 1e-5
        start, at = end, at + samples.shape[1]
        assert output.depth == end


def test_a_ramp_that_comes_during_a_ramp_goes_on_from_where_it_is() -> None:
    output = Output()
    output.load(loop(), 1)
    output.ramp(1.0, 4 * BLOCK)
    first = played(output, BLOCK)
    output.ramp(0.0, BLOCK)
    second = played(output, BLOCK)
    depth = np.abs(np.concatenate([first, second], axis=1)[0]) ** 4
    assert depth.max() == pytest.approx(0.25, abs=1e-3)
    assert np.abs(np.diff(depth)).max() < 1.01 / BLOCK
    assert depth[-1] < 1e-9


@given(st.floats(0.1, 0.9), st.integers(1, 3 * BLOCK))
def test_new_amplitudes_are_faded_in_without_a_jump(scale: float, n_fade: int) -> None:
    output = Output()
    on(output)
    output.load(loop(scale), n_fade)
    size = np.abs(played(output, n_fade)[0])
    expected = 1.0 + (scale - 1.0) * np.minimum(1.0, np.arange(1, len(size) + 1) / n_fade)
    assert np.abs(size - expected).max() < 1e-5
    assert output.steady


def test_a_fade_that_is_cut_short_by_another_one_goes_on_from_where_it_is() -> None:
    output = Output()
    on(output)
    output.load(loop(0.5), 4 * BLOCK)
    first = played(output, BLOCK)
    output.load(loop(0.25), BLOCK)
    size = np.abs(np.concatenate([first, played(output, BLOCK)], axis=1)[0])
    assert np.abs(np.diff(size)).max() < 1.0 / BLOCK
    assert size[-1] == pytest.approx(0.25, abs=1e-5)


def test_a_ramp_and_a_fade_may_come_together() -> None:
    output = Output()
    on(output)
    output.load(loop(0.5), 2 * BLOCK)
    output.ramp(0.0, BLOCK)
    size = np.abs(played(output, BLOCK)[0])
    assert np.all(np.diff(size) <= 1e-6)
    output.ramp(1.0, 1)
    assert np.abs(played(output, 2 * BLOCK))[0, -1] == pytest.approx(0.5, abs=1e-5)
