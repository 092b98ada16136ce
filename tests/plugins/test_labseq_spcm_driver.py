"""The driver of the Spectrum card, on the real package ``spcm`` and a simulated card: what is played."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings

from labseq import Context, DeviceError, MotionSpec, RfSpec
from labseq.motion.rendering import render
from labseq.testing import MobileTweezersContract

MODES = ["replay", "fifo", "dds"]


class TestReplayContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated"))


class TestFifoContract(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="fifo"))


class TestDdsContract(MobileTweezersContract):
    def context(self) -> Context:
        motion = MotionSpec(max_row_tones=16, max_column_tones=5)
        return replace(super().context(), motion=motion)

    @pytest.fixture
    def factory(self) -> Callable[[Context], SpcmMobileTweezers]:
        return partial(SpcmMobileTweezers, SpcmSettings(card="simulated", mode="dds"))


class TestSamples:
    MODES: ClassVar = ["replay", "fifo"]

    @pytest.mark.parametrize("mode", MODES)
    def test_are_what_was_rendered_and_then_silence(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            program = lab.program(3)
            rendered = render(program, lab.rate_hz).samples
            lab.play(program)
            for channel in (0, 1):
                played = lab.samples(channel)
                assert np.array_equal(played[: rendered.shape[1]], rendered[channel])
                assert not played[rendered.shape[1] :].any()
                assert len(played) - rendered.shape[1] < 32

    @pytest.mark.parametrize("mode", MODES)
    def test_come_from_the_channel_that_the_profile_names(self, driver: Any, mode: str) -> None:
        with driver(mode, row_channel=1, column_channel=0) as lab:
            program = lab.program()
            rendered = render(program, lab.rate_hz).samples
            lab.play(program)
            assert np.array_equal(lab.samples(1)[: rendered.shape[1]], rendered[0])
            assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[1])

    @pytest.mark.parametrize("mode", MODES)
    def test_of_one_program_leave_nothing_in_the_next(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            for n_batches in (5, 2):
                program = lab.program(n_batches)
                lab.card.forget(lab.clock.now() + 1.0)
                lab.play(program)
            rendered = render(program, lab.rate_hz).samples
            played = lab.samples(0)
            assert np.array_equal(played[: rendered.shape[1]], rendered[0])
            assert not played[rendered.shape[1] :].any()

    def test_are_rendered_for_the_rate_that_the_card_really_makes(self, driver: Any) -> None:
        with driver(sample_rate=250e6 + 3) as lab:
            assert lab.rate_hz == 250e6
            program = lab.program()
            lab.play(program)
            rendered = render(program, lab.rate_hz).samples
            assert np.array_equal(lab.samples(0)[: rendered.shape[1]], rendered[0])

    def test_have_the_amplitude_of_the_profile(self, driver: Any) -> None:
        with driver(motion=MotionSpec(rf=RfSpec(full_scale_v=0.2))) as lab:
            lab.play(lab.program())
            assert {span.amplitude_v for span in lab.card.played(0)} == {0.2}


class TestPlaying:
    @pytest.mark.parametrize("mode", MODES)
    def test_needs_a_new_program_each_time(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            lab.play(lab.program())
            with pytest.raises(DeviceError, match="without a prepared program"):
                lab.tweezers.play()

    @pytest.mark.parametrize("mode", MODES)
    def test_starts_at_the_external_trigger(self, driver: Any, mode: str) -> None:
        with driver(mode, trigger="external") as lab:
            duration_s = lab.tweezers.prepare(lab.program())
            assert not lab.card.trigger()  # too early: not armed yet
            lab.tweezers.play()
            lab.clock.sleep(2e-3)
            assert not lab.card.played(0)
            triggered_s = lab.clock.now()
            assert lab.card.trigger()
            lab.tweezers.wait(duration_s + 1e-3)
            assert lab.card.played(0)[0].start_s >= triggered_s
