"""The driver."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from labseq.plugin import CameraDriver, CameraFacts, Context, DeviceError, ExposureResult, Series, wait_for
from labseq_genicam.acquisition import Acquisition, Start
from labseq_genicam.link import Link
from labseq_genicam.settings import SIMULATED, GenicamSettings
from labseq_genicam.setup import identify, set_up, temperature_k
from labseq_genicam.simulated import SimulatedCamera

ASK_S: Final = 0.5
"""After which time without a frame a camera is asked whether it is still there, in seconds."""

LOOPBACK_PACKET: Final = 15800
"""Bytes of the simulated camera's packets: few, since each costs as much as it is long."""

STARTS: Final[Mapping[str, Start]] = {"software": "software", "internal": "free", "external": "line"}
"""What starts the exposures of a real camera, by trigger."""


class GenicamCamera(CameraDriver):
    """A GigE Vision or USB3 Vision camera, or a simulated one that sees the simulated world.

    Args:
        settings: Which camera, and how it is set up.
        context: Clock; for the simulated camera, the simulated world.

    Raises:
        ConfigError: The simulated camera is asked for, but there is no simulated world, or its sensor has
            no such region.
    """

    def __init__(self, settings: GenicamSettings, context: Context) -> None:
        super().__init__(context)
        self._settings = settings
        self._simulated = SimulatedCamera(settings, context) if settings.camera == SIMULATED else None
        self._link: Link | None = None
        self._acquisition: Acquisition | None = None
        self._found: dict[str, Any] = {}

    @property
    def facts(self) -> CameraFacts:
        """Read-out time of the settings; longest exposure and frame shape as soon as they are known."""
        mode, shape = self._settings.mode, self._found.get("frame_shape")
        if shape is None and self._simulated is not None:
            shape = mode.frame_shape(self._simulated.sensor_shape)
        elif shape is None and mode.region is not None:
            shape = mode.frame_shape(mode.region[2:])
        _, longest_s = self._found.get("exposure_bounds_s", (0.0, self._settings.max_exposure))
        longest_s = min(longest_s, self._settings.max_exposure)
        return CameraFacts(
            self._settings.readout, longest_s, shape, triggers=("software", "internal", "external")
        )

    def warm(self) -> None:
        """Work out what all simulated frames have in common."""
        if self._simulated is not None:
            self._simulated.warm()

    def describe(self) -> Mapping[str, Any]:
        """Settings; once opened, also what the camera is, what it took, and its temperature in kelvins."""
        described = {**self._settings.model_dump(mode="json"), "model": "GenICam camera", **self._found}
        if self._link is not None:
            with self._link.doing("ask the camera how it is") as camera:
                described["exposure_now_s"] = camera.exposure_s
                described["temperature_k"] = temperature_k(camera)
        return described

    def _connect(self) -> None:
        settings, address = self._settings, self._settings.camera
        if self._simulated is not None:
            address = self._simulated.open()
            size = settings.packet_size or LOOPBACK_PACKET
            settings = settings.model_copy(update={"packet_size": size})
        self._link = link = Link(self._name, address)
        self._found = identify(link, settings) | set_up(link, settings)
        self._acquisition = Acquisition(link, settings)

    def _disconnect(self) -> None:
        link, self._link, self._acquisition = self._link, None, None
        try:
            if link is not None:
                link.close()
        finally:
            if self._simulated is not None:
                self._simulated.close()

    def _start(self, series: Series) -> None:
        acquisition, simulated = self._opened(), self._simulated
        start = STARTS[series.trigger] if simulated is None else simulated.start_of(series)
        period_s = acquisition.prepare(series, start)
        if simulated is not None:
            simulated.arm(series, period_s, acquisition)
        acquisition.begin(start)

    def _fire(self) -> None:
        (self._simulated or self._opened()).fire()

    def _take(self, timeout_s: float) -> ExposureResult | None:
        simulated = self._simulated
        if simulated is None:
            return self._wait(timeout_s)
        max_wait_s = simulated.wait(timeout_s)
        taken = None if max_wait_s is None else self._wait(max_wait_s)
        simulated.raise_pending()
        return None if taken is None else replace(taken, t_start_s=simulated.start_s(taken.number))

    def _end(self) -> None:
        """The camera may go on waiting: what is prepared next decides."""
        if self._simulated is not None:
            self._simulated.clear()

    def _stop(self) -> None:
        if self._simulated is not None:
            self._simulated.clear()
        self._opened().stop()

    def _wait(self, timeout_s: float) -> ExposureResult | None:
        """Wait for a frame, and ask now and then whether the camera is still there."""
        acquisition, asked_s = self._opened(), time.monotonic()

        def poll(longest_s: float) -> ExposureResult | None:
            nonlocal asked_s
            taken = acquisition.poll(longest_s)
            if taken is None and time.monotonic() - asked_s >= ASK_S:
                acquisition.ask()
                asked_s = time.monotonic()
            return taken

        taken = wait_for(poll, timeout_s, self._clock)
        if taken is None:
            acquisition.ask()
        return taken

    def _opened(self) -> Acquisition:
        if self._acquisition is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._acquisition
