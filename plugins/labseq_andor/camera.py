"""Andor EMCCD cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final

from labseq.plugin import (
    CameraDriver,
    CameraFacts,
    ConfigError,
    Context,
    DeviceError,
    ExposureResult,
    LimitError,
    ReportsSensor,
    SensorMode,
    Series,
    format_quantity,
    wait_for,
)
from labseq_andor.codes import Code, Triggers
from labseq_andor.cold import temperature_k, wait_until_cold
from labseq_andor.counterpart import SimulatedCamera, SimulatedSdk
from labseq_andor.heads import IXON_897, Head
from labseq_andor.library import bind_sdk, bind_simulator, load_pylablib
from labseq_andor.reading import Reader
from labseq_andor.sdk import Sdk, code_of
from labseq_andor.settings import SIMULATED, AndorSettings
from labseq_andor.setup import set_up
from labseq_andor.shutter import Shutter

TRIGGERS: Final[Mapping[str, tuple[str, int]]] = {
    "software": ("software", Triggers.CONTINUOUS),
    "internal": ("int", Triggers.INTERNAL),
    "external": ("ext", Triggers.EXTERNAL),
}
"""Trigger of labseq -> what pylablib calls it, and the flag of a camera that has it."""

ROUNDING: Final = 1e-6
"""Relative error of the SDK's times, which are float32."""

LONGER: Final = 1.01
"""How much longer than asked for an exposure may be."""


