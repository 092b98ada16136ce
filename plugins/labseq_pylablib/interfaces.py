"""The five interfaces with the vendors' trigger modes, read-out modes, stamps and cooling.

Numbers of trigger modes come from the vendors' headers, which pylablib's tables follow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Final

from labseq.plugin import Context, Trigger
from labseq_pylablib.connection import Connection
from labseq_pylablib.library import DCAM, PCO, PICAM, PVCAM, SDK3, Vendor
from labseq_pylablib.settings import SIMULATED, PylablibSettings


def connection_for(settings: PylablibSettings, context: Context) -> Connection:
    """The connection that the settings choose."""
    if settings.camera == SIMULATED:
        from labseq_dcam_sim import SimulatedConnection

        return SimulatedConnection(settings, context)
    return INTERFACES[settings.interface](settings, context)


class Dcam(Connection):
    """Hamamatsu's DCAM-API (ORCA-Quest, Fusion, Flash), with properties by the names of ``dcamprop.h``."""

    vendor: ClassVar[Vendor] = DCAM
    has_falling_edge: ClassVar[bool] = True
    INTERNAL, EXTERNAL, SOFTWARE = 1, 2, 3
    EDGE, LEVEL = 1, 2
    NORMAL, START = 1, 6
    NEGATIVE, POSITIVE = 1, 2
    MODES: ClassVar[Mapping[Trigger, tuple[int, int, int]]] = {
        "software": (SOFTWARE, EDGE, NORMAL),
        "internal": (INTERNAL, EDGE, NORMAL),
        "external": (EXTERNAL, EDGE, NORMAL),
        "external_start": (EXTERNAL, EDGE, START),
        "bulb": (EXTERNAL, LEVEL, NORMAL),
    }
    """labseq's trigger -> TRIGGER SOURCE, TRIGGER ACTIVE and TRIGGER MODE."""
    PROPERTIES: ClassVar = ("TRIGGER SOURCE", "TRIGGER ACTIVE", "TRIGGER MODE")

    def places(self) -> Sequence[Any]:
        """Numbers of the cameras."""
        module = self.module
        try:
            with module.libctl.temp_open():
                return range(module.libctl.cameras)
        except module.DCAMLibError as error:
            if error.name != "DCAMERR_NOCAMERA":
                raise
            return ()

    def identity(self) -> tuple[str, str, str]:
        """Model, serial number without "S/N: ", version of the camera."""
        about = self.camera.get_device_info()
        return about.model, about.serial_number.removeprefix("S/N:").strip(), about.camera_version

    @property
    def readout_s(self) -> float:
        """TIMING READOUT TIME."""
        return float(self.camera.get_frame_readout_time())

    def triggers(self) -> tuple[Trigger, ...]:
        """The triggers whose three properties have the values."""
        values = [self._values(name) for name in self.PROPERTIES]
        modes = self.MODES.items()
        return tuple(
            name for name, mode in modes if all(v in have for v, have in zip(mode, values, strict=True))
        )

    def set_trigger(self, trigger: Trigger) -> None:
        """Set the three properties, and the polarity, the source first, since the others depend on it."""
        for name, value in zip(self.PROPERTIES, self.MODES[trigger], strict=True):
            self.camera.set_attribute_value(name, value, error_on_missing=False)
        rising = self.settings.trigger_edge == "rising"
        polarity = self.POSITIVE if rising else self.NEGATIVE
        self.camera.set_attribute_value("TRIGGER POLARITY", polarity, error_on_missing=False)

    def set_cycle(self, cycle_s: float) -> float:
        """INTERNAL FRAME INTERVAL."""
        self.camera.set_attribute_value("INTERNAL FRAME INTERVAL", cycle_s)
        return float(self.camera.get_attribute_value("INTERNAL FRAME INTERVAL"))

    def readout_modes(self) -> Mapping[str, Callable[[], object]]:
        """READOUT SPEED."""
        camera = self.camera
        return {speed: partial(camera.set_readout_speed, speed) for speed in camera.get_all_readout_speeds()}

    def read_temperature_c(self) -> float | None:
        """SENSOR TEMPERATURE."""
        return self.camera.get_attribute_value("SENSOR TEMPERATURE", error_on_missing=False)

    def cool(self, celsius: float) -> float | None:
        """Set SENSOR TEMPERATURE TARGET, and switch SENSOR COOLER on."""
        camera, target = self.camera, "SENSOR TEMPERATURE TARGET"
        attribute = camera.get_attribute(target, error_on_missing=False)
        if attribute is None or not attribute.writable:
            return None
        camera.set_attribute_value(target, min(max(celsius, attribute.min), attribute.max))
        camera.set_attribute_value("SENSOR COOLER", 2, error_on_missing=False)
        return float(camera.get_attribute_value(target))

    def stamps(self, info: Any) -> tuple[int | None, float]:
        """Frame stamp and time stamp, which is 0 from cameras without it."""
        return info.framestamp, info.timestamp_us * 1e-6 if info.timestamp_us > 0 else math.nan

    def details(self) -> Mapping[str, Any]:
        """CONVERSION FACTOR, which is the electrons per count and the counts of no electrons."""
        names = {
            "electrons_per_count": "CONVERSION FACTOR COEFF",
            "offset_counts": "CONVERSION FACTOR OFFSET",
        }
        value = partial(self.camera.get_attribute_value, error_on_missing=False)
        return {key: value(name) for key, name in names.items()}

    def _values(self, name: str) -> Sequence[int]:
        """Values that a property can have, the first alone for a camera without the property."""
        attribute = self.camera.get_attribute(name, error_on_missing=False)
        return (1,) if attribute is None else attribute.ivalues


