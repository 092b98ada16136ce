"""Static tweezers equalised on the virtual lab, from the run to the entry in use."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation
from PIL import Image

from labseq.builtin.equalise import factors
from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration.store import Store
from labseq.errors import ConfigError, DeviceError
from labseq.plugin import Context, DepthRamp, RandomStream, SiteGrid, TweezerAmplitudes

PROFILE = """labseq: 1
name: uneven
grid: {rows: 8, cols: 10, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
devices:
  trap_camera: {use: virtual_spot_meter, noise: 1 %}
  half_blind: {use: half_blind}
plugin_folders: [plugins]
simulation: {use: virtual, machine_seed: 3, tone_response: 8 %}
"""
HALF_BLIND = """
import labseq
import numpy as np
from labseq_virtual.settings import SpotMeterSettings
from labseq_virtual.devices import VirtualSpotMeter

LABSEQ_API = 1


class HalfBlind(VirtualSpotMeter):
    '''Sees no light on a corner of the array.'''

    def read(self, name):
        power = super().read(name)
        power[:3, :2] = np.nan
        return power


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("half_blind", HalfBlind, SpotMeterSettings, virtual_time=True)
"""
GRID = SiteGrid(8, 10)


class Lab:
    """A profile whose rows and columns are uneven."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.profile = folder / "uneven.yaml"
        self.profile.write_text(PROFILE, "utf-8")
        (folder / "plugins").mkdir()
        (folder / "plugins" / "half_blind.py").write_text(HALF_BLIND, "utf-8")
        self.store = Store(folder / "calibrations" / "uneven")

    def calibrate(self, kind: str = "tweezers", seed: int = 1, **changes: Any) -> Outcome:
        request = CalibrationRequest(str(self.profile), output=self.folder / "data", seed=seed, **changes)
        return calibrate(METHODS[kind], request)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


def true_spread(outcome: Outcome | None = None) -> float:
    """Separable part of the powers themselves, at the amplitudes that were found."""
    physics = SimulationSettings.model_validate({"machine_seed": 3, "tone_response": 0.08})
    world = VirtualSimulation(physics, Context("simulation", GRID, random=RandomStream(0)))
    world.open()
    world.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    if outcome is not None:
        values = outcome.stored.entry.values
        amplitudes = TweezerAmplitudes(values["row_amplitudes"], values["column_amplitudes"])
        world.play("static_tweezers", amplitudes, 0.0)
    return factors(world.spot_powers()).separable_spread


def test_uneven_rows_and_columns_are_made_even_and_stay_so(lab: Lab) -> None:
    outcome = lab.calibrate()
    entry = outcome.stored.entry
    assert true_spread() > 0.05
    assert true_spread(outcome) < 0.006
    assert entry.quality["separable_spread"] <= 0.005
    assert entry.quality["residual_spread"] == pytest.approx(0.04, rel=0.3)
    assert (outcome.refused, entry.origin["n_shots"]) == ("", 1)
    assert "rows and columns are equal to 0." in outcome.summary_lines[0]
    assert "left from site to site, which the tones cannot change: " in outcome.summary_lines[1]
    for axis in ("row", "column"):
        assert entry.values[f"{axis}_amplitudes"].sum() <= 1 + 1e-9
    again = lab.calibrate(seed=2)  # it begins where the first has ended
    assert again.run is not None
    assert len(again.run.shots[0].readings["equalise.spreads"]) <= 2
    assert again.stored.entry.origin["calibrations"] == {"tweezers": entry.id}
    assert true_spread(again) < 0.006


def test_a_run_may_be_analysed_again(lab: Lab) -> None:
    first = lab.calibrate()
    assert first.run is not None
    assert lab.calibrate(source=first.run.path).stored.entry.id == first.stored.entry.id


def test_the_picture_shows_both_maps_and_the_amplitudes(lab: Lab) -> None:
    picture = lab.calibrate().stored.picture
    assert picture is not None
    with Image.open(io.BytesIO(picture.read_bytes())) as image:
        assert image.format == "PNG"
        assert min(image.size) > 400


def test_a_meter_that_does_not_see_all_tweezers_will_do(lab: Lab) -> None:
    outcome = lab.calibrate(overrides=["shot.0.equalise.device=half_blind"])
    assert true_spread(outcome) < 0.012  # of what it sees, the separable part is even
    assert outcome.stored.picture is not None


def test_noise_that_cannot_be_averaged_ends_it_and_what_is_in_use_stays(lab: Lab) -> None:
    old = lab.calibrate().stored.entry
    with pytest.raises(DeviceError, match=r"not equalised: too much noise: 100 averages leave") as caught:
        lab.calibrate(overrides=["profile.devices.trap_camera.noise=50 %"])
    assert caught.value.exit_code == 3
    assert lab.store.active()["tweezers"].id == old.id


def test_a_run_without_the_step_is_refused(lab: Lab) -> None:
    run = lab.calibrate("sites", shots=10).run
    assert run is not None
    with pytest.raises(
        ConfigError, match=r"no shot of it equalised the tweezers; expected a run with the step"
    ):
        lab.calibrate(source=run.path)
    with pytest.raises(ConfigError, match="a calibration of tweezers cannot be made from a file"):
        lab.calibrate(source=lab.folder / "x.npy")
    assert "tweezers" not in lab.store.active()


def test_a_run_on_another_grid_is_refused(lab: Lab) -> None:
    run = lab.calibrate().run
    assert run is not None
    lab.store.use_none("tweezers")
    lab.profile.write_text(PROFILE.replace("rows: 8", "rows: 7"), "utf-8")
    with pytest.raises(ConfigError, match="the run has a grid of 8 x 10 sites; expected 7 x 10"):
        lab.calibrate(source=run.path)


def test_a_profile_without_a_meter_is_refused(lab: Lab) -> None:
    lab.profile.write_text(PROFILE.replace("trap_camera:", "wavemeter:"), "utf-8")
    with pytest.raises(
        ConfigError, match="has no device 'trap_camera'; expected one of 'half_blind', 'wavemeter'"
    ):
        lab.calibrate()
    outcome = lab.calibrate(overrides=["shot.0.equalise.device=wavemeter"])
    assert true_spread(outcome) < 0.006
