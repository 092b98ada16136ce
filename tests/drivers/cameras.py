"""A camera as small as can be, that counts on by itself as a real one does."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from labseq.plugin import CameraFacts, Context, Frame, LineSpec
from labseq.plugin.camera import CameraDriver, ExposureResult, Series
from labseq.testing.fakes import FakeClock

SHAPE = (3, 4)


class TinyCamera(CameraDriver):
    """Each trigger makes a frame, which is ready after exposure and read-out.

    ``lose`` names frames that are lost, with what the camera reports of them; "" is a gap. ``log`` has the
    methods that the base called, ``broken`` those that raise; ``tells`` are further values of its frames.
    """

    def __init__(self, context: Context, facts: CameraFacts, lose: Mapping[int, str] | None = None) -> None:
        super().__init__(context)
        self._facts = facts
        self._lose = lose or {}
        self.log: list[str] = []
        self.series: list[Series] = []
        self.broken: set[str] = set()
        self.tells: dict[str, Any] = {}
        self.shape: tuple[int, int] = SHAPE
        self.coming: deque[tuple[float, ExposureResult]] = deque()
        self._n_made = 0

    @property
    def facts(self) -> CameraFacts:
        return self._facts

    def describe(self) -> Mapping[str, Any]:
        return {"model": "tiny"}

    def _connect(self) -> None:
        self._note("connect")

    def _disconnect(self) -> None:
        self._note("disconnect")

    def _start(self, series: Series) -> None:
        self._note("start")
        self.series.append(series)
        self.coming.clear()
        self._n_made = 0
        if series.trigger == "internal":
            for _ in range(series.n_frames):
                self._make()

    def _fire(self) -> None:
        self._note("fire")
        self._make()

    def _take(self, timeout_s: float) -> ExposureResult | None:
        self._note("take")
        missing_s = self.coming[0][0] - self._clock.now() if self.coming else math.inf
        self._clock.sleep(max(0.0, min(missing_s, timeout_s)))
        return None if missing_s > timeout_s else self.coming.popleft()[1]

    def _stop(self) -> None:
        self._note("stop")

    def _note(self, name: str) -> None:
        self.log.append(name)
        if name in self.broken:
            raise RuntimeError(f"{name} is broken")

    def _make(self) -> None:
        """Expose; a frame that is lost without a word leaves only a gap in the numbers."""
        number, self._n_made = self._n_made, self._n_made + 1
        exposure_s = self.series[-1].exposure_s
        due_s = self._clock.now() + exposure_s + self._facts.readout_s
        fault = self._lose.get(number)
        if fault is None:
            image = np.full(self.shape, number, np.uint16)
            self.coming.append((due_s, ExposureResult(number, image, **self.tells)))
        elif fault:
            self.coming.append((due_s, ExposureResult(number, None, fault)))


class Bench:
    """A tiny camera on a clock that costs no time; it is open."""

    def __init__(self, lose: Mapping[int, str] | None = None, **facts: Any) -> None:
        self.clock = FakeClock()
        known: dict[str, Any] = {"readout_s": 5e-3, "max_exposure_s": 10.0, "frame_shape": SHAPE} | facts
        lines = (LineSpec("exposure", 0, on=("image",), triggers="camera"),)
        context = Context("cam", clock=self.clock, lines=lines)
        self.camera = TinyCamera(context, CameraFacts(**known), lose)
        self.camera.open()
        self.camera.log.clear()

    def fire(self, n_frames: int, exposure_s: float = 0.01) -> None:
        self.camera.arm(n_frames, exposure_s, "software")
        for _ in range(n_frames):
            self.camera.trigger()
            self.clock.sleep(exposure_s)

    def read(self, timeout_s: float = 1.0) -> Frame:
        return self.camera.read(timeout_s)
