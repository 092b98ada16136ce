"""The virtual drivers keep the promises of their roles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import ClassVar

import pytest
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.devices import VirtualDevice
from labseq_virtual.settings import (
    CameraSettings,
    DeviceSettings,
    MobileTweezersSettings,
    SimulationSettings,
    StaticTweezersSettings,
)
from labseq_virtual.simulation import VirtualSimulation
from labseq_virtual.tweezers import VirtualMobileTweezers, VirtualStaticTweezers

from labseq import Context
from labseq.testing import (
    CameraContract,
    DeviceContract,
    MobileTweezersContract,
    SimulationContract,
    StaticTweezersContract,
)


class TestVirtualCamera(CameraContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualCamera]:
        return partial(VirtualCamera, CameraSettings())


class TestVirtualCameraWithEverything(CameraContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualCamera]:
        settings = {
            "region": {"y": 10, "x": 20, "height": 100, "width": 60},
            "binning": 2,
            "em_gain": 300,
            "cooling": {"temperature": "-70 degC"},
        }
        return partial(VirtualCamera, CameraSettings.model_validate(settings))


class TestVirtualStaticTweezers(StaticTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualStaticTweezers]:
        return partial(VirtualStaticTweezers, StaticTweezersSettings())


class TestVirtualMobileTweezers(MobileTweezersContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualMobileTweezers]:
        return partial(VirtualMobileTweezers, MobileTweezersSettings())


class TestVirtualDevice(DeviceContract):
    commands: ClassVar = {"open": {}, "set": {"power": 0.5}}
    values: ClassVar = ("state", "power")

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualDevice]:
        return partial(VirtualDevice, DeviceSettings(commands=("open", "set"), values={"power": 1.0}))


class TestVirtualWorld(SimulationContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualSimulation]:
        settings = {"image": {"frame": [80, 96], "centre_px": [39.5, 47.5]}}
        return partial(VirtualSimulation, SimulationSettings.model_validate(settings))


def in_the_world(context: Context) -> Context:
    return replace(context, simulation=VirtualSimulation(SimulationSettings(), context))


class TestVirtualCameraInItsWorld(CameraContract):
    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualCamera]:
        return partial(VirtualCamera, CameraSettings())


class TestVirtualStaticTweezersInTheirWorld(StaticTweezersContract):
    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualStaticTweezers]:
        return partial(VirtualStaticTweezers, StaticTweezersSettings())


class TestVirtualMobileTweezersInTheirWorld(MobileTweezersContract):
    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualMobileTweezers]:
        return partial(VirtualMobileTweezers, MobileTweezersSettings())
