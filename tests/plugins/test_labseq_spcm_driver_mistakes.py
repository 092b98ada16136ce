"""What the Spectrum driver says to wrong cards, wrong settings and wrong programs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.simulator import M4I6631

from labseq import (
    Context,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    MotionSpec,
    RfSpec,
    ToneProgram,
)
from labseq.testing.fakes import FakeClock

MODES = ["replay", "fifo", "dds"]


def context(motion: MotionSpec | None = None) -> Context:
    return Context("mobile_tweezers", clock=FakeClock(), motion=motion or MotionSpec())


class TestCards:
    def test_that_are_unknown_are_named_with_the_drivers_reason(self, driver: Any) -> None:
        with driver():  # so that there is a driver library
            tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated-none"), context())
            with pytest.raises(DeviceError, match=r"'simulated-none': .*no such card; see its name"):
                tweezers.open()

    def test_in_use_are_named_and_not_disturbed(self, driver: Any) -> None:
        with driver() as lab:
            other = SpcmMobileTweezers(lab.tweezers._settings, context())
            with pytest.raises(DeviceError, match=r"in use; .*close what else uses it"):
                other.open()
            other.close()
            lab.play(lab.program())

    def test_of_another_family_are_refused(self, driver: Any) -> None:
        digitizer = replace(M4I6631, name="M4i.4420-x8", card_type=0x74420)
        text = r"is a M4i\.4420-x8 .* expected a Spectrum M4i\.66xx .*: name another one as `card`"
        with pytest.raises(DeviceError, match=text), driver(model=digitizer):
            pass

    def test_with_another_serial_number_are_refused(self, driver: Any) -> None:
        with pytest.raises(DeviceError, match="serial number 12345; expected 99"), driver(serial=99):
            pass

    def test_that_are_too_slow_are_refused(self, driver: Any) -> None:
        slow = replace(M4I6631, name="M4i.6622-x8", sample_rate_hz=(50e6, 625e6))
        text = r"the M4i\.6622-x8 makes at most 625 MS/s; lower sample_rate from 1000 MHz"
        with pytest.raises(DeviceError, match=text), driver(model=slow, sample_rate=1e9):
            pass

    def test_that_were_refused_are_left_closed_with_their_outputs_off(self, driver: Any) -> None:
        with driver() as lab:
            name, card = lab.tweezers._identifier, lab.card
            lab.tweezers.close()
            wrong = SpcmMobileTweezers(SpcmSettings(card=name, serial=99), context())
            with pytest.raises(DeviceError):
                wrong.open()
            assert card.outputs_on == (False, False)
            lab.tweezers.open()
            lab.play(lab.program())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("timeout_s", [0.0, 50e-3])
def test_a_trigger_that_never_comes_times_out_into_the_safe_state(
    driver: Any, mode: str, timeout_s: float
) -> None:
    with driver(mode, trigger="external") as lab:
        lab.tweezers.prepare(lab.program())
        lab.tweezers.play()
        with pytest.raises(DeviceTimeoutError, match=r"no trigger came .* the cable at Ext0"):
            lab.tweezers.wait(timeout_s)
        assert not lab.card.running
        assert lab.card.outputs_on == (False, False)
        lab.tweezers.prepare(lab.program())


class TestSettings:
    @pytest.mark.parametrize("rate_hz", [751e6, 1.13e9])
    def test_sample_rates_in_the_gaps_of_the_clock_are_refused(self, rate_hz: float) -> None:
        with pytest.raises(ValueError, match=r"a gap from .*; expected a rate outside of it"):
            SpcmSettings(sample_rate=rate_hz)

    @pytest.mark.parametrize("rate_hz", [49e6, 1.26e9, float("nan")])
    def test_sample_rates_beyond_the_clock_are_refused(self, rate_hz: float) -> None:
        with pytest.raises(ValueError, match=r"expected 50 MHz to 1\.25 GHz|finite"):
            SpcmSettings(sample_rate=rate_hz)

    @pytest.mark.parametrize("mode", ["replay", "fifo"])
    def test_sample_rates_that_mirror_tones_of_the_band_are_refused(self, mode: Any) -> None:
        text = r"sample_rate is 236 MHz; the limit is above 236 MHz, twice the end of the AODs' band, 118 MHz"
        with pytest.raises(LimitError, match=text):
            SpcmMobileTweezers(SpcmSettings(card="simulated", mode=mode, sample_rate=236e6), context())

    def test_rates_that_the_bus_cannot_carry_are_refused_for_fifo(self) -> None:
        text = r"sample_rate is 1\.25 GHz, but the bus carries at most 700 MHz .* use mode: replay"
        with pytest.raises(ValueError, match=text):
            SpcmSettings(mode="fifo", sample_rate=1.25e9)

    def test_both_axes_on_one_output_are_refused(self) -> None:
        with pytest.raises(ValueError, match="both 0"):
            SpcmSettings(column_channel=0)

    @pytest.mark.parametrize(
        ("full_scale_v", "max_peak_v", "text"),
        [(2.1, 3.0, "2000 mV"), (0.05, 2.0, "80 mV"), (0.45, 2.0, "relay"), (1.0, 0.5, "max_peak")],
    )
    def test_amplitudes_that_card_or_amplifiers_cannot_do_are_refused(
        self, full_scale_v: float, max_peak_v: float, text: str
    ) -> None:
        motion = MotionSpec(rf=RfSpec(full_scale_v=full_scale_v, max_peak_v=max_peak_v))
        with pytest.raises(LimitError, match=text):
            SpcmMobileTweezers(SpcmSettings(card="simulated"), context(motion))


def with_row_tone(program: ToneProgram, name: str, value: float) -> ToneProgram:
    """The program with another value of one of its row tones."""
    values = getattr(program.row, name).copy()
    values[3] = value
    return replace(program, row=replace(program.row, **{name: values}))


@pytest.mark.parametrize("mode", MODES)
class TestPrograms:
    @pytest.mark.parametrize(
        ("name", "value", "text"),
        [
            ("start_hz", 81e6, r"frequency of a row tone in batch 0 is .* 82 to 118 MHz"),
            ("end_hz", 119e6, r"frequency of a row tone in batch 0 is .* 82 to 118 MHz"),
            ("start_hz", np.nan, "frequency of a row tone in batch 0 is nan"),
            ("end_hz", np.inf, "frequency of a row tone in batch 0 is inf"),
            ("start_amplitude", 1.5, r"amplitude of a row tone in batch 0 is 1\.5; .* 0 to 1 of full scale"),
            ("end_amplitude", -0.1, r"amplitude of a row tone in batch 0 is -0\.1"),
            ("end_amplitude", np.nan, "amplitude of a row tone in batch 0 is nan"),
            ("phase_rad", np.nan, "phase of a row tone in batch 0 is nan"),
        ],
    )
    def test_with_wrong_tones_are_refused_before_anything_is_uploaded(
        self, driver: Any, mode: str, name: str, value: float, text: str
    ) -> None:
        with driver(mode) as lab:
            lab.card.log.clear()
            with pytest.raises(LimitError, match=text):
                lab.tweezers.prepare(with_row_tone(lab.program(), name, value))
            assert not list(lab.card.log)

    def test_that_clip_only_together_are_refused(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            program = lab.program()
            n_tones = int(np.diff(program.column.offsets).max())
            loud = np.full_like(program.column.start_amplitude, 1.01 / n_tones)
            column = replace(program.column, start_amplitude=loud)
            with pytest.raises(LimitError, match=r"sum of the amplitudes.* of full scale; .* would clip"):
                lab.tweezers.prepare(replace(program, column=column))

    @pytest.mark.parametrize(
        ("factor", "text"), [(0.0, "length"), (np.inf, "duration"), (np.nan, "duration"), (-1.0, "duration")]
    )
    def test_of_no_length_are_refused(self, driver: Any, mode: str, factor: float, text: str) -> None:
        with driver(mode) as lab:
            program = lab.program()
            with pytest.raises(LimitError, match=text):
                lab.tweezers.prepare(replace(program, duration_s=program.duration_s * factor))
            with pytest.raises(DeviceError, match="without a prepared program"):
                lab.tweezers.play()

    def test_of_no_segments_are_refused(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab, pytest.raises(LimitError, match="length"):
            lab.tweezers.prepare(lab.program(0))


def test_a_program_longer_than_the_memory_is_refused(driver: Any) -> None:
    small = replace(M4I6631, memory_samples=2 * 2**16)
    with driver(model=small) as lab, pytest.raises(LimitError, match="the card's memory; use mode: fifo"):
        lab.tweezers.prepare(lab.program())
