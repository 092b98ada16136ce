"""What can be calibrated, and how."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from labseq.session.calibrate.frequencies import FrequenciesMethod
from labseq.session.calibrate.method import Method
from labseq.session.calibrate.overlay import OverlayMethod
from labseq.session.calibrate.sites import SitesMethod
from labseq.session.calibrate.thresholds import ThresholdsMethod
from labseq.session.calibrate.tweezers import TweezersMethod

_ALL: Final[tuple[Method, ...]] = (
    SitesMethod(),
    ThresholdsMethod(),
    TweezersMethod(),
    FrequenciesMethod(),
    OverlayMethod(),
)

METHODS: Final[Mapping[str, Method]] = {method.kind: method for method in _ALL}
"""Kind of calibration -> how it is made."""
