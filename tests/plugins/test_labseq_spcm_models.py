"""The models of Spectrum cards that the driver takes, their limits and outputs, and those that it refuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_spcm.models import MODELS
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import M4I6621, M4I6622, M4I6631, registers as r, setup
from pydantic import ValidationError

from labseq.motion.rendering import render
from labseq.plugin import DeviceError, LabseqError, LimitError, MotionSpec
from labseq.plugin.motion import RfSpec

HBW = setup.MODELS["M4i.6631-x8-hbw"]


def scaled(full_scale_v: float) -> MotionSpec:
    return MotionSpec(rf=RfSpec(full_scale_v=full_scale_v, max_peak_v=3.0))


class TestFourOutputs:
    @pytest.mark.parametrize("mode", ["replay", "fifo", "stream"])
    @pytest.mark.parametrize(("row", "column"), [(1, 3), (2, 0)])
    def test_two_of_them_play_and_the_others_stay_off(
        self, driver: Any, mode: str, row: int, column: int
    ) -> None:
        channels = {"row_channel": row, "column_channel": column}
        with driver(mode, model=M4I6622, **channels) as lab:
            lab.tweezers.settle()
            lab.card.forget(lab.clock.now())
            program = lab.program(2)
            lab.play(program)
            rendered = render(program, lab.rate_hz).samples
            for samples, channel in zip(rendered, (row, column), strict=True):
                found = np.trim_zeros(samples)
                assert np.array_equal(np.trim_zeros(lab.samples(channel))[: len(found)], found)
            assert lab.card.outputs_on == tuple(n in (row, column) for n in range(4))
            lab.tweezers.safe_state()
            assert lab.card.outputs_on == (False,) * 4

    def test_must_be_there(self, driver: Any) -> None:
        text = "M4i.6631-x8 has 2 outputs; set row_channel and column_channel"
        with pytest.raises(DeviceError, match=text), driver(row_channel=0, column_channel=2):
            pass

    @pytest.mark.parametrize(
        ("settings", "text"),
        [
            ({"row_channel": 2}, "row_channel is 2; expected column_channel"),
            ({"row_channel": 1, "column_channel": 1}, "are both 1"),
            ({"model": "M4i.6631-x8", "column_channel": 3}, "expected two of the M4i.6631-x8's: 0 and 1"),
            ({"model": "M4i.6666-x8"}, "expected one of M4i.6620-x8, "),
            ({"model": "M4x.6631-x4", "mode": "fifo", "sample_rate": 625e6}, "at most 375 MHz"),
            (
                {"card": "TCPIP::192.168.1.10::inst0", "mode": "stream"},
                "2.5 GB/s, which the network to TCPIP",
            ),
            ({"card": "TCPIP::192.168.1.10::inst0", "mode": "fifo"}, "use `mode: replay`"),
        ],
    )
    def test_and_what_cannot_be_is_refused_in_the_profile(self, settings: dict[str, Any], text: str) -> None:
        with pytest.raises(ValidationError, match=text):
            SpcmSettings.model_validate(settings)


class TestAmplitude:
    @pytest.mark.parametrize(
        ("model", "full_scale_v"), [(M4I6621, 2.2), (M4I6622, 2.5), (HBW, 0.45), (M4I6631, 2.0)]
    )
    def test_may_be_as_large_as_the_card_reads(self, driver: Any, model: Any, full_scale_v: float) -> None:
        named = {"named": "M4i.6631-x8-hbw"} if model is HBW else {}
        with driver(model=model, motion=scaled(full_scale_v), **named) as lab:
            lab.play(lab.program(1))
            assert {span.amplitude_v for span in lab.card.played(0)} == {full_scale_v}
            lab.card.log.clear()
            lab.tweezers.prepare(lab.program(20))
            lab.tweezers.play()
            lab.tweezers.safe_state()
            least_mv = 80 if model is HBW else 481
            assert min(lab.written(r.SPC_AMP0)) == least_mv, "as far as the path goes"

    @pytest.mark.parametrize(
        ("model", "full_scale_v", "text"),
        [
            (M4I6631, 2.2, "rf.full_scale is 2.2 V; .* the M4i.6631-x8's 80 mV to 2000 mV"),
            (HBW, 0.6, "80 mV to 480 mV"),
            (M4I6631, 0.45, "output relay may switch, .* with -hbw set `model`"),
        ],
    )
    def test_beyond_it_is_refused(self, driver: Any, model: Any, full_scale_v: float, text: str) -> None:
        with pytest.raises(LimitError, match=text), driver(model=model, motion=scaled(full_scale_v)):
            pass


@pytest.mark.parametrize(
    ("model", "settings", "text"),
    [
        (
            replace(M4I6631, name="M4i.6630-x8", card_type=0x76630, n_channels=1),
            {},
            "one output, but both axes must be on one card, .* star-hub",
        ),
        (
            replace(M4I6631, name="M5i.6357-x16", card_type=0xA6357),
            {},
            "whose steps of memory, amplifiers and delays labseq does not know",
        ),
        (
            replace(M4I6622, name="M4i.9622-x8", card_type=0x79622, modes=r.SPC_REP_STD_DDS),
            {},
            "M4i.9622-x8 cannot play samples as it is .* option AWG and its firmware",
        ),
        (M4I6621, {"named": "M4i.6631-x8"}, "is a M4i.6621-x8, but `model` is M4i.6631-x8"),
        (M4I6631, {"named": "M4i.6621-x8"}, "is a M4i.6631-x8, but `model` is M4i.6621-x8"),
        (M4I6621, {"sample_rate": 640e6}, "makes 50 to 625 MS/s, but sample_rate is 640 MHz"),
    ],
)
def test_a_card_that_cannot_do_it_is_refused_with_the_reason(
    driver: Any, model: Any, settings: dict[str, Any], text: str
) -> None:
    with pytest.raises(LabseqError, match=text), driver(model=model, **settings):
        pass


def test_an_m4i_96xx_with_the_option_awg_plays(driver: Any) -> None:
    with driver(model=setup.MODELS["M4i.9622-x8"]) as lab:
        lab.play(lab.program(1))


def test_each_simulated_card_is_in_the_drivers_table_with_its_limits() -> None:
    for name, card in setup.MODELS.items():
        row = MODELS[name]
        assert (row.n_outputs, row.rate_hz, row.amplitude_mv) == (
            card.n_channels,
            card.sample_rate_hz,
            card.amplitude_mv,
        )
