"""Settings that camera drivers share."""

from __future__ import annotations

from typing import Self, get_args

from pydantic import Field, NonNegativeInt, PositiveInt, model_validator

from labseq.errors import ConfigError
from labseq.model import CameraFacts, Flip, Orientation, SensorMode
from labseq.roles import Context, LineTrigger, Simulation, Trigger
from labseq.settings import Duration, PositiveDuration, Settings


class RegionSettings(Settings):
    """The part of the sensor that is read, in pixels of the sensor."""

    y: NonNegativeInt = Field(default=0, description="first row")
    x: NonNegativeInt = Field(default=0, description="first column")
    height: PositiveInt = Field(description="number of rows")
    width: PositiveInt = Field(description="number of columns")


class OrientationSettings(Settings):
    """Orientation of the images relative to the sensor. Positions of sites refer to the image."""

    transpose: bool = Field(
        default=False, description="exchange rows and columns of the sensor's frame, before `flip`"
    )
    flip: Flip = Field(
        default="none",
        description="reverse the order of rows (the image is turned upside down), of columns (it is mirrored "
        "left to right), or of both",
    )

    @property
    def orientation(self) -> Orientation:
        """The orientation as drivers use it."""
        return Orientation(self.transpose, self.flip)


class CameraSettings(OrientationSettings):
    """Settings of the sensor that every camera has. A plugin adds its own."""

    region: RegionSettings | None = Field(
        default=None,
        description="the part of the sensor that is read, in the sensor's orientation (default: all of it)",
    )
    binning: PositiveInt = Field(
        default=1, description="pixels of the sensor per pixel of a frame, along each axis"
    )
    max_exposure: PositiveDuration = Field(default=10.0, description="longest exposure")
    line_trigger: LineTrigger = Field(
        default="external",
        description="with `external` each edge of the line with `triggers: camera` starts an exposure, with "
        "`external_start` one edge starts a series with an exposure every `cycle_time`, and with `bulb` the "
        "camera exposes while the line is on",
    )
    cycle_time: PositiveDuration | None = Field(
        default=None,
        description="with `external_start`, time from the start of one exposure to the start of the next",
    )
    arming_time: Duration = Field(
        default=0.0,
        description="time from arming until a series can be triggered, for budgets. Simulated cameras "
        "take this long",
    )

    @property
    def mode(self) -> SensorMode:
        """Region and binning with which the sensor is read."""
        region = self.region
        place = None if region is None else (region.y, region.x, region.height, region.width)
        return SensorMode(place, self.binning)

    def frame_shape(self, sensor_shape: tuple[int, int] | None) -> tuple[int, int] | None:
        """(height, width) of the images. None if neither the sensor nor a region is known."""
        if sensor_shape is None and self.region is None:
            return None
        return self.orientation.shape(self.mode.frame_shape(sensor_shape or (0, 0)))

    def facts(
        self,
        readout_s: float,
        frame_shape: tuple[int, int] | None,
        triggers: tuple[str, ...] = get_args(Trigger),
        **more: float,
    ) -> CameraFacts:
        """The facts about the camera, from its driver and from these settings.

        Args:
            readout_s: From the end of an exposure until the frame can be read, in seconds.
            frame_shape: (height, width) of the images. None if unknown.
            triggers: Triggers that may start exposures. Default all.
            **more: Further attributes of :class:`labseq.plugin.CameraFacts`, such as ``em_gain``.
        """
        settings = {
            "max_exposure_s": self.max_exposure,
            "arm_s": self.arming_time,
            "cycle_s": self.cycle_time or 0.0,
        }
        facts = {**settings, **more}
        return CameraFacts(
            readout_s, frame_shape=frame_shape, triggers=triggers, line_trigger=self.line_trigger, **facts
        )

    def sensor_conflict(self, sensor_shape: tuple[int, int]) -> str:
        """Why region and binning do not fit a sensor of (height, width) pixels, or "" if they do."""
        y, x, height, width = self.mode.region or (0, 0, *sensor_shape)
        if y + height > sensor_shape[0] or x + width > sensor_shape[1]:
            rows, cols = sensor_shape
            end = f"`region` ends at row {y + height} and column {x + width}"
            return f"{end}, beyond the sensor of {rows} x {cols} pixels; choose a smaller or another one"
        return _unbinnable(height, width, self.binning)

    def simulated_world(self, context: Context) -> tuple[Simulation, tuple[int, int]]:
        """The simulation whose frames a simulated camera takes, and (height, width) of its sensor.

        Raises:
            ConfigError: The simulation is missing or describes no sensor, or the region is beyond the sensor.
        """
        simulation = context.simulation
        if simulation is None or simulation.sensor_shape is None:
            problem = "a simulated camera needs a simulation that describes its sensor"
            raise ConfigError(f"{problem}; add `simulation: {{use: virtual}}` to the profile")
        if setting_error := self.sensor_conflict(simulation.sensor_shape):
            raise ConfigError(setting_error)
        return simulation, simulation.sensor_shape

    @model_validator(mode="after")
    def _cycle_time_is_of_external_start(self) -> Self:
        if self.line_trigger == "external_start" and self.cycle_time is None:
            raise ValueError("`external_start` needs a `cycle_time`, at which the camera exposes")
        if self.line_trigger != "external_start" and self.cycle_time is not None:
            raise ValueError(
                "`cycle_time` needs `line_trigger: external_start`; else each exposure has its own trigger"
            )
        return self

    @model_validator(mode="after")
    def _region_can_be_binned(self) -> Self:
        if self.region is not None and (
            text := _unbinnable(self.region.height, self.region.width, self.binning)
        ):
            raise ValueError(text)
        return self


def _unbinnable(height: int, width: int, binning: int) -> str:
    if height % binning == 0 and width % binning == 0:
        return ""
    text = f"{height} x {width} pixels cannot be binned by {binning}"
    return f"{text}; choose a `region` whose height and width are multiples of the binning"
