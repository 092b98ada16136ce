"""Cameras that Aravis reaches, with their errors and the acquisition of their frames."""

from __future__ import annotations

import math
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from labseq_aravis import (
    AravisError,
    Buffer,
    Camera,
    LibraryMissingError,
    Stream,
    StreamOptions,
    buffer_size,
    granted,
    load_library,
)

from labseq.plugin import Context, DeviceError, Trigger
from labseq.plugin.camera import ExposureResult, Series
from labseq_genicam.connection import Connection
from labseq_genicam.features import Features, Nodes
from labseq_genicam.settings import SIMULATED, GenicamSettings
from labseq_genicam.standard import TIMED_BY_CAMERA

GONE: Final = frozenset({"timeout", "not connected"})
"""Codes of errors which mean that a camera no longer answers."""

OCCUPIED: Final = frozenset({"not controller", "access denied", "busy"})
"""Codes of errors which mean that another program controls the camera."""

HINTS: Final = {
    "missing": "To try things without it, use another camera, for example `use: virtual`",
    "not found": "check its cable, power and network address. To try things without a camera, set "
    "`camera: simulated`",
}
"""Remedy, by the code of an error."""

INCOMPLETE: Final = "some of its network packets are missing"
FAULTS: Final[Mapping[str, str]] = {"success": "", "missing packets": INCOMPLETE, "timeout": INCOMPLETE}
"""Fault of a frame, by the status of its buffer."""

CHECK_PERIOD_S: Final = 0.5
"""Time without a frame after which the driver checks whether the camera still answers, in seconds."""

BUFFER_BYTES: Final = 256 * 2**20
"""Memory for frames that were not read yet. A series that needs more reuses its buffers."""

LAST_ID: Final = 65535
"""GigE cameras count frames from 1 to this and continue with 1, unless they use 64 bits."""


def simulated_settings() -> dict[str, str | None] | str:
    """Settings of a simulated camera, which Aravis talks to, or why there is none here."""
    try:
        load_library()
    except LibraryMissingError as error:
        return f"{error}, which the simulated camera needs"
    return {"camera": SIMULATED, "model": None, "serial": None}


def buffer_note(payload: int, room: int) -> str:
    """Remedy where a frame of ``payload`` bytes may be more than a socket holds, else empty.

    Args:
        payload: Size of a frame, in bytes.
        room: Bytes that a socket gets. The kernel counts packets at up to twice their size.
    """
    if room >= 2 * payload:
        return ""
    frame, limit = f"{payload / 1024:.0f} KiB", f"net.core.rmem_max is {room / 1024:.0f} KiB"
    command = f"sysctl -w net.core.rmem_max={buffer_size(payload)}"
    return f"a frame of {frame} may not fit into its socket's buffer, as {limit}; raise it with `{command}`"


