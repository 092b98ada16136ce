"""A camera as pylablib shows it, the common part of its five interfaces."""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import ConfigError, Context, DeviceError, LimitError, Trigger, wait_for
from labseq.plugin.camera import ExposureResult, check_step
from labseq.plugin.messages import one_of
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_pylablib.library import Vendor, load
from labseq_pylablib.settings import PylablibSettings

BUFFER_BYTES: Final = 2 * 2**30
"""Memory for the frames of a series."""

_UNPLUGGED: Final = "the camera no longer answers; check its power and cable, then start again"
_TOO_EARLY: Final = "the camera cannot take a trigger yet; read the last frame first"
MEANINGS: Final[Mapping[str, str]] = {
    "DCAMERR_NOCONNECTION": _UNPLUGGED,
    "DCAMERR_FAILREADCAMERA": _UNPLUGGED,
    "DCAMERR_FAILWRITECAMERA": _UNPLUGGED,
    "DCAMERR_TOOFREQUENTTRIGGER": _TOO_EARLY,
    "AT_ERR_CONNECTION": _UNPLUGGED,
    "AT_ERR_COMM": _UNPLUGGED,
    "PicamError_DeviceCommunicationFailed": _UNPLUGGED,
    "PicamError_DeviceDisconnected": _UNPLUGGED,
    "PicamError_CameraFaulted": _UNPLUGGED,
}
"""Name of a library's error -> its meaning for a user."""
IN_USE: Final = frozenset(
    {
        "DCAMERR_EXCLUDED",
        "DCAMERR_FAILOPENCAMERA",
        "AT_ERR_DEVICEINUSE",
        "PicamError_DeviceOpenElsewhere",
        "PicamError_CameraAlreadyOpened",
    }
)
"""Names of errors of a camera that another program uses."""


@dataclass(frozen=True, slots=True, eq=False)
class RawFrame:
    """A frame as pylablib delivers it.

    Attributes:
        image: (height, width).
        index: Its place among the frames that reached the computer, from 0.
        stamp: Number that the camera gave it, None if it gives none.
        time_s: The camera's time stamp, in seconds, nan if it gives none.
    """

    image: NDArray[Any]
    index: int
    stamp: int | None = None
    time_s: float = math.nan


