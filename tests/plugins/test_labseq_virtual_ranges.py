"""What the virtual lab warns of."""

from __future__ import annotations

import pytest
from labseq_virtual.responses import beyond
from labseq_virtual.settings import SimulationSettings

from labseq.model import MotionSpec

PAPER = SimulationSettings()


@pytest.mark.parametrize(
    ("motion", "texts"),
    [
        (MotionSpec(), []),
        (MotionSpec(speed_m_s=0.265), []),
        (MotionSpec(speed_m_s=0.275), ["profile.mobile_tweezers.speed is 275 um/ms; above 269 um/ms"]),
        (
            MotionSpec(speed_m_s=0.15, speed_profile="minimum_jerk"),
            ["profile.mobile_tweezers.speed is 150 um/ms; above 144 um/ms"],
        ),
        (MotionSpec(speed_m_s=4.0), ["speed is 4000 um/ms; the virtual lab knows heat and loss from 0 "]),
        (MotionSpec(speed_m_s=0.25, pick_up_s=2e-6), []),
        (MotionSpec(drop_off_s=1e-3), ["drop_off is 1 ms; the virtual lab knows"]),
    ],
)
def test_moves_beyond_what_the_tables_were_derived_for(motion: MotionSpec, texts: list[str]) -> None:
    found = beyond(motion, PAPER)
    assert len(found) == len(texts)
    assert all(text in one for text, one in zip(texts, found, strict=True))


def test_a_deeper_static_tweezer_bears_more_speed() -> None:
    deep = PAPER.model_copy(update={"static_depth": 4 * PAPER.static_depth})
    assert not [text for text in beyond(MotionSpec(speed_m_s=0.4), deep) if "speed" in text]


def test_the_sound_of_the_tables_takes_ten_microseconds() -> None:
    light = PAPER.mobile_light.model_copy(update={"transit_time": 6e-6})
    (text,) = beyond(MotionSpec(), PAPER.model_copy(update={"mobile_light": light}))
    assert all(fact in text for fact in ("mobile_light.transit_time is 6 us", "8 us to 12"))
