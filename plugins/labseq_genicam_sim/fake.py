"""The parent's side of a simulated camera, which starts its process and makes its images."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Final

import numpy as np
from labseq_aravis.library import AravisError, load_library
from labseq_aravis.stream import MONO
from numpy.typing import NDArray

from labseq_genicam_sim.messages import Channel, Exposure, Faults, Image, NotStarted, Ready, Setup

START_TIMEOUT_S: Final = 30.0
"""How long a camera may take to start. It takes half a second on an idle machine."""

STOP_TIMEOUT_S: Final = 5.0
"""How long an exposure that is being made may take to end."""

SATURATION: Final = {MONO["Mono8"]: 2**8 - 1, MONO["Mono10"]: 2**10 - 1, MONO["Mono12"]: 2**12 - 1}
"""Largest value of a pixel, by pixel format."""


class FakeCamera:
    """A simulated GigE Vision camera whose pixels come from a function.

    Args:
        expose: Makes the image of an exposure, uint16 (height, width). A thread of this object calls
            it, one exposure at a time.
        sensor_shape: Height and width of the sensor, in pixels.

    Attributes:
        address: IP address, empty before it has started.
    """

    def __init__(
        self,
        expose: Callable[[Exposure], NDArray[np.uint16]],
        *,
        serial: str = "SIM1",
        sensor_shape: tuple[int, int] = (2048, 2048),
        faults: Faults = Faults(),  # noqa: B008 - frozen
    ) -> None:
        self._expose = expose
        self._serial = serial
        self._sensor_shape = sensor_shape
        self._faults = faults
        self._process: subprocess.Popen[bytes] | None = None
        self._errors: list[Exception] = []
        self.n_stops = 0
        self._changed = threading.Condition()
        self._n_made = 0
        self._is_ready = self._has_ended = False
        self.address = ""

    def start(self) -> None:
        """Start the process and wait until the camera answers."""
        if self.is_running:
            return
        self.stop()
        load_library()  # reports a missing one here
        self._log: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - closed by stop()
        self._n_made = 0
        self._is_ready = self._has_ended = False
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "labseq_genicam_sim"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,  # Ctrl-C is for the parent
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._channel = Channel(self._process.stdout, self._process.stdin)
        self._service = threading.Thread(
            target=self._serve, args=(self._channel,), name=f"camera {self._serial}", daemon=True
        )
        self._service.start()
        setup = Setup(self._serial, self._sensor_shape, self.address, self._faults)
        try:
            self._send(setup)
            if not self._wait(lambda: self._is_ready or self._has_ended, START_TIMEOUT_S):
                text = f"the simulated camera did not start within {START_TIMEOUT_S:g} s"
                raise AravisError(text, "timeout")
            if not self._is_ready:
                raise self._errors.pop() if self._errors else AravisError(self._reason(), "not connected")
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the process. Legal at any time, and repeatedly."""
        if self._process is None:
            return
        self.unplug()
        self._service.join(STOP_TIMEOUT_S)
        for pipe in (self._process.stdin, self._process.stdout, self._log):
            assert pipe is not None
            with suppress(OSError):  # unsent bytes go nowhere
                pipe.close()
        self._process = None

    def __enter__(self) -> FakeCamera:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def is_running(self) -> bool:
        """Whether the camera's process is alive."""
        return self._process is not None and not self._has_ended and self._process.poll() is None

    @property
    def n_made(self) -> int:
        """How many images were made, which is the number of the next exposure."""
        with self._changed:
            return self._n_made

    def wait_for_image(self, n: int, timeout_s: float, n_stops: int | None = None) -> bool:
        """Wait until the image of exposure ``n`` was made, or the camera stopped. True if it was made.

        Args:
            n: Number of the exposure.
            timeout_s: How long to wait.
            n_stops: How often it had been stopped before the trigger, None for as often as now.
        """
        n_stops = self.n_stops if n_stops is None else n_stops
        self._wait(lambda: n < self._n_made or n_stops < self.n_stops, timeout_s)
        return n < self.n_made

    def note_stop(self) -> None:
        """Note that it is stopped. An unfinished image is not made any more."""
        with self._changed:
            self.n_stops += 1
            self._changed.notify_all()

    def unplug(self) -> None:
        """Kill the camera, whatever it is doing. :meth:`start` plugs it in again, at its address."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def raise_pending(self) -> None:
        """Raise the first error of ``expose`` that was not raised yet."""
        if self._errors:
            raise self._errors.pop(0)

    def _serve(self, channel: Channel) -> None:
        """Answer the camera until it is gone."""
        while (message := channel.receive()) is not None:
            if isinstance(message, Exposure):
                self._answer(channel, message)
            with self._changed:
                if isinstance(message, Ready):
                    self.address, self._is_ready = message.address, True
                elif isinstance(message, NotStarted):
                    self._errors.append(AravisError(message.reason, "refused"))
                self._changed.notify_all()
        with self._changed:
            self._has_ended = self._has_ended or channel is self._channel
            self._changed.notify_all()

    def _answer(self, channel: Channel, exposure: Exposure) -> None:
        try:
            image = _pixels(self._expose(exposure), exposure)
        except Exception as error:  # noqa: BLE001 - kept for raise_pending
            self._errors.append(error)
            image = None
        with self._changed:
            self._n_made += 1
            self._changed.notify_all()
        try:
            channel.send(Image(None if image is None else image.tobytes()))
        except (OSError, ValueError):
            return  # the camera is gone

    def _send(self, message: object) -> None:
        try:
            if not self.is_running:
                raise OSError
            self._channel.send(message)
        except (OSError, ValueError) as error:
            raise AravisError(self._reason(), "not connected") from error

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(condition, timeout_s)

    def _reason(self) -> str:
        """Why the camera is gone, from the last line that its process printed."""
        if self._process is None:
            return "the simulated camera is not running; call start() first"
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "it printed nothing")
        return f"the process of the simulated camera has ended: {last}"


def _pixels(image: NDArray[np.uint16], exposure: Exposure) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """An image in the camera's pixel format, uint16 or, for Mono8, uint8 (height, width), little-endian.

    Raises:
        ValueError: The image is not uint16 (height, width) of the region.
    """
    shape = (exposure.height, exposure.width)
    if image.shape != shape or image.dtype != np.uint16:
        text = f"the image of exposure {exposure.n} is {image.dtype} {image.shape}; expected uint16 {shape}"
        raise ValueError(text)
    largest = SATURATION.get(exposure.pixel_format)
    if largest is not None:
        image = np.minimum(image, np.uint16(largest))
    return np.ascontiguousarray(image, np.uint8 if exposure.pixel_format == MONO["Mono8"] else "<u2")
