"""The self test of the Spectrum card, on a simulated one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from labseq_spcm.self_test import HOT_C, UPLOAD
from labseq_spcm.simulator import M4I6631

from labseq import DeviceError, HasSelfTest


@pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
def test_a_card_that_is_well_passes_and_stays_silent(driver: Any, mode: str) -> None:
    with driver(mode) as lab:
        assert isinstance(lab.tweezers, HasSelfTest)
        lab.tweezers.self_test()
        assert lab.card.outputs_on == (False, False)
        assert not lab.card.running
        lab.play(lab.program(1))


def test_samples_are_sent_to_the_memory(driver: Any) -> None:
    with driver("replay") as lab:
        lab.tweezers.self_test()
        assert lab.card.memory.shape == (UPLOAD, 2)
        assert not lab.card.memory.any()


def test_what_was_prepared_is_dropped(driver: Any) -> None:
    with driver("replay") as lab:
        lab.tweezers.prepare(lab.program(1))
        lab.tweezers.self_test()
        with pytest.raises(DeviceError, match="without a prepared program"):
            lab.tweezers.play()


@pytest.mark.parametrize(("above_c", "well"), [(0, True), (1, False)])
def test_a_hot_card_is_told(driver: Any, above_c: int, well: bool) -> None:
    with driver(model=replace(M4I6631, temperature_c=HOT_C + above_c)) as lab:
        if well:
            lab.tweezers.self_test()
            return
        with pytest.raises(DeviceError, match="the base card has 81 degrees Celsius; expected at most 80"):
            lab.tweezers.self_test()


def test_a_clock_that_another_program_has_changed_is_told(driver: Any) -> None:
    with driver() as lab:
        lab.card.write(20000, 100_000_000)
        with pytest.raises(DeviceError, match="the sample rate is 100 MHz; expected 250 MHz"):
            lab.tweezers.self_test()


def test_a_closed_or_playing_card_is_not_tested(driver: Any) -> None:
    with driver() as lab:
        lab.tweezers.prepare(lab.program(1))
        lab.tweezers.play()
        with pytest.raises(DeviceError, match=r"self_test\(\) while a program plays"):
            lab.tweezers.self_test()
        lab.tweezers.close()
        with pytest.raises(DeviceError, match="not open"):
            lab.tweezers.self_test()
