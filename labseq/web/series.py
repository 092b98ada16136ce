"""Quantities and their means for the pages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from labseq.analysis.scanned import shown_unit, title_of
from labseq.data.quantities import Quantity, description_of
from labseq.model.estimate import Estimated, Rate


def about_quantity(quantity: Quantity, values: Sequence[float]) -> dict[str, Any]:
    """A quantity for JSON: its name, and the unit in which these values are easy to read."""
    unit, factor = shown_unit(quantity, values)
    return {
        "name": quantity.name,
        "title": title_of(quantity),
        "about": description_of(quantity.name),
        "is_fraction": quantity.is_fraction,
        "unit": unit,
        "factor": factor,
    }


def finite(value: float) -> float | None:
    """A number for JSON: None instead of nan or infinity."""
    return float(value) if math.isfinite(value) else None


def interval_of(value: Estimated) -> list[float | None]:
    """The 68 % interval for JSON."""
    return [finite(end) for end in value.interval]


def mean_values(value: Estimated) -> dict[str, Any]:
    """A mean for JSON: its 68 % interval and, for a rate, the numbers of events and trials."""
    is_known = not math.isnan(value.value)
    counts = {"n": value.n, "n_trials": value.n_trials} if isinstance(value, Rate) else {}
    return {
        "value": finite(value.value),
        "interval": interval_of(value) if is_known else [None, None],
        **counts,
    }
