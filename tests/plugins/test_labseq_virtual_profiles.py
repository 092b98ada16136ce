"""The profiles that come with labseq, and the plugin's defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from labseq_virtual.settings import (
    CameraSettings,
    DeviceSettings,
    MobileTweezersSettings,
    SimulationSettings,
    StaticTweezersSettings,
)

from labseq.config.profile import MobileTweezersChoice, load_profile
from labseq.detection.threshold import ThresholdSettings
from labseq.plugin import MotionSpec, Settings, SiteGrid
from labseq.plugin.motion import RfSpec
from labseq.settings import settings_of

MODELS: Mapping[str, type[Settings]] = {
    "camera": CameraSettings,
    "static_tweezers": StaticTweezersSettings,
    "mobile_tweezers": MobileTweezersSettings,
    "detector": ThresholdSettings,
    "simulation": SimulationSettings,
}


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one mapping, address -> value."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        nested: Mapping[str, Any] | None = value if isinstance(value, Mapping) else None
        found |= {prefix + key: value} if nested is None else flat(nested, f"{prefix}{key}.")
    return found


def test_the_virtual_profile_states_the_defaults() -> None:
    document, profile = load_profile("virtual")
    assert all(choice.use == "virtual" for role, choice in profile.choices.items() if role != "detector")
    for role, model in MODELS.items():
        core_keys = {one.key for one in settings_of(MobileTweezersChoice)}
        read = document.validate(model, (role,), core_keys=core_keys)
        stated, default = flat(read.model_dump()), flat(model().model_dump())
        if role == "simulation":  # the profile says what the machine is; by default it is what the grid says
            for axis in ("row_tones", "column_tones"):
                true = [stated.pop(f"mobile_light.{axis}.{key}") for key in ("centre", "step")]
                assert true == [100e6, 1.6e6]
                assert default.pop(f"mobile_light.{axis}") is None
        assert stated.keys() == default.keys()
        for key, value in default.items():
            expected = pytest.approx(value) if isinstance(value, float) else value
            assert stated[key] == expected, f"{role}.{key}"
    shutter = document.validate(DeviceSettings, ("devices", "shutter"), core_keys={"use"})
    assert shutter.commands == ("open", "close")


@pytest.mark.parametrize("name", ["virtual", "lab"])
def test_the_profiles_describe_the_papers_machine(name: str) -> None:
    document, profile = load_profile(name)
    grid, paper = profile.grid_model(), SiteGrid()
    pause_s = 0.5e-3 if name == "virtual" else 0.0  # the paper's, not that of an AWG which plays samples
    assert replace(profile.motion, rf=RfSpec()) == MotionSpec(overhead_per_batch_s=pause_s)  # volts vary
    np.testing.assert_allclose(grid.positions_m, paper.positions_m)
    np.testing.assert_allclose(grid.row_frequency_hz, paper.row_frequency_hz)
    np.testing.assert_allclose(grid.column_frequency_hz, paper.column_frequency_hz)
    assert document.validate(ThresholdSettings, ("detector",), core_keys={"use"}) == ThresholdSettings()
    assert document.validate(SimulationSettings, ("simulation",), core_keys={"use"}).lifetime == 33.0


def test_camera_and_detector_agree_on_where_the_atoms_are() -> None:
    image, detector = SimulationSettings().image, ThresholdSettings()
    for name in ("frame", "centre_px", "pixel_size", "angle", "offset"):
        assert getattr(image, name) == getattr(detector, name)


def test_the_grid_and_its_ejection_slots_fit_into_the_aods_band() -> None:
    grid, limits, slots = SiteGrid(), MobileTweezersSettings(), MotionSpec().eject_slots
    for hz in (grid.row_frequency_hz, grid.column_frequency_hz):
        reach = max(abs(hz - limits.band_centre)) + slots * (hz[1] - hz[0])
        assert reach <= limits.band_half_width
