"""What comes with labseq keeps the promises of its role; the virtual drivers act on their world."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from labseq_psca.planner import PscaPlanner, PscaSettings
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.device import VirtualDevice
from labseq_virtual.mobile_tweezers import VirtualMobileTweezers
from labseq_virtual.settings import (
    CameraSettings,
    DeviceSettings,
    MobileTweezersSettings,
    StaticTweezersSettings,
    WorldSettings,
)
from labseq_virtual.static_tweezers import VirtualStaticTweezers
from labseq_virtual.world import World

from labseq import Context
from labseq.config.detectors import ThresholdSettings
from labseq.config.steps import (
    CheckOverlaySettings,
    CheckSitesSettings,
    DeviceSettings as DeviceStepSettings,
    EqualiseSettings,
    ImageSettings,
    LoadSettings,
    ProbeSettings,
    RampSettings,
    RearrangeSettings,
    WaitSettings,
)
from labseq.imaging import ThresholdDetector
from labseq.model import SiteGrid
from labseq.sequencer.equalise import EqualiseStep
from labseq.sequencer.probe import ProbeStep
from labseq.sequencer.ramp import RampStep
from labseq.sequencer.rearrange import RearrangeStep
from labseq.sequencer.steps import DeviceStep, ImageStep, LoadStep, WaitStep
from labseq.sequencer.watching import CheckOverlayStep, CheckSitesStep
from labseq.testing import (
    CameraContract,
    DetectorContract,
    DeviceContract,
    MobileTweezersContract,
    PlannerContract,
    StaticTweezersContract,
    StepContract,
)
from labseq.testing.fakes import FakeLab, fake_lab

Factory = Callable[..., Any]


def in_the_world(context: Context) -> Context:
    return replace(context, simulation=World(WorldSettings(), context))


class TestPsca(PlannerContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(PscaPlanner, PscaSettings())


class TestPscaOneAtATime(PlannerContract):
    n_examples: ClassVar[int] = 20

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(PscaPlanner, PscaSettings(degree_of_parallelism=1))


class TestPscaWithFewTones(PlannerContract):
    n_examples: ClassVar[int] = 20

    def context(self, shape: tuple[int, int]) -> Context:
        context = super().context(shape)
        return replace(context, motion=replace(context.motion, max_row_tones=2, max_column_tones=3))

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(PscaPlanner, PscaSettings(degree_of_parallelism=15))


class TestVirtualCamera(CameraContract):
    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(VirtualCamera, CameraSettings())


class TestVirtualStaticTweezers(StaticTweezersContract):
    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(VirtualStaticTweezers, StaticTweezersSettings())


class TestVirtualMobileTweezers(MobileTweezersContract):
    def context(self) -> Context:
        return in_the_world(super().context())

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(VirtualMobileTweezers, MobileTweezersSettings())


class TestVirtualDevice(DeviceContract):
    commands: ClassVar = {"open": {}, "set": {"power": 0.5}}
    values: ClassVar = ("state", "power")

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(VirtualDevice, DeviceSettings(commands=("open", "set"), values={"power": 0.0}))


class TestThresholdDetector(DetectorContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(ThresholdDetector, ThresholdSettings())


class TestLoad(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(LoadStep, LoadSettings(duration=0.5))


class TestImage(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(ImageStep, ImageSettings(exposure=0.045))


class TestRearrange(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(RearrangeStep, RearrangeSettings(cycles=3, window=0.06, exposure=0.045))


class TestRearrangeInAFixedWindow(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        settings = RearrangeSettings(cycles=2, window=0.06, exposure=0.045, window_mode="fixed")
        return partial(RearrangeStep, settings)


class TestProbe(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(ProbeStep, ProbeSettings(offset=(0.3e-6, 0.0), sites="all"))


class TestProbeInACross(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(ProbeStep, ProbeSettings(offset=(0.9e-6, 0.9e-6), pattern="cross"))


class TestCheckSites(StepContract):
    def lab(self) -> FakeLab:
        settings = ThresholdSettings(frame=(64, 64), centre_px=(31.5, 31.5), offset=0.0, threshold=-1.0)
        grid = SiteGrid(4, 4)
        detector = ThresholdDetector(settings, Context("detector", grid))
        lab = fake_lab(grid=grid, detector=detector, simulated=True)
        vars(lab.camera)["frame_shape"] = settings.frame
        return lab

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(CheckSitesStep, CheckSitesSettings())


class TestCheckOverlay(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(CheckOverlayStep, CheckOverlaySettings())


class TestEqualise(StepContract):
    def lab(self) -> FakeLab:
        lab = fake_lab(devices=("trap_camera",), simulated=True)
        vars(lab.devices["trap_camera"])["read"] = lambda _name: np.ones((4, 4))
        return lab

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(EqualiseStep, EqualiseSettings())


class TestRamp(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(RampStep, RampSettings(depth=0.5))


class TestWait(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(WaitStep, WaitSettings(duration=0.01))


class TestDevice(StepContract):
    @pytest.fixture
    def factory(self) -> Factory:
        return partial(DeviceStep, DeviceStepSettings(name="shutter", do="on"))
