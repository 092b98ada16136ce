"""The library of a camera maker. There is no camera behind it: its frames are noise."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray


class AcmeError(Exception):
    """What the library raises."""


class Camera:
    """Connects to the camera with a serial number."""

    def __init__(self, serial: str) -> None:
        if serial != "A-17":
            raise AcmeError(f"no camera '{serial}' found")
        self.firmware = "2.1"
        self._noise = np.random.default_rng(17)
        self._exposure_ms = 1.0
        self.stop()

    def set_exposure_ms(self, exposure_ms: float) -> None:
        """Set the exposure of the frames to come."""
        self._exposure_ms = exposure_ms

    def start(self) -> None:
        """Start the acquisition; frames are counted from 1."""
        self._is_running, self._n_frames, self._due_s = True, 0, list[float]()

    def stop(self) -> None:
        """End the acquisition; frames that were not read are dropped."""
        self._is_running, self._n_frames, self._due_s = False, 0, list[float]()

    def fire(self) -> None:
        """Send a software trigger."""
        if not self._is_running:
            raise AcmeError("no acquisition is running")
        self._due_s.append(time.monotonic() + 1e-3 * self._exposure_ms)

    def get_frame(self, timeout_ms: float) -> tuple[int, NDArray[np.uint16]] | None:
        """Wait for a frame: its number and its pixels; None if none came."""
        missing_s = self._due_s[0] - time.monotonic() if self._due_s else float("inf")
        time.sleep(max(0.0, min(missing_s, 1e-3 * timeout_ms)))
        if missing_s > 1e-3 * timeout_ms:
            return None
        del self._due_s[0]
        self._n_frames += 1
        return self._n_frames, self._noise.integers(490, 510, (512, 512), np.uint16)

    def close(self) -> None:
        """Disconnect."""
        self.stop()
