"""The base class of all settings, and the types of its quantities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, TypeAlias, cast

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo

from labseq.config.yaml_nodes import beside
from labseq.units import expected, parse_quantity

FOLDER: Final = "folder"
"""Key of the validation context: the folder of the file that the settings stand in."""

MAX_DURATION_S: Final = 30 * 86_400.0
"""Longest time that anything may take: far more than any run, and every clock can count it."""


class Settings(BaseModel):
    """Base of every settings model: frozen, strict about keys, SI inside.

    Subclass it for your plugin; give each field a description and, where it has
    one, a default. Quantities take a number in SI or text such as "45 ms".

    Example:
        >>> class Mine(Settings):
        ...     exposure: Duration = 45e-3
        >>> Mine(exposure="20 ms").exposure
        0.02
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=False)


class NoSettings(Settings):
    """The settings of what takes none."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Reads a number, or text with a unit, into SI.

    Attributes:
        dimension: A key of :data:`labseq.units.UNITS`.
    """

    dimension: str

    def __call__(self, value: Any) -> Any:
        """Read text; numbers are SI already."""
        if isinstance(value, str):
            return parse_quantity(value, self.dimension)
        if value is None or isinstance(value, bool | list | tuple | dict):
            raise ValueError(f"expected {expected(self.dimension)}")
        return value


def _quantity(dimension: str) -> BeforeValidator:
    return BeforeValidator(Quantity(dimension))


def _not_too_long(duration_s: float) -> float:
    if duration_s > MAX_DURATION_S:
        raise ValueError("expected at most 720 h, which is 30 days")
    return duration_s


def _beside_its_file(path: Path, info: ValidationInfo) -> Path:
    context = cast("Mapping[str, Path]", info.context or {})
    return beside(context.get(FOLDER, Path()), str(path))


FilePath: TypeAlias = Annotated[Path, AfterValidator(_beside_its_file)]
"""A file, relative to the sequence or profile that names it; in Python, to the working folder."""
Duration: TypeAlias = Annotated[float, _quantity("time"), Field(ge=0), AfterValidator(_not_too_long)]
"""Seconds, 0 to :data:`MAX_DURATION_S`; "45 ms"."""
Length: TypeAlias = Annotated[float, _quantity("length")]
"""Metres; "4.49 um"."""
Frequency: TypeAlias = Annotated[float, _quantity("frequency")]
"""Hertz; "80 MHz"."""
Speed: TypeAlias = Annotated[float, _quantity("speed"), Field(gt=0)]
"""Metres per second, more than 0; "130 um/ms"."""
Voltage: TypeAlias = Annotated[float, _quantity("voltage")]
"""Volts; "200 mV"."""
Power: TypeAlias = Annotated[float, _quantity("power")]
"""Watts; "10 mW"."""
Temperature: TypeAlias = Annotated[float, _quantity("temperature")]
"""Kelvins; "300 uK"."""
Angle: TypeAlias = Annotated[float, _quantity("angle")]
"""Radians; "60 deg"."""
Fraction: TypeAlias = Annotated[float, _quantity("fraction"), Field(ge=0, le=1)]
"""0 to 1; "75 %"."""
