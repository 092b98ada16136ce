"""What the virtual lab warns of."""

from __future__ import annotations

import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq.model import MotionSpec, SiteGrid
from labseq.plugin import Context


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
    ],
)
def test_speeds_at_which_the_light_is_not_known(motion: MotionSpec, texts: list[str]) -> None:
    context = Context("simulation", SiteGrid(), motion)
    found = VirtualSimulation(SimulationSettings(), context).warnings()
    assert len(found) == len(texts)
    assert all(text in one for text, one in zip(texts, found, strict=True))
