"""Andor EMCCD cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final

import numpy as np

from labseq.plugin import (
    CameraFacts,
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    format_quantity,
)
from labseq.plugin.camera import ExposureResult, Series
from labseq.plugin.sdk_camera import SdkCamera, without_rounding
from labseq.plugin.units import ZERO_CELSIUS_K
from labseq_andor.codes import (
    EXTERNAL,
    EXTERNAL_EXPOSURE,
    EXTERNAL_START,
    GONE,
    INTERNAL,
    KINETIC,
    OVERRUN,
    RUN_TILL_ABORT,
    SHUTTER_AUTO,
    SHUTTER_CLOSED,
    SHUTTER_OPEN,
    SOFTWARE,
    Code,
    Features,
    TriggerModes,
    explain,
)
from labseq_andor.connection import code_of, connection_for
from labseq_andor.sdk import AndorSdk
from labseq_andor.settings import AndorSettings
from labseq_andor.setup import set_up

TRIGGERS: Final[Mapping[str, tuple[int, TriggerModes]]] = {
    "software": (SOFTWARE, TriggerModes.CONTINUOUS),
    "internal": (INTERNAL, TriggerModes.INTERNAL),
    "external": (EXTERNAL, TriggerModes.EXTERNAL),
    "external_start": (EXTERNAL_START, TriggerModes.EXTERNALSTART),
    "bulb": (EXTERNAL_EXPOSURE, TriggerModes.EXTERNALEXPOSURE),
}
"""labseq's trigger -> the SDK's trigger mode, and the flag of a camera that has it."""

BULB_AND_TRANSFER: Final = Features.FTEXTERNALEXPOSURE | Features.KINETICEXTERNALEXPOSURE
"""Features of a camera that takes series with the bulb trigger and frame transfer."""

TEMPERATURE_PERIOD_S: Final = 1.0
"""How often the temperature is read while the sensor cools, in seconds."""


class AndorCamera(SdkCamera):
    """An Andor EMCCD camera, for example an iXon, through Andor's SDK2.

    The shutter is open from ``open()`` on, so that no frame waits for it, and closed in the safe state. EM
    gain is on during a series only. The cooler stays on in the safe state, and by default when the camera is
    closed.

    Attributes:
        connection: The camera through Andor's library, or a simulated one.

    Raises:
        ConfigError: The region does not fit the sensor, or the simulated camera has no simulation.
    """

    def __init__(self, settings: AndorSettings, context: Context) -> None:
        super().__init__(settings, settings.cooling, context)
        self._settings = settings
        self.connection = connection_for(settings, context)
        self._sensor_shape = self.connection.sensor_shape
        if self._sensor_shape is not None and (conflict := settings.sensor_conflict(self._sensor_shape)):
            raise ConfigError(conflict)
        self._readout_s = settings.readout_s(self.connection.head, self._sensor_shape)
        self._max_exposure_s = settings.max_exposure
        self._triggers = tuple(TRIGGERS)
        self._reported: dict[str, Any] = {}
        self._em_gain = 1
        self._shutter = "none"
        self._shutter_times_ms = (0, 0)
        self._shutter_open_at_s = 0.0
        self._set_for: tuple[str, int, float] | None = None
        self._exposure_s = math.nan
        self._n_fetched: int | None = None

    @property
    def facts(self) -> CameraFacts:
        """Limits of the camera. The read-out time is an estimate before ``open()``, then the SDK's value."""
        shape = self._settings.frame_shape(self._sensor_shape)
        known = {"max_exposure_s": self._max_exposure_s, "em_gain": float(self._settings.em_gain)}
        return self._settings.facts(self._readout_s, shape, self._triggers, **known)

    def warm(self) -> None:
        """Do slow work that can be done before the camera is opened."""
        self.connection.warm(self.facts.em_gain)

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the SDK and the camera. No real camera was tried."""
        reported = self._reported
        return {
            "SDK2": (reported.get("sdk_version", ""), ""),
            "firmware": (reported.get("firmware", ""), ""),
        }

    def describe(self) -> Mapping[str, Any]:
        """Settings, and once opened also the camera's own report and its current state."""
        described = {"model": "Andor EMCCD", **self._settings.model_dump(mode="json"), **self._reported}
        described |= {"readout_s": self._readout_s, "frame_shape": self.facts.frame_shape}
        if self.connection.is_open:
            described |= {"shutter_now": self._shutter, "em_gain_now": self._em_gain, "temperature_k": None}
            with suppress(DeviceError):  # the camera acquires, or measures no temperature
                described["temperature_k"] = round(self._read_temperature()[1], 2)
        return described

    # open and close

    def _connect(self) -> None:
        settings, connection = self._settings, self.connection
        connection.open()
        self._shutter, self._set_for = "none", None
        with connection.selected() as sdk:
            if connection.capabilities.ulFeatures & Features.SHUTTER:
                self._shutter_times_ms = sdk.GetShutterMinTimes()
                self._shutter = "open"
                self._close_shutter(sdk)
            self._reported = set_up(connection)
            height, width = self._reported["sensor_shape"]
            self._sensor_shape = (height, width)
            self._readout_s = without_rounding(sdk.GetReadOutTime(), self._readout_s)
            self._max_exposure_s = min(settings.max_exposure, sdk.GetMaximumExposure())
        self._triggers = self._find_triggers()
        self._open_shutter()

    def _find_triggers(self) -> tuple[str, ...]:
        """The triggers that the camera has. Bulb with frame transfer has capabilities of its own."""
        capabilities = self.connection.capabilities
        triggers = [name for name, (_, flag) in TRIGGERS.items() if capabilities.ulTriggerModes & flag]
        lacks_both = capabilities.ulFeatures & BULB_AND_TRANSFER != BULB_AND_TRANSFER
        if self._settings.frame_transfer and lacks_both and "bulb" in triggers:
            triggers.remove("bulb")
        self._check_line_trigger(tuple(triggers))
        return tuple(triggers)

    def _disconnect(self) -> None:
        self.connection.close()

    # temperature

    def settle(self) -> None:
        """Wait until the sensor is cold, and the camera also reports a stabilized temperature.

        Raises:
            DeviceTimeoutError: It takes too long.
        """
        cooling = self._cooling
        if cooling is None:
            return
        start_s = self._clock.now()
        super().settle()
        while (status := self._read_temperature()[0]) != Code.TEMP_STABILIZED:
            if self._clock.now() - start_s >= cooling.timeout_s:
                waited = format_quantity(cooling.timeout_s, "time")
                text = f"the camera does not report a stabilized temperature after {waited} (status {status})"
                raise DeviceTimeoutError(
                    self._name, f"{text}; raise `timeout` of its cooling", cooling.timeout_s
                )
            self._clock.sleep(TEMPERATURE_PERIOD_S)

    def _read_temperature_k(self) -> float:
        return self._read_temperature()[1]

    def _read_temperature(self) -> tuple[int, float]:
        """The SDK's status of the cooling, and the temperature in kelvins."""
        with self.connection.selected() as sdk:
            status, celsius = sdk.GetTemperatureF()
        return status, celsius + ZERO_CELSIUS_K

    # a series

    def _start(self, series: Series) -> None:
        with self.connection.selected() as sdk:
            exposure_s = self._set_series(sdk, series)
        hint = "with frame transfer it cannot be shorter than the read-out"
        self._check_exposure(exposure_s, series.exposure_s, hint)
        self._set_em_gain(series.em_gain)
        self._open_shutter()
        self._clock.sleep(max(0.0, self._shutter_open_at_s - self._clock.now()))
        with self.connection.selected() as sdk:
            sdk.PrepareAcquisition()
            sdk.StartAcquisition()
        self._n_fetched = 0

    def _set_series(self, sdk: AndorSdk, series: Series) -> float:
        """Set trigger and times, unless they are set already. Returns the exposure that the camera makes."""
        n_frames = 0 if series.trigger == "software" else series.n_frames
        wanted = series.trigger, n_frames, series.exposure_s
        if wanted == self._set_for:
            return self._exposure_s
        self._set_for = None
        sdk.SetTriggerMode(TRIGGERS[series.trigger][0])
        # the software trigger works only in the mode "run till abort"
        sdk.SetAcquisitionMode(KINETIC if n_frames else RUN_TILL_ABORT)
        if n_frames:
            sdk.SetNumberAccumulations(1)
            sdk.SetNumberKinetics(n_frames)
        sdk.SetKineticCycleTime(self.facts.cycle_s if series.trigger == "external_start" else 0.0)
        sdk.SetExposureTime(series.exposure_s)
        exposure_s, _, cycle_s = sdk.GetAcquisitionTimings()
        if series.trigger == "external_start":
            self._check_cycle(cycle_s)
        if series.trigger == "bulb":  # the line makes it, whatever is set
            exposure_s = series.exposure_s
        self._set_for, self._exposure_s = wanted, without_rounding(exposure_s, series.exposure_s)
        return self._exposure_s

    def _set_em_gain(self, em_gain: float) -> None:
        if self._reported["em_gain_range"] is not None:
            gain = round(em_gain)
            with self.connection.selected() as sdk:
                sdk.SetEMCCDGain(gain if gain > 1 else 0)
            self._em_gain = gain

    def _open_shutter(self) -> None:
        """Start to open the shutter. No effect if it is open, or the camera controls none."""
        if self._shutter == "closed":
            is_auto = self._settings.shutter == "auto"
            with self.connection.selected() as sdk:
                self._set_shutter(sdk, SHUTTER_AUTO if is_auto else SHUTTER_OPEN)
            self._shutter = self._settings.shutter
            opening_s = 0.0 if is_auto else self._shutter_times_ms[1] / 1e3
            self._shutter_open_at_s = self._clock.now() + opening_s

    def _set_shutter(self, sdk: AndorSdk, mode: int) -> None:
        level = 1 if self._settings.shutter_opens_at == "high" else 0
        sdk.SetShutter(level, mode, *self._shutter_times_ms)

    def _fire(self) -> None:
        try:
            with self.connection.selected() as sdk:
                sdk.SendSoftwareTrigger()
        except DeviceError as error:
            if code_of(error) != Code.ERROR_CODES:
                raise
            text = "the camera cannot take a trigger while it reads a frame; fetch the last frame first"
            raise DeviceError(self._name, f"{text}, or set `frame_transfer: true`") from error

    def _take(self, timeout_s: float) -> ExposureResult | None:
        if self._n_fetched is None:
            return None
        return self.connection.wait(self._look, timeout_s)

    def _look(self, wait_s: float) -> ExposureResult | None:
        """Fetch the oldest frame, and wait for it for at most ``wait_s`` seconds."""
        number = self._oldest_number()
        if number is None and (fault := self._fault()):
            self._n_fetched = (self._n_fetched or 0) + 1
            return ExposureResult(self._n_fetched - 1, None, fault)
        if number is None and wait_s > 0 and self.connection.wait_in_sdk(wait_s):
            number = self._oldest_number()
        return None if number is None else self._fetch(number)

    def _oldest_number(self) -> int | None:
        """Number, from 1, of the oldest frame in the SDK's ring buffer that was not fetched."""
        try:
            with self.connection.selected() as sdk:
                first, _ = sdk.GetNumberNewImages()
        except DeviceError as error:
            if code_of(error) == Code.NO_NEW_DATA:
                return None
            raise
        return first

    def _fault(self) -> str:
        """Why no further frame will come, empty if no reason is known."""
        with self.connection.selected() as sdk:
            status = sdk.GetStatus()
        if status in GONE:
            raise DeviceError(self._name, explain("GetStatus", status))
        if status in OVERRUN:
            return f"the computer did not take the camera's data over in time (GetStatus gave {status})"
        return ""

    def _fetch(self, number: int) -> ExposureResult:
        connection = self.connection
        image = np.empty(self._settings.mode.frame_shape(self._sensor_shape or (0, 0)), np.uint16)
        with connection.selected() as sdk:
            sdk.GetImages16(number, number, image.ctypes.data, image.size)
        self._n_fetched = number
        time_s = math.nan
        if connection.capabilities.ulFeatures & Features.METADATA:
            with suppress(DeviceError):  # a frame without its time stamp is still of use
                time_s = connection.time_stamp_s(number - 1)
        return ExposureResult(number - 1, image, exposure_s=self._exposure_s, device_time_s=time_s)

    def _end(self) -> None:
        """Abort and turn the gain off. The shutter stays open."""
        self._attempt(_abort, self._turn_gain_off)

    def _stop(self) -> None:
        self._attempt(_abort, self._turn_gain_off, self._close_shutter)

    def _attempt(self, *actions: Callable[[AndorSdk], object]) -> None:
        """Make a wait return, then run all actions, even if some fail."""
        self._n_fetched = None
        if self.connection.is_open:
            failure = self.connection.attempt(lambda sdk: sdk.CancelWait(), *actions)
            if failure is not None:
                raise failure

    def _turn_gain_off(self, sdk: AndorSdk) -> None:
        if self._reported.get("em_gain_range") is not None:
            sdk.SetEMCCDGain(0)
            self._em_gain = 1

    def _close_shutter(self, sdk: AndorSdk) -> None:
        if self._shutter != "none":
            self._set_shutter(sdk, SHUTTER_CLOSED)
            self._shutter = "closed"


def _abort(sdk: AndorSdk) -> None:
    if sdk.GetStatus() == Code.ACQUIRING:
        sdk.AbortAcquisition()
