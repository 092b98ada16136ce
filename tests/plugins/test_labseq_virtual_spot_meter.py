"""The virtual camera on the static tweezers' own light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from labseq_virtual.devices import VirtualSpotMeter
from labseq_virtual.settings import SimulationSettings, SpotMeterSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq import Context, DepthRamp, DeviceError, RandomStream, SiteGrid, TweezerAmplitudes
from labseq.testing import DeviceContract
from labseq.testing.fakes import FakeClock

GRID = SiteGrid(12, 15)


def in_the_world(context: Context) -> Context:
    physics = SimulationSettings.model_validate({"depth_disorder": 0.04, "tone_response": 0.06})
    return replace(context, simulation=VirtualSimulation(physics, context))


class TestVirtualSpotMeter(DeviceContract):
    values: ClassVar = ("spot_powers",)

    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualSpotMeter]:
        return lambda context: VirtualSpotMeter(SpotMeterSettings(), context)


@pytest.fixture
def context() -> Context:
    return in_the_world(Context("trap_camera", GRID, clock=FakeClock(), random=RandomStream(4)))


def meter(
    context: Context, noise: float = 0.0, level: float = 1.0
) -> tuple[VirtualSpotMeter, VirtualSimulation]:
    """One that is open, on a world with the light on."""
    world = context.simulation
    assert isinstance(world, VirtualSimulation)
    world.open()
    context.random.begin_shot(0, 0)
    world.begin_shot()
    world.play("static_tweezers", DepthRamp(0.0, level), 0.0)
    made = VirtualSpotMeter(SpotMeterSettings(noise=noise), context)
    made.open()
    return made, world


def test_it_measures_the_depth_of_each_tweezer(context: Context) -> None:
    spots, world = meter(context)
    before = spots.read("spot_powers")
    assert before.shape == GRID.shape
    assert before.dtype == np.float64
    np.testing.assert_array_equal(before, world.spot_powers())
    world.play("static_tweezers", TweezerAmplitudes(np.full(12, 0.5 / 12), np.full(15, 1 / 15)), 0.0)
    np.testing.assert_allclose(spots.read("spot_powers"), 0.25 * before)


def test_no_light_is_no_power(context: Context) -> None:
    spots, _ = meter(context, noise=0.02, level=0.0)
    assert not spots.read("spot_powers").any()


def test_its_noise_is_relative_and_new_each_time(context: Context) -> None:
    spots, world = meter(context, noise=0.05)
    off = np.stack([spots.read("spot_powers") for _ in range(50)]) / world.spot_powers() - 1
    assert off.std() == pytest.approx(0.05, rel=0.05)
    assert abs(off.mean()) < 4 * 0.05 / off.size**0.5
    assert abs(np.corrcoef(off[0].ravel(), off[1].ravel())[0, 1]) < 0.3


def test_a_measurement_takes_its_time(context: Context) -> None:
    spots, _ = meter(context)
    start_s = context.clock.now()
    spots.read("spot_powers")
    assert context.clock.now() - start_s == pytest.approx(20e-3)


def test_it_only_measures(context: Context) -> None:
    spots, _ = meter(context)
    with pytest.raises(
        DeviceError, match="trap_camera: unknown command 'on'; it only measures: read 'spot_powers'"
    ):
        spots.command("on")
    with pytest.raises(DeviceError, match="trap_camera: unknown value 'power'; expected 'spot_powers'"):
        spots.read("power")


def test_it_tells_its_settings(context: Context) -> None:
    spots, _ = meter(context, noise=0.03)
    assert spots.describe() == {"model": "virtual spot meter", "noise": 0.03, "duration": 0.02}