class Connection(ABC):
    """A camera through pylablib. A subclass knows one vendor's interface.

    Attributes:
        vendor: Vendor of the camera.
        has_falling_edge: Whether pylablib can set a trigger by a falling edge.
        settings: The camera's settings.
        module: pylablib's module, None before ``open()``.
        camera: pylablib's camera, None unless it is open.
    """

    vendor: ClassVar[Vendor]
    has_falling_edge: ClassVar[bool] = False

    def __init__(self, settings: PylablibSettings, context: Context) -> None:
        self.name = context.name or "camera"
        self.settings = settings
        self._clock = context.clock
        self.module: Any = None
        self.camera: Any = None

    @property
    def sensor_shape(self) -> tuple[int, int] | None:
        """(height, width) of the sensor, None if it is not known before the camera is opened."""
        return None

    @property
    def expected_readout_s(self) -> float:
        """The read-out time before the camera is opened, in seconds."""
        return self.settings.readout

    def warm(self) -> None:
        """Import pylablib, which takes seconds."""
        with suppress(DeviceError):  # open() reports the missing library
            self.module = self.load()

    def load(self) -> Any:
        """Pylablib's module with the vendor's library."""
        return load(self.name, self.vendor, self.settings.sdk)

    # what differs between the vendors

    @abstractmethod
    def places(self) -> Sequence[Any]:
        """Argument of pylablib's class for each connected camera."""

    @abstractmethod
    def identity(self) -> tuple[str, str, str]:
        """Model, serial number and firmware of the open camera, "" where it tells none."""

    @property
    @abstractmethod
    def readout_s(self) -> float:
        """Time from the end of an exposure until its frame can be read, in seconds."""

    @abstractmethod
    def triggers(self) -> tuple[Trigger, ...]:
        """Triggers that the camera has."""

    @abstractmethod
    def set_trigger(self, trigger: Trigger) -> None:
        """Choose the trigger of the exposures."""

    @abstractmethod
    def readout_modes(self) -> Mapping[str, Callable[[], object]]:
        """Name -> sets the read-out mode."""

    @abstractmethod
    def read_temperature_c(self) -> float | None:
        """Temperature of the sensor, in degrees Celsius, None if the camera does not tell it."""

    @abstractmethod
    def cool(self, celsius: float) -> float | None:
        """Start to cool. Returns the temperature that the camera took, None if it has no cooler."""

    def set_cycle(self, cycle_s: float) -> float:
        """Set the time from one exposure to the next, and return the camera's value, in seconds."""
        raise NotImplementedError(cycle_s)

    def stamps(self, info: Any) -> tuple[int | None, float]:
        """Number and time stamp that the camera gave a frame, in seconds."""
        del info
        return None, math.nan

    def details(self) -> Mapping[str, Any]:
        """Electrons per count and offset in counts, if the camera tells them."""
        return {}

    # open and close

    def open(self) -> None:
        """Open the camera with the serial number of the settings, or without one the only camera."""
        self.module = self.module or self.load()
        wanted, seen, in_use = self.settings.serial, list[str](), list[DeviceError]()
        with self.doing():
            places = self.places()
        if not places:
            text = f"no {self.settings.interface} camera is connected"
            program = f"close {self.vendor.program}"
            raise DeviceError(self.name, f"{text}; check its power and cable, and {program}")
        if len(places) > 1 and not wanted:
            text = f"{len(places)} cameras are connected; choose one by `serial`"
            raise DeviceError(self.name, text)
        for place in places:
            try:
                with self.doing():
                    self.camera = getattr(self.module, self.vendor.camera)(place)
                    serial = self.identity()[1]
            except DeviceError as error:
                in_use.append(error)
                self.close()
                continue
            if wanted in ("", serial):
                return
            seen.append(serial)
            self.close()
        self._refuse_all(wanted, seen, in_use)

    def _refuse_all(self, wanted: str, seen: Sequence[str], failures: Sequence[DeviceError]) -> None:
        if not seen:
            raise failures[0]
        numbers = " and ".join(seen)
        text = f"the connected camera has the serial number {numbers}, not {wanted}"
        raise DeviceError(self.name, f"{text}; change `serial`, or connect the other camera")

    def close(self) -> None:
        """Release the camera. Failures are ignored, since nothing can be done about them."""
        camera, self.camera = self.camera, None
        if camera is not None:
            with suppress(DeviceError), self.doing():
                camera.close()

    @contextmanager
    def doing(self) -> Generator[Any]:
        """The camera. Errors of pylablib are turned into errors of labseq."""
        backend: Any = importlib.import_module("pylablib.core.devio.comm_backend")
        try:
            yield self.camera
        except backend.DeviceError as error:
            raise DeviceError(self.name, self._explain(error)) from error

    def _explain(self, error: Exception) -> str:
        """Explain an error of a vendor's library to a user, with the function and its code at the end."""
        code, function = str(getattr(error, "name", "")), getattr(error, "func", "")
        if code in IN_USE:
            program = f"close {self.vendor.program} and every other program that uses it"
            meaning = f"the camera is there but cannot be used; {program}"
        elif code not in MEANINGS:
            return f"the camera refuses: {error}"
        else:
            meaning = MEANINGS[code]
        return f"{meaning} ({function} gave {code})"

    # what is set once

    def set_up(self) -> dict[str, Any]:
        """Set everything that stays the same in all series, and return the camera's report about itself."""
        settings = self.settings
        with self.doing() as camera:
            model, serial, firmware = self.identity()
            if not model.upper().startswith(settings.model.upper()):
                text = f"the connected camera is a {model}, but `model` is {settings.model}"
                raise DeviceError(self.name, f"{text}; change `model`, or connect the other camera")
            if settings.trigger_edge == "falling" and not self.has_falling_edge:
                text = f"pylablib sets no falling edge at {settings.interface} cameras"
                raise DeviceError(self.name, f"{text}; leave `trigger_edge` out")
            width, height = camera.get_detector_size()
            if conflict := settings.sensor_conflict((height, width)):
                raise ConfigError(f"{self.name}: {conflict}")
            self._set_readout_mode()
            self._set_region(width, height)
            reported = {"model": model, "serial_number": serial, "firmware": firmware}
            return {
                **reported,
                "sensor_shape": [height, width],
                "setpoint_k": self._start_cooling(),
                **self.details(),
            }

    def _set_readout_mode(self) -> None:
        wanted = self.settings.readout_mode
        if wanted is None:
            return
        modes = self.readout_modes()
        if wanted not in modes:
            text = f"`readout_mode` is '{wanted}', which this camera does not have"
            raise DeviceError(self.name, f"{text}; it has {one_of(list(modes))}")
        modes[wanted]()

    def _set_region(self, width: int, height: int) -> None:
        """Set region and binning. Refuses values that the camera would change."""
        camera, binning = self.camera, self.settings.binning
        y, x, h, w = self.settings.mode.region or (0, 0, height, width)
        limits = camera.get_roi_limits(binning, binning)
        for axis, place, size, whole, limit in zip(
            "xy", (x, y), (w, h), (width, height), limits, strict=True
        ):
            extent = {"x": "width", "y": "height"}[axis]
            low, high, place_step, size_step = map(int, limit[:4])
            check_step(f"{self.name}: {extent}", size, (low, high, size_step))
            check_step(f"{self.name}: {axis}", place, (0, whole - size, place_step))
        made = tuple(camera.set_roi(x, x + w, y, y + h, binning, binning))
        wanted = (x, x + w, y, y + h, binning, binning)
        if made != wanted:
            x0, x1, y0, y1, *bins = made
            text = f"the camera reads y {y0} to {y1}, x {x0} to {x1}, binned by {bins[0]} x {bins[1]}"
            raise DeviceError(self.name, f"{text}, not what `region` and `binning` say; change these")

    def _start_cooling(self) -> float | None:
        """Start to cool. Returns the set temperature in kelvins, None if the cooler is left as it is."""
        cooling = self.settings.cooling
        if cooling is None:
            return None
        wanted_c = cooling.temperature_k - ZERO_CELSIUS_K
        made_c = self.cool(wanted_c)
        if made_c is None:
            raise DeviceError(self.name, "this camera has no cooler that can be set; leave `cooling` out")
        if abs(made_c - wanted_c) > cooling.tolerance_k:
            text = f"cooling: temperature is {wanted_c:.0f} degC, but the camera cools to {made_c:.0f} degC"
            raise DeviceError(self.name, f"{text}; choose a temperature that it can reach")
        return made_c + ZERO_CELSIUS_K

    # a series

    def start(self, n_frames: int) -> None:
        """Start a series that ends after so many frames."""
        with self.doing() as camera:
            width, height = camera.get_data_dimensions()[::-1]
            most = BUFFER_BYTES // (2 * width * height)
            if n_frames > most:
                hint = "the computer keeps all frames of a series; read a smaller `region`"
                raise LimitError(f"{self.name}: number of frames", n_frames, f"at most {most}", hint)
            self._prepare(n_frames)
            camera.start_acquisition()

    def _prepare(self, n_frames: int) -> None:
        self.camera.setup_acquisition(mode="snap", nframes=n_frames)

    def stop(self) -> None:
        """End the series. No effect if the camera is closed."""
        if self.camera is not None:
            with self.doing() as camera:
                camera.stop_acquisition()

    def fire(self) -> None:
        """Send a software trigger."""
        with self.doing() as camera:
            if camera.send_software_trigger() is False:
                raise DeviceError(self.name, _TOO_EARLY)

    def read(self) -> RawFrame | None:
        """The oldest frame that was not read, None if there is none."""
        with self.doing() as camera:
            taken = camera.read_oldest_image(return_info=True)
        if taken is None:
            return None
        image, info = taken
        stamp, time_s = self.stamps(info)
        return RawFrame(np.asarray(image, np.uint16), int(info.frame_index), stamp, time_s)

    def wait_in_sdk(self, timeout_s: float) -> str:
        """Wait for a frame, for at most ``timeout_s``. Returns why none will come, "" if one may."""
        with self.doing() as camera:
            try:
                camera.wait_for_frame(timeout=timeout_s)
            except camera.TimeoutError:
                return ""
            except camera.FrameTransferError as error:
                return f"the computer did not take the camera's data over in time ({error})"
        return ""

    def take(self, look: Callable[[float], ExposureResult | None], timeout_s: float) -> ExposureResult | None:
        """Wait for a frame on the session's clock. None if none came in time."""
        return wait_for(look, timeout_s, self._clock)
