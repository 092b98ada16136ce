"""What is known of some cameras before they are opened, and how long a read-out takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from labseq.plugin import SensorMode

ROW_OVERHEAD_S: Final = 3e-6
"""Time that a row takes beyond its pixels, in seconds (ours)."""


@dataclass(frozen=True, slots=True)
class Head:
    """A camera head.

    The figures are those of cameras of this name as far as they are known; heads differ from one to the
    next, and the camera itself tells what it has when it is opened.

    Attributes:
        model: What it calls itself.
        sensor_shape: (height, width) in pixels.
        pixel_m: Side of a pixel, in metres.
        em_rates_hz: Read-out rates of the amplifier behind the EM register, fastest first.
        conventional_rates_hz: Those of the other one.
        shifts_s: Times to shift all rows by one, fastest first.
        recommended_shift: Index of the fastest that the maker recommends.
        preamp_gains: Gains of the pre-amplifier.
    """

    model: str
    sensor_shape: tuple[int, int]
    pixel_m: float
    em_rates_hz: tuple[float, ...]
    conventional_rates_hz: tuple[float, ...]
    shifts_s: tuple[float, ...]
    recommended_shift: int
    preamp_gains: tuple[float, ...]


IXON_897: Final = Head(
    "DU-897",
    (512, 512),
    16e-6,
    (17e6, 10e6, 5e6, 1e6),
    (3e6, 1e6, 80e3),
    (0.3e-6, 0.5e-6, 0.9e-6, 1.7e-6, 3.3e-6),
    1,
    (1.0, 2.0, 3.0),
)
IXON_888: Final = Head(
    "DU-888",
    (1024, 1024),
    13e-6,
    (30e6, 20e6, 10e6, 1e6),
    (1e6, 0.1e6),
    (0.6e-6, 1.13e-6, 2.2e-6, 4.33e-6),
    1,
    (1.0, 2.0),
)
HEADS: Final = (IXON_897, IXON_888)


def known_head(model: str) -> Head | None:
    """The head of this name, or whose name begins or is begun by it; None if it is not known."""
    for head in HEADS:
        if model and (model.upper().startswith(head.model) or head.model.startswith(model.upper())):
            return head
    return None


@dataclass(frozen=True, slots=True)
class ReadOut:
    """How a sensor is read.

    Attributes:
        rate_hz: Pixels per second.
        shift_s: Time to shift all rows by one, in seconds.
        isolated_crop: Whether the region is all that the camera knows of the sensor.
    """

    rate_hz: float
    shift_s: float
    isolated_crop: bool = False

    def duration_s(self, sensor_shape: tuple[int, int], mode: SensorMode) -> float:
        """Time from the end of an exposure until the last pixel is read, in seconds.

        All rows are shifted under the mask; then each row of the region is shifted into the register and
        read, and the other rows are thrown away. A row is read to its full width, except in isolated
        crop. The formula is ours: the SDK tells the true time once the camera is open.
        """
        _, _, height, width = mode.region or (0, 0, *sensor_shape)
        n_rows, n_columns = (height, width) if self.isolated_crop else sensor_shape
        n_read = height // mode.binning
        return 2 * n_rows * self.shift_s + n_read * (n_columns / self.rate_hz + ROW_OVERHEAD_S)
