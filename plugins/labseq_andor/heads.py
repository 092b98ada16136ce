"""Facts about some camera heads before they are opened, and how long a read-out takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from labseq.plugin import SensorMode

ROW_OVERHEAD_S: Final = 3e-6
"""Time per row in addition to reading its pixels, in seconds (our estimate)."""


@dataclass(frozen=True, slots=True)
class Head:
    """A camera head.

    The values are typical of cameras of this name. Individual heads differ. Once a camera is open, the driver
    uses the camera's report.

    Attributes:
        model: Name that the camera reports.
        sensor_shape: (height, width) in pixels.
        em_rates_hz: Read-out rates of the amplifier behind the EM register, fastest first.
        conventional_rates_hz: Read-out rates of the conventional amplifier.
        shifts_s: Times to shift all rows by one, fastest first.
        recommended_shift: Index of the fastest shift that Andor recommends.
        preamp_gains: Gains of the pre-amplifier.
    """

    model: str
    sensor_shape: tuple[int, int]
    em_rates_hz: tuple[float, ...]
    conventional_rates_hz: tuple[float, ...]
    shifts_s: tuple[float, ...]
    recommended_shift: int
    preamp_gains: tuple[float, ...]

    def rates_hz(self, amplifier: str) -> tuple[float, ...]:
        """Read-out rates of the amplifier "em" or "conventional", fastest first."""
        return self.em_rates_hz if amplifier == "em" else self.conventional_rates_hz


IXON_897: Final = Head(
    "DU-897",
    (512, 512),
    (17e6, 10e6, 5e6, 1e6),
    (3e6, 1e6, 80e3),
    (0.3e-6, 0.5e-6, 0.9e-6, 1.7e-6, 3.3e-6),
    1,
    (1.0, 2.0, 3.0),
)
IXON_888: Final = Head(
    "DU-888",
    (1024, 1024),
    (30e6, 20e6, 10e6, 1e6),
    (1e6, 0.1e6),
    (0.6e-6, 1.13e-6, 2.2e-6, 4.33e-6),
    1,
    (1.0, 2.0),
)
HEADS: Final = (IXON_897, IXON_888)


def known_head(model: str) -> Head | None:
    """The head with this name, or with a longer or shorter form of it, None if it is not known."""
    for head in HEADS:
        if model and (model.upper().startswith(head.model) or head.model.startswith(model.upper())):
            return head
    return None


def readout_s(
    rate_hz: float, shift_s: float, sensor_shape: tuple[int, int], mode: SensorMode, *, isolated_crop: bool
) -> float:
    """Time from the end of an exposure until the last pixel is read, in seconds.

    All rows are shifted under the mask. Then each row of the region is shifted into the register and read.
    The other rows are discarded. A row is read to its full width, except in isolated crop. The formula is
    ours. Once the camera is open, the SDK reports the true time.

    Args:
        rate_hz: Pixels per second.
        shift_s: Time to shift all rows by one, in seconds.
        sensor_shape: (height, width) of the sensor.
        mode: Region and binning.
        isolated_crop: Whether the camera ignores the sensor outside the region.
    """
    _, _, height, width = mode.region or (0, 0, *sensor_shape)
    n_rows, n_columns = (height, width) if isolated_crop else sensor_shape
    return 2 * n_rows * shift_s + height // mode.binning * (n_columns / rate_hz + ROW_OVERHEAD_S)
