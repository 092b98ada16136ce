"""What a camera is armed for, and what comes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.roles import Trigger


@dataclass(frozen=True, slots=True)
class Series:
    """What a camera was armed for.

    Attributes:
        n_frames: Number of exposures.
        exposure_s: Exposure time, in seconds.
        trigger: What starts each exposure.
        em_gain: Mean gain of the EM register; 1 for none.
    """

    n_frames: int
    exposure_s: float
    trigger: Trigger
    em_gain: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ExposureResult:
    """What came of one exposure.

    Attributes:
        number: Its place in the series as the camera counted it, from 0.
        image: uint16 (height, width), nobody else's; None if the frame was lost.
        fault: What happened to a frame that was lost.
        exposure_s: Exposure time as the camera made it, in seconds; nan: as asked for.
        t_start_s: Start of the exposure on the session's clock; nan: worked out from the trigger.
        device_time_s: The camera's own time stamp, in seconds; nan if it gives none.
    """

    number: int
    image: NDArray[np.uint16] | None
    fault: str = ""
    exposure_s: float = math.nan
    t_start_s: float = math.nan
    device_time_s: float = math.nan
