"""Series of frames with an open camera."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from labseq.plugin import (
    Clock,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    Trigger,
    format_quantity,
    wait_for,
)
from labseq.plugin.camera import ExposureResult
from labseq_pylon.library import Nodes, Sdk
from labseq_pylon.setup import WIDTH, series_trigger, ticks_per_s

BUFFER_BYTES: Final = 256 * 2**20
"""Memory for frames that were not read yet; a series that needs more reuses its buffers."""
GIGE: Final = "BaslerGigE"
MAX_GIGE_FRAMES: Final = 65535
"""GigE cameras number their frames from 1, with 16 bits."""
NO_NUMBER: Final = 2**64 - 1


class Acquisition:
    """The series of an open camera.

    Args:
        ready_s: How long the camera may take until it accepts a trigger, in seconds.
    """

    def __init__(self, sdk: Sdk, camera: Any, nodes: Nodes, clock: Clock, ready_s: float) -> None:
        self._sdk = sdk
        self._camera = camera
        self._nodes = nodes
        self._clock = clock
        self._ready_s = ready_s
        self._is_gige = camera.GetDeviceInfo().GetDeviceClass() == GIGE
        self._ticks_per_s = ticks_per_s(nodes)
        self._exposure_s = math.nan

    def set_exposure(self, exposure_s: float, trigger: Trigger) -> None:
        """Set the exposure time, which the pulse makes with bulb; frames carry what the camera accepted."""
        self._check_connected()
        self._exposure_s = exposure_s
        if trigger == "bulb":
            return
        node = self._nodes.get("exposure time", "ExposureTime", "ExposureTimeAbs")
        taken_us = self._nodes.set_real(node, "exposure", 1e6 * exposure_s, _microseconds)
        self._exposure_s = 1e-6 * taken_us

    def set_trigger(self, trigger: Trigger, line: str, edge: str) -> None:
        """Choose what starts the exposures.

        Args:
            trigger: The trigger.
            line: Input of the external one.
            edge: Its edge, "rising" or "falling".
        """
        choose = self._nodes.choose
        if series := series_trigger(self._nodes):
            choose("TriggerSelector", "trigger", series[0], if_there=True)
            choose("TriggerMode", "trigger mode", "On" if trigger == "external_start" else "Off")
            if trigger == "external_start":
                self._set_line(line, edge)
        choose("TriggerSelector", "trigger", "FrameStart", if_there=True)
        if trigger != "external_start":
            self._nodes.switch_off("AcquisitionFrameRateEnable")
        has_none = trigger in ("internal", "external_start")
        choose("TriggerMode", "trigger mode", "Off" if has_none else "On")
        if trigger == "software":
            choose("TriggerSource", "trigger source", "Software")
        elif trigger in ("external", "bulb"):
            self._set_line(line, edge)
        choose(
            "ExposureMode",
            "exposure mode",
            WIDTH if trigger == "bulb" else "Timed",
            if_there=trigger != "bulb",
        )
        if trigger == "bulb" and (
            node := self._nodes.find("ExposureOverlapTimeMax", "ExposureOverlapTimeMaxAbs")
        ):
            self._nodes.set_real(node, "overlap of exposures", node.Min)  # no pulse may be shorter

    def set_cycle(self, n_frames: int, cycle_s: float) -> None:
        """Set how many exposures an external start begins, and their distance in time."""
        nodes = self._nodes
        if series := series_trigger(nodes):
            nodes.choose("TriggerSelector", "trigger", series[0])
            nodes.set_integer(
                nodes.get("number of frames of a start", series[1]), "number of frames", n_frames
            )
        enable = nodes.get("frame rate", "AcquisitionFrameRateEnable")
        with self._sdk.doing("set its frame rate"):
            enable.SetValue(True)
        rate = nodes.get("frame rate", "AcquisitionFrameRate", "AcquisitionFrameRateAbs")
        nodes.set_real(rate, "frame rate", 1.0 / cycle_s)

    def _set_line(self, line: str, edge: str) -> None:
        self._nodes.choose("TriggerSource", "trigger source", line)
        activation = {"rising": "RisingEdge", "falling": "FallingEdge"}[edge]
        self._nodes.choose("TriggerActivation", "trigger edge", activation)

    def start(self, n_frames: int) -> None:
        """Queue the buffers and start; with the internal trigger the first exposure begins."""
        if self._is_gige and n_frames > MAX_GIGE_FRAMES:
            what = f"{self._sdk.name}: number of frames"
            raise LimitError(what, n_frames, f"{MAX_GIGE_FRAMES}, the highest frame number of GigE cameras")
        with self._sdk.doing("start the series"):
            n_buffers = BUFFER_BYTES // max(1, self._camera.PayloadSize.GetValue())
            self._camera.MaxNumBuffer.SetValue(max(2, min(n_frames, n_buffers)))
            self._camera.StartGrabbingMax(n_frames, self._sdk.pylon.GrabStrategy_OneByOne)

    def wait_until_ready(self) -> None:
        """Wait until the camera accepts a trigger."""
        camera, pylon = self._camera, self._sdk.pylon

        def ready(seconds: float) -> bool | None:
            self._check_connected()
            milliseconds = _milliseconds(seconds)
            return camera.WaitForFrameTriggerReady(milliseconds, pylon.TimeoutHandling_Return) or None

        with self._sdk.doing("trigger"):
            can_tell = camera.CanWaitForFrameTriggerReady()
            if can_tell and wait_for(ready, self._ready_s, self._clock) is None:
                text = f"not ready for a trigger within {format_quantity(self._ready_s, 'time')}"
                hint = "leave more time between exposures than the camera needs to read one out"
                raise DeviceTimeoutError(self._sdk.name, f"{text}; {hint}", self._ready_s)

    def trigger(self) -> None:
        """Start an exposure."""
        with self._sdk.doing("trigger"):
            self._camera.ExecuteSoftwareTrigger()

    def poll(self, seconds: float) -> ExposureResult | None:
        """Wait for the next buffer, for at most ``seconds``; None if none came."""
        camera, pylon = self._camera, self._sdk.pylon
        with self._sdk.doing("read a frame"):
            result = camera.RetrieveResult(_milliseconds(seconds), pylon.TimeoutHandling_Return)
            if not result.IsValid():
                self._check_connected()
                return None
            try:
                return self._taken(result)
            finally:
                result.Release()

    def stop(self) -> None:
        """End the series; frames that were not read are dropped."""
        with self._sdk.doing("stop"):
            self._camera.StopGrabbing()

    def _check_connected(self) -> None:
        """Raise if the camera is gone: not every call of pylon fails then."""
        if self._camera.IsCameraDeviceRemoved():
            raise DeviceError(self._sdk.name, "the camera is gone; check its cable and power")

    def _taken(self, result: Any) -> ExposureResult:
        number = result.BlockID - int(self._is_gige)
        if result.BlockID == NO_NUMBER:
            number = result.ImageNumber - 1
        if not result.GrabSucceeded():
            code = f" (0x{result.ErrorCode:08X})" if result.ErrorCode else ""
            return ExposureResult(number, None, f"{result.ErrorDescription.rstrip('. ')}{code}")
        image = np.asarray(result.Array).astype(np.uint16, copy=False)
        device_time_s = result.TimeStamp / self._ticks_per_s if result.TimeStamp else math.nan
        return ExposureResult(number, image, exposure_s=self._exposure_s, device_time_s=device_time_s)


def _milliseconds(seconds: float) -> int:
    return max(1, round(1e3 * seconds))


def _microseconds(value: float) -> str:
    return format_quantity(1e-6 * value, "time")
