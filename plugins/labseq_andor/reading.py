"""Frames of a series, fetched from the SDK's ring buffer."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Final

import numpy as np

from labseq.plugin import DeviceError, ExposureResult
from labseq_andor.codes import Code, Features
from labseq_andor.errors import GONE, NOT_TAKEN, explain_code
from labseq_andor.sdk import Sdk, code_of

OVERRUN: Final = "the computer did not take the camera's data over in time"


class Reader:
    """Fetches the frames of one series, in order.

    Args:
        sdk: The camera.
        shape: (height, width) of the frames.
        exposure_s: Exposure as the camera makes it, in seconds.
        name: Name of the device, for errors.

    Attributes:
        n_taken: Frames fetched, or known to be lost.
    """

    def __init__(self, sdk: Sdk, shape: tuple[int, int], exposure_s: float, name: str) -> None:
        self._sdk = sdk
        self._shape = shape
        self._exposure_s = exposure_s
        self._name = name
        self._has_time_stamps = bool(sdk.capabilities.ulFeatures & Features.METADATA)
        self.n_taken = 0

    def look(self, wait_s: float) -> ExposureResult | None:
        """Fetch the oldest frame; wait for one at most so long.

        Raises:
            DeviceError: The camera is gone.
        """
        number = self._oldest()
        if number is None:
            fault = self._fault()
            if fault:
                self.n_taken += 1
                return ExposureResult(self.n_taken - 1, None, fault)
            if wait_s <= 0 or not self._sdk.wait(wait_s):
                return None
            number = self._oldest()
        return None if number is None else self._fetch(number)

    def _oldest(self) -> int | None:
        """Number, from 1, of the oldest frame not yet fetched."""
        try:
            with self._sdk.selected() as lib:
                first, _ = lib.GetNumberNewImages()
        except DeviceError as error:
            if code_of(error) == Code.NO_NEW_DATA:
                return None
            raise
        return int(first)

    def _fault(self) -> str:
        """Why no frame will come any more; "" if there is no reason known."""
        with self._sdk.selected() as lib:
            status = int(lib.GetStatus())
        if status in GONE:
            raise DeviceError(self._name, explain_code("GetStatus", status))
        return f"{OVERRUN} (GetStatus gave {status})" if status in NOT_TAKEN else ""

    def _fetch(self, number: int) -> ExposureResult:
        height, width = self._shape
        with self._sdk.selected() as lib:
            pixels, _, _ = lib.GetImages16(number, number, height * width)
        self.n_taken = number
        image = np.ascontiguousarray(pixels, np.uint16).reshape(height, width)
        time_s = math.nan
        if self._has_time_stamps:
            with suppress(DeviceError):  # a frame is worth more than its time stamp
                time_s = self._sdk.time_stamp_s(number - 1)
        return ExposureResult(number - 1, image, exposure_s=self._exposure_s, device_time_s=time_s)