class Sdk3(Connection):
    """Andor's SDK3 (Zyla, Neo, Sona, Marana), with features by the names of its manual."""

    vendor: ClassVar[Vendor] = SDK3
    MODES: ClassVar[Mapping[Trigger, tuple[str, str]]] = {
        "software": ("software", "Software"),
        "internal": ("int", "Internal"),
        "external": ("ext", "External"),
        "external_start": ("ext_start", "External Start"),
        "bulb": ("ext_exp", "External Exposure"),
    }
    """labseq's trigger -> pylablib's name and the SDK's."""

    def places(self) -> Sequence[Any]:
        """Numbers of the cameras. The last two that the SDK reports are its simulated ones."""
        return range(self.module.get_cameras_number())

    def identity(self) -> tuple[str, str, str]:
        """CameraModel, SerialNumber, FirmwareVersion."""
        about = self.camera.get_device_info()
        return about.camera_model, about.serial_number, about.firmware_version

    @property
    def readout_s(self) -> float:
        """ReadoutTime."""
        return float(self.camera.get_attribute_value("ReadoutTime"))

    def triggers(self) -> tuple[Trigger, ...]:
        """Values of TriggerMode."""
        available = self.camera.get_attribute("TriggerMode").values
        return tuple(name for name, (_, text) in self.MODES.items() if text in available)

    def set_trigger(self, trigger: Trigger) -> None:
        """TriggerMode."""
        self.camera.enable_metadata(True)
        self.camera.set_trigger_mode(self.MODES[trigger][0])

    def set_cycle(self, cycle_s: float) -> float:
        """FrameRate."""
        return float(self.camera.set_frame_period(cycle_s) or self.camera.get_frame_period())

    def readout_modes(self) -> Mapping[str, Callable[[], object]]:
        """PixelReadoutRate."""
        name, camera = "PixelReadoutRate", self.camera
        rates = camera.get_attribute(name).values
        return {rate: partial(camera.set_attribute_value, name, rate) for rate in rates}

    def read_temperature_c(self) -> float | None:
        """SensorTemperature."""
        return float(self.camera.get_temperature())

    def cool(self, celsius: float) -> float | None:
        """TargetSensorTemperature and SensorCooling."""
        return float(self.camera.set_temperature(celsius))

    def stamps(self, info: Any) -> tuple[int | None, float]:
        """The time stamp. Frames have no number."""
        ticks_per_s = self.camera.get_attribute_value("TimestampClockFrequency")
        return None, info.timestamp_dev / ticks_per_s if info.timestamp_dev > 0 else math.nan


