"""The steps that come with labseq keep the promises of a step."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from labseq.builtin.equalise import EqualiseSettings, EqualiseStep
from labseq.builtin.probes import (
    CheckOverlaySettings,
    CheckOverlayStep,
    CheckSitesSettings,
    CheckSitesStep,
    ProbeSettings,
    ProbeStep,
)
from labseq.builtin.rearrange import RearrangeSettings, RearrangeStep
from labseq.builtin.steps import (
    DeviceSettings as DeviceStepSettings,
    DeviceStep,
    ImageSettings,
    ImageStep,
    LoadSettings,
    LoadStep,
    RampSettings,
    RampStep,
    WaitSettings,
    WaitStep,
)
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.model import SiteGrid
from labseq.plugin import Context
from labseq.testing import StepContract
from labseq.testing.fakes import FakeLab, fake_lab

Factory = Callable[..., Any]


STEPS: dict[str, Any] = {
    "load": LoadStep(LoadSettings(duration=0.5)),
    "image": ImageStep(ImageSettings(exposure=0.045)),
    "rearrange": RearrangeStep(RearrangeSettings(cycles=3, window=0.06, exposure=0.045)),
    "rearrange in a fixed window": RearrangeStep(
        RearrangeSettings(cycles=2, window=0.06, exposure=0.045, window_mode="fixed")
    ),
    "probe": ProbeStep(ProbeSettings(offset=(0.3e-6, 0.0), sites="all")),
    "probe in a cross": ProbeStep(ProbeSettings(offset=(0.9e-6, 0.9e-6), pattern="cross")),
    "check_overlay": CheckOverlayStep(CheckOverlaySettings()),
    "ramp": RampStep(RampSettings(depth=0.5)),
    "wait": WaitStep(WaitSettings(duration=0.01)),
    "device": DeviceStep(DeviceStepSettings(name="shutter", do="on")),
}


@pytest.fixture(params=STEPS)
def step(request: pytest.FixtureRequest) -> Any:
    return STEPS[request.param]


class TestSteps(StepContract):
    @pytest.fixture
    def factory(self, step: Any) -> Factory:
        return lambda: step


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


class TestEqualise(StepContract):
    def lab(self) -> FakeLab:
        lab = fake_lab(devices=("trap_camera",), simulated=True)
        vars(lab.devices["trap_camera"])["read"] = lambda _name: np.ones((4, 4))
        return lab

    @pytest.fixture
    def factory(self) -> Factory:
        return partial(EqualiseStep, EqualiseSettings())
