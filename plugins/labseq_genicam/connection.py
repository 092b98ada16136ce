"""Connection to a camera, which differs between libraries and between real and simulated cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

from labseq.plugin import Context, DeviceError, Trigger, wait_for
from labseq.plugin.camera import ExposureResult, Series
from labseq_genicam.features import Features, Nodes
from labseq_genicam.settings import StandardSettings


class Connection(ABC):
    """A camera, open or not.

    Attributes:
        sensor_shape: (height, width) of the sensor if it is known before the camera is opened.
        min_exposure_s: Shortest exposure if it is known before the camera is opened, else 0, in seconds.
    """

    def __init__(self, settings: StandardSettings, context: Context) -> None:
        self._name = context.name or "camera"
        self._settings = settings
        self._clock = context.clock
        self.sensor_shape: tuple[int, int] | None = None
        self.min_exposure_s = 0.0

    def warm(self) -> None:
        """Do slow work that can be done before the camera is opened."""

    @abstractmethod
    def open(self) -> Nodes:
        """Find the camera, open it and end any acquisition. Returns the access to its features."""

    @abstractmethod
    def identity(self) -> Mapping[str, Any]:
        """Model, serial number, connection and other facts of the open camera, JSON-ready."""

    @abstractmethod
    def set_packets(self, features: Features) -> Mapping[str, Any]:
        """Set the network packets as the settings say, and return the camera's report."""

    @abstractmethod
    def close(self) -> None:
        """Release everything. Legal in any state."""

    @abstractmethod
    def doing(self, what: str) -> AbstractContextManager[object]:
        """Turn errors of the library into errors of labseq. ``what`` completes "cannot ..."."""

    @abstractmethod
    def check_alive(self) -> None:
        """Raise if the camera no longer answers."""

    # the library's part of a series

    def goes_on(self, trigger: Trigger) -> bool:  # noqa: ARG002 - for overriding methods
        """Whether the acquisition of the last series serves the next one, too. If not, it is ended."""
        return False

    @abstractmethod
    def start(self, series: Series, trigger: Trigger) -> None:
        """Provide buffers and start the acquisition, unless it goes on."""

    def wait_until_ready(self) -> None:
        """Wait until the camera accepts a software trigger, if that can be known."""

    @abstractmethod
    def fire(self) -> None:
        """Send a software trigger."""

    @abstractmethod
    def poll(self, seconds: float) -> ExposureResult | None:
        """Wait for the next frame of the series, for at most ``seconds``. None if none came."""

    def end(self) -> None:
        """End the series. The acquisition may go on for the next one."""
        self.stop()

    @abstractmethod
    def stop(self) -> None:
        """End the acquisition. Unread frames are dropped."""

    # how exposures start, which simulated cameras override with their own pictures

    def trigger_of(self, series: Series) -> Trigger:
        """Trigger of the camera's exposures in a series."""
        return series.trigger

    def arm(self, series: Series, period_s: float) -> None:
        """Called before the acquisition of a series starts.

        Args:
            series: The series.
            period_s: Time from one exposure to the next where the camera times them, in seconds, else nan.
        """

    def trigger(self) -> None:
        """Start an exposure of a series with the software trigger."""
        self.wait_until_ready()
        self.fire()

    def wait(self, timeout_s: float) -> ExposureResult | None:
        """Wait for a frame on the session's clock. None if none came in time."""
        return wait_for(self.poll, timeout_s, self._clock)

    def clear(self) -> None:
        """Forget the series."""

    def check_identity(self, **wanted: str | None) -> None:
        """Raise if the open camera has another model or serial number than the settings say."""
        identity = self.identity()
        for key, value in wanted.items():
            if value is not None and identity[key] != value:
                which = f"the camera {identity['serial_number']} ({identity['model']})"
                text = f"{which} has the {key.replace('_', ' ')} {identity[key]}, not {value}"
                raise DeviceError(self._name, f"{text}; name another camera as `camera`")
