"""Static tweezers on a radio keep the promises of their role."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from labseq_soapy.settings import SoapySettings
from labseq_soapy.static_tweezers import SoapyStaticTweezers

from labseq import Context, LimitError
from labseq.roles import offers
from labseq.testing import StaticTweezersContract

from .labseq_soapy_rig import GRID, SMALL, made, need_radio, opened


class TestSoapyStaticTweezers(StaticTweezersContract):
    ramp_s = 0.002

    def context(self) -> Context:
        return replace(super().context(), grid=GRID)

    @pytest.fixture
    def factory(self) -> Callable[[Context], SoapyStaticTweezers]:
        need_radio()
        settings = SoapySettings.model_validate({**SMALL, "switch": 1e-3})
        return partial(SoapyStaticTweezers, settings)


def test_it_tests_itself_in_the_dark() -> None:
    with opened() as rig:
        assert offers(rig.tweezers, "self_test")
        rig.tweezers.self_test()
        rig.tweezers.check_interlocks()
        assert not rig.ring.latest(1000).any()


def test_it_tells_what_the_radio_read_back_and_how_the_tones_are_made() -> None:
    with opened(row_gain=12.0, column_gain=99.0 / 8) as rig:
        rig.tweezers.start()
        described = rig.tweezers.describe()
    assert described["radio"]["driver"] == "capture"
    assert described["gain_db"] == (12.0, 12.375)
    assert described["loop_samples"] == 80
    assert all(1.0 < crest < 1.5 for crest in described["crest_factor"])
    assert described["underflows"] == 0


def test_a_session_that_turns_it_on_in_real_time_waits_as_long_as_the_ramp() -> None:
    with opened() as rig:
        rig.tweezers.start()
        before_s = rig.clock.now()
        rig.tweezers.ramp(0.5, 0.01)
        assert rig.clock.now() == pytest.approx(before_s + 0.01)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            {"sample_rate": 200e3},
            r"column tones: the outermost tone is .* from the local oscillator at 100.015 MHz",
        ),
        ({"local_oscillator": 99.3e6}, r"the limit is 0.48 MHz, half of 80% of the sample rate of 1.2 MHz"),
        (
            {"local_oscillator": 100.1234567e6, "tone_tolerance": 1e-6},
            "round tones, local_oscillator and sample_rate",
        ),
    ],
)
def test_tones_that_the_radio_cannot_make_are_refused_before_it_is_opened(
    settings: dict[str, Any], text: str
) -> None:
    with pytest.raises(LimitError, match=text):
        made(**settings)