class Picam(Connection):
    """PICam of Princeton Instruments (ProEM, PIXIS, Blaze), with parameters by pylablib's names."""

    vendor: ClassVar[Vendor] = PICAM
    has_falling_edge: ClassVar[bool] = True
    MODES: ClassVar[Mapping[Trigger, int]] = {"internal": 1, "external": 2, "bulb": 4}
    """labseq's trigger -> PicamTriggerResponse. PICam has no software trigger."""
    RISING, FALLING = 3, 4

    def places(self) -> Sequence[Any]:
        """Serial numbers of the cameras."""
        return [camera.serial_number for camera in self.module.list_cameras()]

    def identity(self) -> tuple[str, str, str]:
        """Model and serial number."""
        about = self.camera.get_device_info()
        return about.model, about.serial_number, ""

    @property
    def readout_s(self) -> float:
        """Readout Time Calculation, which is in milliseconds."""
        return float(self.camera.get_attribute_value("Readout Time Calculation")) * 1e-3

    def triggers(self) -> tuple[Trigger, ...]:
        """Values of Trigger Response."""
        available = self.camera.get_attribute("Trigger Response").ivalues
        return tuple(name for name, value in self.MODES.items() if value in available)

    def set_trigger(self, trigger: Trigger) -> None:
        """Trigger Response and Trigger Determination."""
        camera = self.camera
        camera.enable_metadata(True)
        camera.set_attribute_value("Trigger Response", self.MODES[trigger])
        edge = self.RISING if self.settings.trigger_edge == "rising" else self.FALLING
        camera.set_attribute_value("Trigger Determination", edge, error_on_missing=False)

    def readout_modes(self) -> Mapping[str, Callable[[], object]]:
        """ADC Speed, in MHz."""
        name, camera = "ADC Speed", self.camera
        speeds = camera.get_attribute(name).values
        return {f"{speed:g} MHz": partial(camera.set_attribute_value, name, speed) for speed in speeds}

    def read_temperature_c(self) -> float | None:
        """Sensor Temperature Reading."""
        return float(self.camera.get_attribute_value("Sensor Temperature Reading"))

    def cool(self, celsius: float) -> float | None:
        """Sensor Temperature Set Point. The cooler is always on."""
        self.camera.set_attribute_value("Sensor Temperature Set Point", celsius)
        return float(self.camera.get_attribute_value("Sensor Temperature Set Point"))

    def stamps(self, info: Any) -> tuple[int | None, float]:
        """Number and start of the exposure, None from cameras without them."""
        stamp, ticks = getattr(info, "framestamp", None), getattr(info, "timestamp_start", None)
        ticks_per_s = self.camera.get_attribute_value("Time Stamp Resolution", error_on_missing=False)
        return stamp, ticks / ticks_per_s if ticks and ticks_per_s else math.nan


