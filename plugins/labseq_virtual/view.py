"""What a mode of the sensor makes of the image settings."""

from __future__ import annotations

from typing import Self

from pydantic import Field

from labseq.plugin import WHOLE_SENSOR, LimitError, SensorMode
from labseq_virtual.image_settings import ImageSettings


class View(ImageSettings):
    """Image settings with the part of the sensor that is read, and the gain and light in force."""

    region: tuple[int, int, int, int] = Field(description="[y, x, height, width] of the part that is read")
    binning: int = Field(
        description="pixels of the sensor per pixel of a frame along each axis: added up before the register "
        "of an EMCCD, and after the read-out of a qCMOS camera"
    )

    @classmethod
    def of(cls, settings: ImageSettings, mode: SensorMode = WHOLE_SENSOR) -> Self:
        """The settings as a mode makes them; no stray light behind a closed shutter.

        Raises:
            LimitError: The sensor has no such part, cannot be binned so, or has no EM register.
        """
        region = mode.region or (0, 0, *settings.frame)
        _check(settings, mode, region)
        made: dict[str, object] = {"region": region, "binning": mode.binning}
        if mode.em_gain is not None:
            made["em_gain"] = mode.em_gain
        if not mode.shutter_open:
            made["background"] = 0.0
        return cls.model_validate(settings.model_dump() | made)

    @property
    def readout_fraction(self) -> float:
        """Time to read a frame, relative to that of the whole sensor without binning.

        An EMCCD reads its pixels one after the other, a qCMOS camera its rows.
        """
        height, width = self.frame
        rows, cols = self.region[2:]
        if self.sensor == "qcmos":
            return rows / height
        return rows * cols / (height * width * self.binning**2)


def _check(settings: ImageSettings, mode: SensorMode, region: tuple[int, int, int, int]) -> None:
    y, x, height, width = region
    rows, cols = settings.frame
    if min(y, x) < 0 or min(height, width) < 1 or y + height > rows or x + width > cols:
        text = f"[y, x, height, width] = {list(region)}"
        raise LimitError("the region of the sensor", text, f"its {rows} x {cols} pixels")
    if mode.binning < 1 or height % mode.binning or width % mode.binning:
        raise LimitError(
            "the binning", mode.binning, f"what divides the {height} x {width} pixels of the region"
        )
    if settings.sensor == "qcmos" and mode.em_gain not in (None, 1.0):
        hint = "leave the camera's `em_gain` out, or set the simulation's `image.sensor: emccd`"
        raise LimitError("the EM gain", f"{mode.em_gain:g}", "1: a qCMOS sensor has no EM register", hint)
