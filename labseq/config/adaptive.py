"""An adaptive scan: ranges of values, and what chooses the points in them while the run goes on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Final, Self, TypeAlias

from pydantic import Field, WithJsonSchema, model_validator

from labseq.config.fields import Choice, Text, setting_error
from labseq.config.nodes import Loc, Mark, Node
from labseq.config.scan_values import MAX_POINTS, Number
from labseq.config.settings import Settings
from labseq.units import factor_of, scaled, written

MAX_RANGES: Final = 6
"""Most addresses of an adaptive scan: both ends of all of them are checked in every combination."""

_DIGITS: Final = 4  # of a range: finer than any setting of a machine is worth

End: TypeAlias = Annotated[Any, WithJsonSchema({"type": ["number", "string"]})]
"""A number or quantity; which one, the address decides."""
Points: TypeAlias = Annotated[int, Field(ge=1, le=MAX_POINTS)]


class EndsSettings(Settings):
    """The range of an address."""

    low: End = Field(alias="from", description="least value")
    high: End = Field(alias="to", description="greatest value")
    steps: Points | None = Field(
        default=None, description="number of equal steps between the values; without it any value will do"
    )


class AdaptiveChoice(Choice):
    """A scanner chosen by name; its settings stand beside the name."""

    over: dict[str, EndsSettings] = Field(
        min_length=1, max_length=MAX_RANGES, description="addresses and their ranges"
    )
    maximise: Text | None = Field(default=None, description="figure of the run's index to climb on")
    minimise: Text | None = Field(default=None, description="the same, where less is better")
    points: Points | None = Field(default=None, description="the most points")

    @model_validator(mode="after")
    def _has_one_aim(self) -> Self:
        if self.maximise is None and self.minimise is None:
            raise setting_error("the scan has no aim", "'maximise' or 'minimise' with the name of a figure")
        if self.maximise is not None and self.minimise is not None:
            raise setting_error(
                "'maximise' and 'minimise' stand together", "one of them", at=("minimise",), key=True
            )
        return self


SCANNER_KEYS: Final = frozenset({"over", "maximise", "minimise", "points"})
"""Keys that stand beside the settings of a scanner, and belong to the core."""


@dataclass(frozen=True, slots=True)
class Ends:
    """The range of an address as it is written.

    Attributes:
        low: The least value.
        high: The greatest value, in the unit of the least.
        n_steps: Number of equal steps; 0 where any value will do.
        mark: Where it stands.
    """

    low: Number
    high: Number
    n_steps: int
    mark: Mark

    @property
    def unit(self) -> str:
        """The unit that values are written in; "" for plain numbers."""
        return self.low.unit

    def si(self, number: Number) -> float:
        """One of the ends in SI."""
        return scaled(number.amount, factor_of(self.unit))

    def node(self, value: float) -> Node:
        """A value, SI, as somebody would have written it: where any value will do, with few digits."""
        if not isinstance(value, int) and not self.n_steps:
            low, high = self.low.amount, self.high.amount
            n_decimals = _DIGITS - math.floor(math.log10(high - low))
            amount = min(max(round(value / factor_of(self.unit), n_decimals), low), high)
            value = scaled(amount, factor_of(self.unit))
        text = written(value, self.unit)
        return Node(text if self.unit else value, self.mark, raw=text)


@dataclass(frozen=True, slots=True)
class Adaptive:
    """What chooses the points of a scan, and what for.

    Attributes:
        choice: The scanner's name and place.
        ends: The range of each axis.
        n_points: The most points.
        figure: What the scan climbs on.
        maximise: Whether more of it is better.
    """

    choice: Choice
    ends: tuple[Ends, ...]
    n_points: int
    figure: str
    maximise: bool

    @property
    def aim(self) -> Loc:
        """Where the figure is named."""
        return (*self.choice.loc, "maximise" if self.maximise else "minimise")
