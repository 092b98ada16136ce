import pytest

import labseq.testing


def test_every_public_name_resolves() -> None:
    for name in (
        "SUITES",
        "AnalysisContract",
        "ContractViolation",
        "CameraContract",
        "DetectorContract",
        "DeviceContract",
        "MobileTweezersContract",
        "PatternContract",
        "PlannerContract",
        "ScannerContract",
        "SimulationContract",
        "StaticTweezersContract",
        "StepContract",
        "fakes",
        "strategies",
    ):
        assert getattr(labseq.testing, name) is not None
        assert name in dir(labseq.testing)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'LaserContract'"):
        _ = labseq.testing.LaserContract  # pyright: ignore[reportAttributeAccessIssue] - what is tested
