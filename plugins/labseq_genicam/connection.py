"""The connection to a camera: where it is, the open camera, and its errors."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from labseq_aravis import AravisError, Camera, LibraryMissingError, load_library

from labseq.plugin import Context, DeviceError, Trigger
from labseq.plugin.camera import ExposureResult, Series
from labseq_genicam.settings import SIMULATED, GenicamSettings

if TYPE_CHECKING:
    from labseq_genicam.acquisition import Acquisition

GONE: Final = frozenset({"timeout", "not connected"})
"""Codes of errors which mean that a camera no longer answers."""

OCCUPIED: Final = frozenset({"not controller", "access denied", "busy"})
"""Codes of errors which mean that another program controls the camera."""

HINTS: Final = {
    "missing": "to try things without it, use another camera, for example `use: virtual`",
    "not found": "check its cable, power and network address; to try things without a camera, set "
    "`camera: simulated`",
}
"""What to do, by the code of an error."""


def simulated_settings() -> dict[str, str | None] | str:
    """Settings of a simulated camera, which Aravis talks to, or why there is none here."""
    try:
        load_library()
    except LibraryMissingError as error:
        return f"{error}, which the simulated camera needs"
    return {"camera": "simulated", "model": None, "serial": None}


class CameraConnection:
    """Where the camera is, and how its exposures start. The simulated camera overrides all of it.

    Attributes:
        sensor_shape: (height, width) of the sensor if it is known before the camera is opened.
        packet_size: Bytes of a network packet; None as the camera is set.
        min_exposure_s: Shortest exposure if it is known before the camera is opened, else 0, in seconds.
    """

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        self._name = context.name or "camera"
        self._camera = settings.camera
        self.sensor_shape: tuple[int, int] | None = None
        self.packet_size = settings.packet_size
        self.min_exposure_s = 0.0

    def warm(self) -> None:
        """Do slow work that can be done before the camera is opened."""

    def open(self) -> str | None:
        """Make the camera reachable; returns its address, id or serial number, None for the only camera."""
        return self._camera

    def close(self) -> None:
        """Release what ``open`` took; legal in any state."""

    def trigger_of(self, series: Series) -> Trigger:
        """What starts the camera's exposures in a series."""
        return series.trigger

    def arm(self, series: Series, period_s: float, acquisition: Acquisition) -> None:
        """Called before the acquisition of a series starts.

        Args:
            series: The series.
            period_s: From one exposure to the next where the camera times them, in seconds; else nan.
            acquisition: The acquisition.
        """

    def fire(self, acquisition: Acquisition) -> None:
        """Start an exposure of a series with the software trigger."""
        acquisition.fire()

    def wait(self, wait: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait for a frame on the session's clock."""
        return wait(timeout_s)

    def clear(self) -> None:
        """Forget the series."""


def connection_for(settings: GenicamSettings, context: Context) -> CameraConnection:
    """The connection that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_genicam_sim.connection import SimulatedConnection

        return SimulatedConnection(settings, context)
    return CameraConnection(settings, context)


class Link:
    """An open camera, as long as it answers.

    Each command to a camera that is gone takes 2.5 s, so after the first failure none is sent any more.

    Args:
        camera: IP address, id or serial number; None for the only camera there is.

    Attributes:
        name: Name of the camera in the profile.
        camera: The camera.
        is_gone: Whether it has stopped answering.
    """

    def __init__(self, name: str, camera: str | None) -> None:
        self.name = name
        self.is_gone = False
        with translated_errors(name, "open the camera"):
            self.camera = Camera(camera)

    @contextmanager
    def doing(self, what: str) -> Generator[Camera]:
        """Use the camera within the block; ``what`` completes "cannot ..." in errors."""
        self.check()
        try:
            with translated_errors(self.name, what):
                yield self.camera
        except DeviceError as error:
            cause = error.__cause__
            if isinstance(cause, AravisError) and cause.code in GONE:
                self.is_gone = True
                raise self._gone() from cause
            raise

    def check(self) -> None:
        """Raise if the camera is known to be gone; sends nothing."""
        self.is_gone = self.is_gone or self.camera.is_lost
        if self.is_gone:
            raise self._gone()

    def check_alive(self) -> None:
        """Read a value from the camera, to find out whether it still answers."""
        with self.doing("reach the camera") as camera:
            _ = camera.exposure_s

    def close(self) -> None:
        """Release the camera; repeatable. If it is gone this takes the library 10 s, so a thread does it."""
        if self.is_gone or self.camera.is_lost:
            threading.Thread(target=self.camera.close, name=f"{self.name}, gone", daemon=True).start()
        else:
            self.camera.close()

    def _gone(self) -> DeviceError:
        return DeviceError(self.name, "the camera is gone: it does not answer; check its cable and power")


@contextmanager
def translated_errors(name: str, what: str) -> Generator[None]:
    """Turn errors of the library into errors of labseq."""
    try:
        yield
    except LibraryMissingError as error:
        raise DeviceError(name, f"{error}; {HINTS['missing']}") from error
    except AravisError as error:
        text = f"cannot {what}: {error}"
        if error.code in OCCUPIED:
            text = f"cannot {what}: another program controls it; close that one, or wait until it is gone"
        elif hint := HINTS.get(error.code, ""):
            text = f"{text}; {hint}"
        raise DeviceError(name, text) from error