def connection_for(settings: GenicamSettings, context: Context) -> AravisConnection:
    """The connection that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_genicam_sim.connection import SimulatedConnection

        return SimulatedConnection(settings, context)
    return AravisConnection(settings, context)


@contextmanager
def translated_errors(name: str, what: str) -> Generator[None]:
    """Turn errors of the library into errors of labseq."""
    try:
        yield
    except LibraryMissingError as error:
        raise DeviceError(name, f"{error}. {HINTS['missing']}") from error
    except AravisError as error:
        text = f"cannot {what}: {error}"
        if error.code in OCCUPIED:
            text = f"cannot {what}: another program controls it; close that program"
        elif hint := HINTS.get(error.code, ""):
            text = f"{text}; {hint}"
        raise DeviceError(name, text) from error


class AravisConnection(Connection):
    """A camera that Aravis reaches.

    Each command to a camera that is gone takes 2.5 s, so after the first failure none is sent any more.

    A camera that waits for software triggers continues to wait from one series to the next, since starting it
    again can take as long as an exposure. Late frames of an earlier series are recognised by their numbers.

    Attributes:
        camera: Aravis' camera, None unless it is open.
        packet_size: Bytes of a network packet, None to keep the present size.
    """

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._serial = settings.serial
        self._options = StreamOptions(settings.packet_timeout, settings.frame_timeout)
        self.packet_size = settings.packet_size
        self.camera: Camera | None = None
        self._is_gone = False
        self._buffer_note = ""
        self._stream: Stream | None = None
        self._trigger: Trigger | None = None  # while it acquires
        self._counter = FrameCounter()
        self._n_buffers = self._n_triggered = self._first = self._n_frames = 0
        self._quiet_s = 0.0

    def open(self) -> Nodes:
        """Open the camera that the settings name, or else the only one."""
        return self._open(self._settings.camera)

    def _open(self, camera: str | None) -> Nodes:
        """Open a camera by its IP address, id or serial number, None for the only one."""
        self._is_gone = False
        with translated_errors(self._name, "open the camera"):
            self.camera = opened = Camera(camera)
        with self.doing("end its acquisition"):
            opened.stop()
        self.check_identity(serial_number=self._serial)
        return opened

    def identity(self) -> Mapping[str, Any]:
        """Vendor, model, serial number, and GigE or USB3 Vision."""
        with self.doing("identify the camera"):
            camera = self._opened()
            return {
                "vendor": camera.vendor,
                "model": camera.model,
                "serial_number": camera.serial,
                "connection": "GigE Vision" if camera.is_ethernet else "USB3 Vision",
            }

    def set_packets(self, features: Features) -> Mapping[str, Any]:
        """Set size of the packets, and pause between them."""
        camera, delay_s = self._opened(), self._settings.packet_delay
        for key, value in (("packet_size", self.packet_size), ("packet_delay", delay_s)):
            if value is not None and not camera.is_ethernet:
                raise DeviceError(features.name, f"only GigE cameras have packets; leave out `{key}`")
        with self.doing("set its network packets"):
            if self.packet_size is not None:
                camera.set_packet_size(self.packet_size)
            if delay_s is not None:
                camera.set_packet_delay_s(delay_s)
            if not camera.is_ethernet:
                return {"packet_size_now": None}
            payload = camera.payload
            self._buffer_note = buffer_note(payload, self.granted(buffer_size(payload)))
            return {"packet_size_now": camera.packet_size, "notes": [*filter(None, [self._buffer_note])]}

    def granted(self, n_bytes: int) -> int:
        """Bytes that a socket gets when it requests ``n_bytes``."""
        return granted(n_bytes)

    def close(self) -> None:
        """Release the camera. Repeatable. If it is gone this takes the library 10 s, so a thread does it."""
        camera, self.camera = self.camera, None
        self._stream = self._trigger = None  # the camera closes its stream
        if camera is None:
            return
        if self._is_gone or camera.is_lost:
            threading.Thread(target=camera.close, name=f"{self._name}, gone", daemon=True).start()
        else:
            camera.close()

    @contextmanager
    def doing(self, what: str) -> Generator[None]:
        """Turn errors of the library into errors of labseq, and remember whether the camera is gone."""
        self._is_gone = self._is_gone or self._opened().is_lost
        if self._is_gone:
            raise self._gone()
        try:
            with translated_errors(self._name, what):
                yield
        except DeviceError as error:
            cause = error.__cause__
            if isinstance(cause, AravisError) and cause.code in GONE:
                self._is_gone = True
                raise self._gone() from cause
            raise

    def check_alive(self) -> None:
        """Read a value from the camera, to find out whether it still answers."""
        with self.doing("reach the camera"):
            self._opened().get("Width", int)

    def _gone(self) -> DeviceError:
        return DeviceError(self._name, "the camera no longer answers; check its cable and power")

    def _opened(self) -> Camera:
        if self.camera is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self.camera

    # the acquisition

    def goes_on(self, trigger: Trigger) -> bool:
        """Whether the camera waits for software triggers, and every frame that was triggered has come."""
        return trigger == self._trigger == "software" and self._has_all_frames()

    def start(self, series: Series, trigger: Trigger) -> None:
        """Start the acquisition, unless the camera is already waiting for triggers."""
        with self.doing("start the series"):
            camera = self._opened()
            self._provide(camera, series.n_frames)
            if self._trigger is None:
                camera.start()
        self._trigger, self._quiet_s = trigger, 0.0
        self._first, self._n_frames = self._n_triggered, series.n_frames

    def fire(self) -> None:
        """Send a software trigger."""
        with self.doing("trigger it"):
            self._opened().execute("TriggerSoftware")
        self._n_triggered += 1

    def poll(self, seconds: float) -> ExposureResult | None:
        """Wait for the next frame, and check from time to time whether the camera still answers."""
        buffer = self._pop(seconds)
        if buffer is None:
            self._quiet_s += seconds
            if self._quiet_s >= CHECK_PERIOD_S:
                self.check_alive()
                self._quiet_s = 0.0
            return None
        self._quiet_s = 0.0
        number = self._counter.number(buffer.frame_id if buffer.image is not None else None) - self._first
        if number < 0:  # of an earlier series
            return None
        if self._trigger in TIMED_BY_CAMERA and number >= self._n_frames - 1:
            self.stop()
        time_s = 1e-9 * buffer.camera_time_ns if buffer.camera_time_ns else math.nan
        fault = FAULTS.get(buffer.status, f"its buffer is '{buffer.status}'")
        if fault == INCOMPLETE and self._buffer_note:
            fault = f"{fault}; {self._buffer_note}"
        return ExposureResult(number, buffer.image, fault, device_time_s=time_s)

    def end(self) -> None:
        """End the acquisition, unless the camera waits for software triggers."""
        if self._trigger != "software":
            self.stop()

    def stop(self) -> None:
        """End the acquisition. Unread frames are dropped, including frames being transferred."""
        stream, trigger = self._stream, self._trigger
        self._stream = self._trigger = None
        if self._is_gone:
            return
        if trigger is not None:
            with self.doing("stop the series"):
                self._opened().stop()
        if stream is not None:
            stream.close()

    def _has_all_frames(self) -> bool:
        """Whether all triggered frames have come. Unread frames are dropped."""
        while (buffer := self._pop(0.0)) is not None:
            self._counter.number(buffer.frame_id if buffer.image is not None else None)
        return self._counter.n_frames == self._n_triggered

    def _pop(self, seconds: float) -> Buffer | None:
        if self._stream is None:
            raise DeviceError(self._name, "not acquiring; call arm() first")
        with self.doing("read a frame"):
            return self._stream.pop(seconds)

    def _provide(self, camera: Camera, n_frames: int) -> None:
        """Allocate buffers for the series, as far as the memory allows."""
        if self._stream is None:
            self._n_buffers = self._n_triggered = 0
            self._counter = FrameCounter()
            self._stream = camera.create_stream(0, self._options)
        payload = camera.payload
        n_missing = max(2, min(n_frames, BUFFER_BYTES // payload)) - self._n_buffers
        self._stream.allocate(n_missing, payload)
        self._n_buffers += max(0, n_missing)


class FrameCounter:
    """Numbers the frames of an acquisition, including missing ones.

    The first frame that arrives has the number 0. An incomplete frame counts as the next one, since its frame
    id is not reliable.

    Example:
        >>> counter = FrameCounter()
        >>> [counter.number(frame_id) for frame_id in (65533, 65534, None, 1, 3)]
        [0, 1, 2, 3, 5]
        >>> counter.n_frames
        6
    """

    def __init__(self) -> None:
        self.n_frames = 0
        self._last: tuple[int, int] | None = None

    def number(self, frame_id: int | None) -> int:
        """Number, from 0, of the frame that has just come. Its id is None if it is incomplete."""
        number = self.n_frames
        if frame_id is not None and self._last is not None:
            last_number, last_id = self._last
            n_steps = frame_id - last_id
            number = last_number + (n_steps if n_steps >= 0 else n_steps + LAST_ID)
        if frame_id is not None:
            self._last = number, frame_id
        self.n_frames = number + 1
        return number