class AndorCamera(CameraDriver):
    """An Andor EMCCD camera, for example an iXon, through Andor's SDK2 and pylablib.

    The shutter is open from ``open()`` on, so that no frame waits for it, and closed in the safe state; EM
    gain is on in a series only. The cooler stays on in the safe state, and as a rule when the camera is
    closed.

    Args:
        settings: The camera, and how it is used.
        context: Name, clock, and for the simulated camera the simulated world.

    Attributes:
        simulated: The simulated camera; None for a real one.
        beside: Further simulated cameras at the same computer.

    Raises:
        ConfigError: The region does not fit the sensor, or the simulated camera has no simulated world.
    """

    def __init__(self, settings: AndorSettings, context: Context) -> None:
        super().__init__(context)
        self._settings = settings
        self._cooling = None if settings.cooling is None else settings.cooling.spec()
        self._world = context.simulation
        self.simulated: SimulatedCamera | None = None
        self.beside: list[SimulatedCamera] = []
        head = settings.head
        self._sensor_shape = None if head is None else head.sensor_shape
        if settings.camera == SIMULATED:
            head = self._simulate(settings, context)
        if self._sensor_shape is not None and (setting_error := settings.sensor_conflict(self._sensor_shape)):
            raise ConfigError(setting_error)
        self._readout_s = settings.readout_s(head, self._sensor_shape)
        self._max_exposure_s = settings.max_exposure
        self._triggers = tuple(TRIGGERS)
        self._sdk: Sdk | None = None
        self._stand_in: SimulatedSdk | None = None
        self._shutter: Shutter | None = None
        self._told: dict[str, Any] = {}
        self._em_gain = 1
        self._reader: Reader | None = None

    def _simulate(self, settings: AndorSettings, context: Context) -> Head:
        world = context.simulation
        if world is None:
            text = "the simulated camera needs a simulated world; add `simulation: {use: virtual}`"
            raise ConfigError(f"{text} to the profile")
        shape = world.sensor_shape if isinstance(world, ReportsSensor) else IXON_897.sensor_shape
        head = settings.head_for(shape)
        self._sensor_shape = shape
        self.simulated = SimulatedCamera(world, context.clock, head, shape)
        return head

    @property
    def facts(self) -> CameraFacts:
        """Read-out time: estimated before ``open()``, the SDK's own after it; and what else is known."""
        shape = None
        if self._sensor_shape is not None or self._settings.region is not None:
            shape = self._settings.mode.frame_shape(self._sensor_shape or (0, 0))
        gain = float(self._settings.em_gain)
        return CameraFacts(self._readout_s, self._max_exposure_s, shape, gain, self._triggers)

    def warm(self) -> None:
        """Import pylablib, which takes seconds; work out what all simulated frames have in common."""
        with suppress(DeviceError):  # open() says what is missing
            load_pylablib(self._name)
        if self.simulated is not None and isinstance(self._world, ReportsSensor):
            region = self._settings.mode.region
            is_whole = region == (0, 0, *self._world.sensor_shape)
            mode = SensorMode(None if is_whole else region, self._settings.binning, self.facts.em_gain)
            self._world.prepare_sensor(mode)

    @property
    def settling_timeout_s(self) -> float:
        """How long cooling may take, in seconds; 0 without."""
        return 0.0 if self._cooling is None else self._cooling.timeout_s

    def settle(self) -> None:
        """Wait until the sensor is cold, and the camera calls it stabilized too.

        Raises:
            DeviceTimeoutError: It does not get there in time.
        """
        if self._cooling is not None:
            self._check_open()
            wait_until_cold(self._opened(), self._cooling, self._clock, self._name)

    def describe(self) -> Mapping[str, Any]:
        """Settings; once opened, also what the camera says of itself, and what is in force now."""
        described = {"model": "Andor EMCCD", **self._settings.model_dump(mode="json"), **self._told}
        described |= {"readout_s": self._readout_s, "frame_shape": self.facts.frame_shape}
        if self._sdk is not None and self._shutter is not None:
            described |= {"shutter_now": self._shutter.state, "em_gain_now": self._em_gain}
            described["temperature_k"] = temperature_k(self._sdk)
        return described

    def _connect(self) -> None:
        andor = load_pylablib(self._name)
        if self.simulated is None:
            bind_sdk(self._name, andor, self._settings.sdk)
        else:
            self._stand_in = bind_simulator(self._name, andor, self.simulated, *self.beside)
        self._sdk = sdk = Sdk(self._name, andor, self.simulated)
        indices = tuple(range(sdk.count()))
        if self._stand_in is not None and self.simulated is not None:
            indices = self._stand_in.indices((self.simulated, *self.beside))
        sdk.connect(indices, self._settings.serial, self._settings.fan)
        self._told = set_up(sdk, self._settings, self._name)
        self._learn(sdk)
        self._shutter = Shutter(sdk, self._settings, self._clock)
        self._shutter.open()

    def _learn(self, sdk: Sdk) -> None:
        """What the camera knows better than the settings."""
        height, width = self._told["sensor_shape"]
        self._sensor_shape = (height, width)
        with sdk.selected() as lib:
            self._readout_s = _meant(float(lib.GetReadOutTime()), self._readout_s)
            self._max_exposure_s = min(self._settings.max_exposure, float(lib.GetMaximumExposure()))
        flags = sdk.capabilities.ulTriggerModes
        self._triggers = tuple(name for name, (_, flag) in TRIGGERS.items() if flags & flag)

    def _disconnect(self) -> None:
        sdk, self._sdk, self._shutter = self._sdk, None, None
        if sdk is not None:
            if sdk.camera is not None:
                sdk.attempt(self._leave_cooler)
            sdk.disconnect()
        if self._stand_in is not None and self.simulated is not None:
            self._stand_in.detach(self.simulated, *self.beside)
            self._stand_in = None

    def _leave_cooler(self, lib: Any) -> None:
        is_kept = self._settings.cooler_after_close == "keep"
        lib.SetCoolerMode(int(is_kept))
        if not is_kept:
            lib.CoolerOFF()

    def _start(self, series: Series) -> None:
        sdk, shutter = self._opened(), self._shutter
        with sdk.selected() as lib:
            sdk.camera.set_trigger_mode(TRIGGERS[series.trigger][0])
            if series.trigger == "software":  # which the SDK knows only when it runs till aborted
                sdk.camera.setup_cont_mode(0)
            else:
                sdk.camera.setup_kinetic_mode(series.n_frames)
            lib.SetExposureTime(series.exposure_s)
            exposure_s = _meant(float(lib.GetAcquisitionTimings()[0]), series.exposure_s)
        if exposure_s > LONGER * series.exposure_s:
            came, least = (format_quantity(s, "time") for s in (series.exposure_s, exposure_s))
            hint = "with frame transfer it cannot be shorter than the read-out"
            raise LimitError(f"{self._name}: exposure", came, f"at least {least}", hint)
        self._set_em_gain(sdk, series.em_gain)
        if shutter is not None:
            shutter.open()
            shutter.wait()
        with sdk.selected() as lib:
            lib.PrepareAcquisition()
            lib.StartAcquisition()
        shape = self._settings.mode.frame_shape(self._sensor_shape or (0, 0))
        self._reader = Reader(sdk, shape, exposure_s, self._name)

    def _set_em_gain(self, sdk: Sdk, em_gain: float) -> None:
        if self._told["em_gain_range"] is not None:
            gain = round(em_gain)
            with sdk.selected() as lib:
                lib.SetEMCCDGain(gain if gain > 1 else 0)
            self._em_gain = gain

    def _fire(self) -> None:
        try:
            with self._opened().selected() as lib:
                lib.SendSoftwareTrigger()
        except DeviceError as error:
            if code_of(error) != Code.ERROR_CODES:
                raise
            text = "the camera does not take a trigger yet: it still reads the last frame; read that first"
            raise DeviceError(self._name, f"{text}, or set `frame_transfer: true`") from error

    def _take(self, timeout_s: float) -> ExposureResult | None:
        reader, simulated = self._reader, self.simulated
        if reader is None:
            return None
        if simulated is None:
            return wait_for(reader.look, timeout_s, self._clock)
        start_s, expected = self._clock.now(), reader.n_taken
        simulated.acquisition.proceed()
        frame = simulated.sensor.take(timeout_s)
        if frame is None:
            return reader.look(0.0)
        left_s = max(0.0, timeout_s - (self._clock.now() - start_s))
        taken = wait_for(reader.look, left_s, self._clock)
        if taken is None:
            return None
        for _ in range(taken.number - expected):  # the ring buffer has lost them; the sensor has not
            frame = simulated.sensor.take(0.0) or frame
        return replace(taken, t_start_s=frame.t_start_s)

    def _end(self) -> None:
        """Abort; the shutter stays open, and the next series sets the gain."""
        self._attempt(_cancel_wait, _abort)

    def _stop(self) -> None:
        close = [] if self._shutter is None else [self._shutter.close]
        self._attempt(_cancel_wait, _abort, self._turn_gain_off, *close)

    def _attempt(self, *actions: Callable[[Any], None]) -> None:
        sdk, self._reader = self._sdk, None
        if sdk is not None and sdk.camera is not None and (failure := sdk.attempt(*actions)) is not None:
            raise failure

    def _turn_gain_off(self, lib: Any) -> None:
        if self._told.get("em_gain_range") is not None:
            lib.SetEMCCDGain(0)
            self._em_gain = 1

    def _opened(self) -> Sdk:
        if self._sdk is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._sdk


def _cancel_wait(lib: Any) -> None:
    lib.CancelWait()


def _abort(lib: Any) -> None:
    if int(lib.GetStatus()) == Code.ACQUIRING:
        lib.AbortAcquisition()


def _meant(value: float, wanted: float) -> float:
    """What the SDK says, or what was meant if it is that in float32."""
    return wanted if abs(value - wanted) <= ROUNDING * abs(wanted) else value
