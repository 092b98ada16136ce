"""Calibrations made: a run, its analysis, and an entry in the profile's store."""

from labseq.session.calibrate.kinds import METHODS
from labseq.session.calibrate.making import CalibrationRequest, Outcome, calibrate
from labseq.session.calibrate.method import CalibrationData, AnalysisResult, Method

__all__ = ["METHODS", "CalibrationRequest", "CalibrationData", "AnalysisResult", "Method", "Outcome", "calibrate"]
