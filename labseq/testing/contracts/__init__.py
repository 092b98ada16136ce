"""One suite of tests per role; a plugin's test class inherits the suite of its role."""

from labseq.testing.contracts.camera import CameraContract
from labseq.testing.contracts.detector import DetectorContract
from labseq.testing.contracts.device import DeviceContract
from labseq.testing.contracts.hardware import HardwareContract, Wait
from labseq.testing.contracts.lines import LinesContract
from labseq.testing.contracts.mobile_tweezers import MobileTweezersContract
from labseq.testing.contracts.planner import PlannerContract
from labseq.testing.contracts.promises import BrokenPromise
from labseq.testing.contracts.static_tweezers import StaticTweezersContract
from labseq.testing.contracts.step import StepContract

__all__ = [
    "BrokenPromise",
    "CameraContract",
    "DetectorContract",
    "DeviceContract",
    "HardwareContract",
    "LinesContract",
    "MobileTweezersContract",
    "PlannerContract",
    "StaticTweezersContract",
    "StepContract",
    "Wait",
]
