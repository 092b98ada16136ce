"""The driver's connection to the simulated camera, which sends pictures to a camera in another process."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from labseq_genicam.aravis import AravisConnection, translated_errors
from labseq_genicam.features import Nodes
from labseq_genicam.settings import GenicamSettings
from labseq_genicam.simulated import MAX_WAIT_S, SimulatedExposures
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, Frame
from labseq.plugin.camera import ExposureResult
from labseq_genicam_sim.description import EXPOSURE_US
from labseq_genicam_sim.fake import FakeCamera
from labseq_genicam_sim.messages import Exposure, Faults

PACKET_SIZE: Final = 15800
"""Bytes of the packets if the settings name no size, large since each packet takes the same time."""


class SimulatedConnection(SimulatedExposures, AravisConnection):
    """A GigE Vision camera in a separate process that shows the simulation."""

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        super().__init__(settings, context)
        self.min_exposure_s = 1e-6 * EXPOSURE_US[0]
        self.packet_size = settings.packet_size or PACKET_SIZE
        self.late_s = settings.faults.late_by
        self._ignores_triggers = settings.faults.ignores_triggers
        self._pictures: deque[Frame] = deque()
        faults = Faults(**settings.faults.model_dump())
        self._fake = FakeCamera(self._picture, sensor_shape=self._shape, faults=faults)

    def open(self) -> Nodes:
        """Start the camera's process, and open the camera."""
        with translated_errors(self._name, "start the simulated camera"):
            self._fake.start()
        return self._open(self._fake.address)

    def close(self) -> None:
        """Release the camera, and end its process."""
        super().close()
        self.clear()
        self._fake.stop()

    def granted(self, n_bytes: int) -> int:
        """All of it, as the simulated camera sends no more than a socket has room for."""
        return n_bytes

    def expose(self, t_s: float | None, exposure_s: float | None) -> None:
        """Begin an exposure. A camera that ignores triggers is only sent one."""
        if self._ignores_triggers:
            self.fire()
        else:
            super().expose(t_s, exposure_s)

    def show(self, frame: Frame) -> None:
        """Trigger the camera, and wait until it has its picture.

        The picture is there before the trigger is sent, since the camera answers nothing while it waits for a
        picture, and on a busy computer it would seem to be gone.
        """
        n, n_stops = self._fake.n_made, self._fake.n_stops
        self._pictures.append(frame)
        self.fire()
        if not self._fake.wait_for_image(n, MAX_WAIT_S, n_stops):
            self._pictures.clear()  # its frame will be missing
        self._fake.raise_pending()

    def wait(self, timeout_s: float) -> ExposureResult | None:
        """Wait for a frame. Raises an error that occurred while its picture was made."""
        taken = super().wait(timeout_s)
        self._fake.raise_pending()
        return taken

    def clear(self) -> None:
        """Forget the series. A trigger in another thread waits no longer."""
        self._fake.note_stop()
        self._pictures.clear()
        super().clear()

    def _picture(self, exposure: Exposure) -> NDArray[np.uint16]:
        """The sensor's image, black if no exposure was begun. Called by the camera's own thread."""
        if self._series is not None:
            self._check(exposure)
        if not self._pictures:
            return np.zeros((exposure.height, exposure.width), np.uint16)
        return self._pictures.popleft().image

    def _check(self, exposure: Exposure) -> None:
        """Raise if the camera's settings differ from the simulation's."""
        mode = self._settings.mode
        binning, (y, x) = mode.binning, (mode.region or (0, 0))[:2]
        height, width = mode.frame_shape(self._shape)
        wanted = (y // binning, x // binning, height, width, (binning, binning), (0, 0))
        came = (
            exposure.y,
            exposure.x,
            exposure.height,
            exposure.width,
            (exposure.binning_y, exposure.binning_x),
            (exposure.reverse_y, exposure.reverse_x),
        )
        if came != wanted:
            text = f"the camera reads (y, x, height, width, binning, reverse) = {came}, not {wanted}"
            raise DeviceError(self._name, text)