class Pvcam(Connection):
    """PVCAM of Teledyne Photometrics (Prime, Kinetix, Evolve)."""

    vendor: ClassVar[Vendor] = PVCAM
    MODES: ClassVar[Mapping[Trigger, str]] = {
        "software": "e_soft_edge",
        "internal": "e_int",
        "external": "e_rise_edge",
        "bulb": "e_level",
    }
    """labseq's trigger -> pylablib's name of PL_EXPOSURE_MODES."""
    CODES: ClassVar[Mapping[Trigger, int]] = {
        "software": 12 << 8,
        "internal": 7 << 8,
        "external": 9 << 8,
        "bulb": 10 << 8,
    }
    """labseq's trigger -> PL_EXPOSURE_MODES of pvcam.h."""

    def places(self) -> Sequence[Any]:
        """Names of the cameras."""
        return self.module.list_cameras()

    def identity(self) -> tuple[str, str, str]:
        """Product and serial number."""
        about = self.camera.get_device_info()
        return about.product or about.chip or "", about.serial or "", ""

    @property
    def readout_s(self) -> float:
        """PARAM_READOUT_TIME."""
        return float(self.camera.get_readout_time())

    def triggers(self) -> tuple[Trigger, ...]:
        """Values of PARAM_EXPOSURE_MODE."""
        available = self.camera.get_attribute("EXPOSURE_MODE").ivalues
        return tuple(name for name, code in self.CODES.items() if code in available)

    def set_trigger(self, trigger: Trigger) -> None:
        """The exposure mode."""
        self.camera.enable_metadata(True)
        self.camera.set_trigger_mode(self.MODES[trigger])

    def readout_modes(self) -> Mapping[str, Callable[[], object]]:
        """Port, speed and gain."""
        camera = self.camera
        return {
            f"{mode.port_name}, {mode.speed_freq / 1e6:g} MHz, {mode.gain_name}": partial(
                camera.set_readout_mode, mode.port_idx, mode.speed_idx, mode.gain_idx
            )
            for mode in camera.get_all_readout_modes()
        }

    def read_temperature_c(self) -> float | None:
        """PARAM_TEMP."""
        return self.camera.get_temperature()

    def cool(self, celsius: float) -> float | None:
        """PARAM_TEMP_SETPOINT."""
        return self.camera.set_temperature(celsius)

    def stamps(self, info: Any) -> tuple[int | None, float]:
        """Number and start of the exposure, None from cameras without metadata."""
        stamp, start_ns = getattr(info, "framestamp", None), getattr(info, "timestamp_start_ns", None)
        return stamp, math.nan if start_ns is None else start_ns * 1e-9


class Pco(Connection):
    """pco.sdk (edge, panda, dimax). pylablib opens the first camera only."""

    vendor: ClassVar[Vendor] = PCO
    MODES: ClassVar[Mapping[Trigger, str]] = {
        "software": "software",
        "internal": "int",
        "external": "ext",
        "bulb": "ext_exp",
    }
    """labseq's trigger -> pylablib's name."""

    def places(self) -> Sequence[Any]:
        """The first camera, whatever its number."""
        return (0,)

    def identity(self) -> tuple[str, str, str]:
        """Model and serial number."""
        about = self.camera.get_device_info()
        return about.model, str(about.serial_number), ""

    @property
    def readout_s(self) -> float:
        """The camera's period without its exposure."""
        exposure_s, period_s = self.camera.get_frame_timings()
        return float(period_s - exposure_s)

    def triggers(self) -> tuple[Trigger, ...]:
        """Triggers of every PCO camera."""
        return tuple(self.MODES)

    def set_trigger(self, trigger: Trigger) -> None:
        """The trigger mode."""
        self.camera.set_trigger_mode(self.MODES[trigger])

    def readout_modes(self) -> Mapping[str, Callable[[], object]]:
        """Pixel rates."""
        camera = self.camera
        rates = camera.get_available_pixel_rates()
        return {f"{rate / 1e6:g} MHz": partial(camera.set_pixel_rate, rate) for rate in rates}

    def read_temperature_c(self) -> float | None:
        """Temperature of the sensor, of three that the camera tells."""
        return float(self.camera.get_temperature()[0])

    def cool(self, celsius: float) -> float | None:
        """Do nothing, since pylablib does not set it and the settings refuse it."""
        del celsius

    def details(self) -> Mapping[str, Any]:
        """The conversion factor."""
        return {"electrons_per_count": self.camera.get_conversion_factor()}

    def _prepare(self, n_frames: int) -> None:
        self.camera.setup_acquisition(nframes=n_frames)


INTERFACES: Final[Mapping[str, type[Connection]]] = {
    "dcam": Dcam,
    "sdk3": Sdk3,
    "picam": Picam,
    "photometrics": Pvcam,
    "pco": Pco,
}
"""Value of `interface` -> its class."""
