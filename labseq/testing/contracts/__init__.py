"""One suite of tests per kind of plugin; a plugin's test class inherits the suite of its kind."""

from collections.abc import Mapping
from typing import Any, Final

from labseq.testing.contracts.analysis import AnalysisContract
from labseq.testing.contracts.camera import CameraContract
from labseq.testing.contracts.detector import DetectorContract
from labseq.testing.contracts.device import DeviceContract
from labseq.testing.contracts.hardware import HardwareContract, Wait
from labseq.testing.contracts.lines import LinesContract
from labseq.testing.contracts.mobile_tweezers import MobileTweezersContract
from labseq.testing.contracts.pattern import PatternContract
from labseq.testing.contracts.planner import PlannerContract
from labseq.testing.contracts.promises import ContractViolation
from labseq.testing.contracts.scanner import ScannerContract
from labseq.testing.contracts.simulation import SimulationContract
from labseq.testing.contracts.static_tweezers import StaticTweezersContract
from labseq.testing.contracts.step import StepContract

SUITES: Final[Mapping[str, type[Any]]] = {
    "planner": PlannerContract,
    "camera": CameraContract,
    "static_tweezers": StaticTweezersContract,
    "mobile_tweezers": MobileTweezersContract,
    "detector": DetectorContract,
    "device": DeviceContract,
    "lines": LinesContract,
    "step": StepContract,
    "pattern": PatternContract,
    "simulation": SimulationContract,
    "scanner": ScannerContract,
    "analysis": AnalysisContract,
}
"""Kind of plugin, as the registry knows it -> its suite."""

__all__ = [
    "SUITES",
    "AnalysisContract",
    "ContractViolation",
    "CameraContract",
    "DetectorContract",
    "DeviceContract",
    "HardwareContract",
    "LinesContract",
    "MobileTweezersContract",
    "PatternContract",
    "PlannerContract",
    "ScannerContract",
    "SimulationContract",
    "StaticTweezersContract",
    "StepContract",
    "Wait",
]
