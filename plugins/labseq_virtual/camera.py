"""The virtual camera."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from labseq import (
    CameraFacts,
    Context,
    DeviceError,
    DeviceTimeoutError,
    Frame,
    LimitError,
    TransientError,
    Trigger,
)
from labseq.units import format_quantity
from labseq_virtual.driver import VirtualDriver
from labseq_virtual.settings import CameraSettings

TEST_EXPOSURE_S: Final = 10e-3


class VirtualCamera(VirtualDriver):
    """Frames of the simulated world, with a real camera's manners.

    It must be armed before it is triggered, exposes as often as it was armed for,
    and delivers a frame when its exposure and read-out have passed on the clock.

    Args:
        settings: Read-out time, limits, failures to rehearse.
        context: Clock, random numbers and the simulated world.
    """

    def __init__(self, settings: CameraSettings, context: Context) -> None:
        super().__init__(context, "camera")
        self._settings = settings
        self._exposure_s = 0.0
        self._n_triggers_left = 0
        self._exposing_until_s = 0.0
        self._frames: deque[tuple[float, Frame]] = deque()

    @property
    def facts(self) -> CameraFacts:
        """Read-out time (less for a part of the sensor), longest exposure, shape of the simulated frames."""
        shape = getattr(self._world, "frame_shape", None)
        readout_s = self._settings.readout * getattr(self._world, "readout_fraction", 1.0)
        return CameraFacts(readout_s, self._settings.max_exposure, shape)

    def warm(self) -> None:
        """Compile the kernels of the simulated frames, or load them from the cache."""
        importlib.import_module("labseq_virtual._kernels_image")

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of exposures; frames not yet read are dropped.

        Raises:
            LimitError: No frames, or an exposure that the camera cannot make.
            DeviceError: Not open, or a trigger that needs a wire.
        """
        self._check_open()
        if n_frames < 1:
            raise LimitError(f"{self._name}: number of frames", n_frames, "at least 1")
        longest_s = self._settings.max_exposure
        if not 0 < exposure_s <= longest_s:
            raise LimitError(
                f"{self._name}: exposure",
                format_quantity(exposure_s, "time"),
                f"more than 0 and at most {format_quantity(longest_s, 'time')}",
                "choose another exposure, or raise `max_exposure` of the camera",
            )
        if trigger != "software":
            raise DeviceError(
                self._name, f"a virtual camera has no wire for the {trigger} trigger; expected 'software'"
            )
        self._frames.clear()
        self._exposure_s = exposure_s
        self._n_triggers_left = n_frames

    def trigger(self) -> None:
        """Start the next exposure of the series; returns at once.

        Raises:
            DeviceError: Not armed, all exposures made, or still exposing.
        """
        self._check_open()
        now_s = self._clock.now()
        if self._n_triggers_left == 0:
            raise DeviceError(self._name, "triggered, but not armed for another frame; call arm() first")
        if now_s < self._exposing_until_s:
            raise DeviceError(
                self._name, f"triggered during an exposure that ends at {self._exposing_until_s:.6f} s"
            )
        self._n_triggers_left -= 1
        if self._happens(self._settings.faults.missed_trigger):
            return
        frame = self._world.expose(now_s, self._exposure_s)
        self._exposing_until_s = now_s + self._exposure_s
        ready_s = self._exposing_until_s + self.facts.readout_s
        self._frames.append((ready_s, replace(frame, camera=self._name)))

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame not yet read.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
            TransientError: The frame was lost (a failure to rehearse).
        """
        self._check_open()
        missing_s = self._frames[0][0] - self._clock.now() if self._frames else float("inf")
        if missing_s > timeout_s:
            self._clock.sleep(timeout_s)
            reason = "is not ready" if self._frames else "was not triggered"
            text = f"no frame within {format_quantity(timeout_s, 'time')}: the next one {reason}"
            raise DeviceTimeoutError(self._name, text, timeout_s)
        self._clock.sleep(max(0.0, missing_s))
        _, frame = self._frames.popleft()
        if self._happens(self._settings.faults.transient):
            raise TransientError("a frame was lost on its way (rehearsed failure)", self._name)
        return frame

    def safe_state(self) -> None:
        """Stop exposing and drop all frames."""
        self._frames.clear()
        self._n_triggers_left = 0
        self._exposing_until_s = 0.0

    def self_test(self) -> None:
        """Take a frame; those not yet read are dropped.

        Raises:
            DeviceError: Not open, no frame came, or it has another shape than the camera says.
            TransientError: The frame was lost (a failure to rehearse).
        """
        exposure_s = min(TEST_EXPOSURE_S, self._settings.max_exposure)
        self.arm(1, exposure_s, "software")
        self.trigger()
        shape, told = self.read(exposure_s + self.facts.readout_s + 1.0).image.shape, self.facts.frame_shape
        if told is not None and shape != told:
            raise DeviceError(self._name, f"a frame has the shape {shape}; expected {told}")

    def describe(self) -> Mapping[str, Any]:
        """Model and settings."""
        return {"model": "virtual camera", **self._settings.model_dump(mode="json")}

    def _happens(self, probability: float) -> bool:
        """Draw a failure; no number is drawn for one that never comes."""
        return probability > 0 and self._random.shot.random() < probability
