"""What all camera drivers have in common: the series, its limits, and what is lost of it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

from labseq.drivers.series import Series, ExposureResult
from labseq.errors import DeviceError, DeviceTimeoutError, LimitError, TransientError, one_of
from labseq.model import CameraFacts, Frame
from labseq.roles import Context, Trigger
from labseq.units import format_quantity

TEST_EXPOSURE_S: Final = 10e-3


class CameraDriver(ABC):
    """Base of camera drivers: plays the role, and asks a subclass only for what its camera does.

    It refuses what the camera cannot do before it is asked to, keeps to as many frames as were
    armed for, and finds out when frames are missing: their numbers have a gap.

    A subclass implements ``facts``, ``describe`` and the methods below with one underscore; they
    are called in this order: ``_connect``, then for each series ``_start``, ``_fire`` and ``_take``,
    at its end ``_stop``, and ``_disconnect``.

    Args:
        context: Name of the camera, and clock.
    """

    def __init__(self, context: Context) -> None:
        self._name = context.name or "camera"
        self._clock = context.clock
        self._is_open = False
        self._forget()

    @property
    @abstractmethod
    def facts(self) -> CameraFacts:
        """What the camera can do; also before it is opened."""

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """Model, serial number, firmware, settings in force: JSON-ready values."""

    @abstractmethod
    def _connect(self) -> None:
        """Connect to the camera and set what stays the same."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Release everything; called in any state, also after a ``_connect`` that failed."""

    @abstractmethod
    def _start(self, series: Series) -> None:
        """Get the camera ready for a series; with the internal trigger, start it."""

    @abstractmethod
    def _fire(self) -> None:
        """Start an exposure of a series with the software trigger."""

    @abstractmethod
    def _take(self, timeout_s: float) -> ExposureResult | None:
        """Wait for what comes next of the series; None if nothing comes in time.

        See :func:`labseq.drivers.wait_for`.
        """

    @abstractmethod
    def _stop(self) -> None:
        """End acquisition, close the shutter, EM gain to 1; called in any state between open and close."""

    def _end(self) -> None:
        """End a series because another one begins at once; without an override like ``_stop``."""
        self._stop()

    def open(self) -> None:
        """Connect to the camera; no effect if it is open.

        Raises:
            DeviceError: It does not answer, or is another than the profile says.
        """
        if self._is_open:
            return
        try:
            self._connect()
        except BaseException:
            with suppress(Exception):  # what went wrong first counts
                self._disconnect()
            raise
        self._is_open = True

    def close(self) -> None:
        """Make safe and disconnect; legal in any state."""
        try:
            self.safe_state()
        finally:
            self._is_open = False
            self._disconnect()

    def safe_state(self) -> None:
        """Stop exposing, close the shutter, EM gain to 1; frames not yet read are dropped."""
        self._forget()
        if self._is_open:
            self._stop()

    def arm(self, n_frames: int, exposure_s: float, trigger: Trigger) -> None:
        """Get ready for a series of exposures; frames not yet read are dropped.

        Raises:
            LimitError: No frames, or an exposure that the camera cannot make.
            DeviceError: Not open, or a trigger that it does not have.
        """
        self._arm(n_frames, exposure_s, trigger, self.facts.em_gain)

    def trigger(self) -> None:
        """Start the next exposure of the series; returns at once.

        Raises:
            DeviceError: Not armed for it, all exposures made, or still exposing.
        """
        self._check_open()
        series, now_s = self._series, self._clock.now()
        if series is None or len(self._fired_s) == series.n_frames:
            raise DeviceError(self._name, "triggered, but not armed for another frame; call arm() first")
        if series.trigger != "software":
            raise DeviceError(self._name, f"triggered, but armed for the {series.trigger} trigger")
        if self._fired_s and now_s < (until_s := self._fired_s[-1] + series.exposure_s):
            raise DeviceError(self._name, f"triggered during an exposure that ends at {until_s:.6f} s")
        self._fired_s.append(now_s)
        self._fire()

    def read(self, timeout_s: float) -> Frame:
        """Wait for the oldest frame not yet read.

        Raises:
            DeviceTimeoutError: No frame came within ``timeout_s``.
            TransientError: One or more frames of the series were lost.
            DeviceError: Not open, or the camera is gone.
        """
        self._check_open()
        series = self._series
        if series is None or self._n_read == series.n_frames:
            self._clock.sleep(timeout_s)
            raise self._no_frame(timeout_s)
        taken, self._held = self._held or self._take(timeout_s), None
        if taken is None:
            raise self._no_frame(timeout_s)
        if taken.number > self._n_read:
            self._held = taken
            raise self._lost(taken.number, "the camera's frame numbers have a gap")
        self._n_read = taken.number + 1
        if taken.image is None:
            raise self._lost(taken.number + 1, taken.fault)
        exposure_s = series.exposure_s if math.isnan(taken.exposure_s) else taken.exposure_s
        t_start_s = self._t_start_s(taken, exposure_s)
        return Frame(taken.image, exposure_s, t_start_s, self._name, taken.number, taken.device_time_s)

    def self_test(self) -> None:
        """Take a frame without EM gain, if the camera can be triggered; those not yet read are dropped.

        Raises:
            DeviceError: Not open, no frame came, or it has another shape than the camera says.
            TransientError: The frame was lost.
        """
        facts = self.facts
        if "software" not in facts.triggers:
            return
        # with frame transfer no exposure is shorter than the read-out
        exposure_s = min(max(TEST_EXPOSURE_S, facts.readout_s), facts.max_exposure_s)
        self._arm(1, exposure_s, "software", 1.0)
        self.trigger()
        shape, told = self.read(exposure_s + facts.readout_s + 2.0).image.shape, facts.frame_shape
        if told is not None and shape != told:
            raise DeviceError(self._name, f"a frame has the shape {shape}; expected {told}")

    def _arm(self, n_frames: int, exposure_s: float, trigger: Trigger, em_gain: float) -> None:
        self._check_open()
        facts = self.facts
        if n_frames < 1:
            raise LimitError(f"{self._name}: number of frames", n_frames, "at least 1")
        if not 0 < exposure_s <= facts.max_exposure_s:
            longest = format_quantity(facts.max_exposure_s, "time")
            came, limit = format_quantity(exposure_s, "time"), f"more than 0 and at most {longest}"
            raise LimitError(f"{self._name}: exposure", came, limit, "choose another exposure")
        if trigger not in facts.triggers:
            text = f"it has no {trigger} trigger; expected {one_of(facts.triggers)}"
            raise DeviceError(self._name, text)
        if self._series is not None:
            self._forget()
            self._end()
        series = Series(n_frames, exposure_s, trigger, em_gain)
        try:
            self._start(series)
        except BaseException:
            with suppress(Exception):  # half started it might go on exposing
                self._stop()
            raise
        self._series = series

    def _forget(self) -> None:
        self._series: Series | None = None
        self._fired_s: list[float] = []
        self._n_read = 0
        self._held: ExposureResult | None = None

    def _t_start_s(self, taken: ExposureResult, exposure_s: float) -> float:
        if not math.isnan(taken.t_start_s):
            return taken.t_start_s
        if taken.number < len(self._fired_s):
            return self._fired_s[taken.number]
        return self._clock.now() - exposure_s - self.facts.readout_s

    def _no_frame(self, timeout_s: float) -> DeviceTimeoutError:
        series, n_read = self._series, self._n_read
        if series is None:
            reason = "the camera is not armed"
        elif n_read == series.n_frames:
            reason = f"all {n_read} frames of the series were read"
        elif series.trigger == "software" and n_read >= len(self._fired_s):
            reason = "the next one was not triggered"
        elif series.trigger == "external":
            reason = f"frame {n_read + 1} of {series.n_frames} waits for its external trigger; check the line"
        else:
            reason = f"frame {n_read + 1} of {series.n_frames} is not ready"
        text = f"no frame within {format_quantity(timeout_s, 'time')}: {reason}"
        return DeviceTimeoutError(self._name, text, timeout_s)

    def _lost(self, n_read: int, why: str) -> TransientError:
        first, self._n_read = min(self._n_read, n_read - 1) + 1, n_read
        which = f"frame {first} was" if first == n_read else f"frames {first} to {n_read} were"
        n_frames = self._series.n_frames if self._series is not None else 0
        return TransientError(f"{which} lost, of a series of {n_frames}: {why}", self._name)

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")
