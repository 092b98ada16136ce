"""One suite of tests per kind of plugin. A plugin's test class inherits the suite of its kind."""

from collections.abc import Mapping
from typing import Any, Final

from labseq.testing.contracts.camera import CameraContract
from labseq.testing.contracts.deciders import AnalysisContract, DetectorContract, ScannerContract
from labseq.testing.contracts.hardware import HardwareContract, Wait
from labseq.testing.contracts.instruments import DeviceContract, LinesContract
from labseq.testing.contracts.planner import PatternContract, PlannerContract
from labseq.testing.contracts.promises import ContractViolation
from labseq.testing.contracts.simulation import SimulationContract
from labseq.testing.contracts.step import StepContract
from labseq.testing.contracts.tweezers import MobileTweezersContract, StaticTweezersContract

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
"""Kind of plugin, as in the registry -> its suite."""

__all__ = [
    "SUITES",
    "AnalysisContract",
    "CameraContract",
    "ContractViolation",
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
