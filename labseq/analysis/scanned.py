"""The points of a scan, the quantities at each, their tables, and fits of them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from labseq.console.report import aligned
from labseq.console.text import count_of
from labseq.data import Run
from labseq.data.columns import Column, make_column
from labseq.data.fits import Fit, fit_points
from labseq.data.points import ScanPoint, scan_points
from labseq.data.quantities import Quantity, description_of, find_quantity
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, visible
from labseq.model.estimate import Estimate, Estimated, Rate
from labseq.units import UNITS, dimension_of, factor_of, readable_unit, si_unit_of, split_quantity

DEFAULT: Final = ("filling", "defect_free")
"""The quantities at the points of a scan, unless others are named."""
WITHOUT_TARGET: Final = ("n_loaded", "n_atoms")
"""The quantities at the points of a scan of a run without a target, unless others are named."""


@dataclass(frozen=True, slots=True)
class Axis:
    """A scanned address and its values.

    Attributes:
        address: The address, and those that change together with it.
        labels: Its different values as written, in the order of the scan.
        numbers: The same as numbers, and the unit of these; None if they are not numbers of one dimension.
    """

    address: str
    labels: tuple[str, ...]
    numbers: tuple[tuple[float, ...], str] | None


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """The points of a scan.

    Attributes:
        axes: Independent addresses, the slowest first.
        places: Index of each point's value on each axis.
        points: The points, with their shots.
    """

    axes: tuple[Axis, ...]
    places: tuple[tuple[int, ...], ...]
    points: tuple[ScanPoint, ...]

    @property
    def is_map(self) -> bool:
        """Whether there are two axes or more, and most combinations of their values have a point."""
        n_cells = math.prod(len(axis.labels) for axis in self.axes)
        return len(self.axes) > 1 and len({*self.places}) >= n_cells / 2

    def over(self, quantity: Quantity) -> list[Estimated]:
        """The mean of a quantity at each point."""
        return [quantity.over(point.shots) for point in self.points]

    def on_axis(self, number: int) -> tuple[list[float], str] | None:
        """Each point's value on an axis, and the unit that it is written in; None if they are not numbers."""
        numbers = self.axes[number].numbers
        if numbers is None:
            return None
        return [numbers[0][place[number]] for place in self.places], numbers[1]


def scanned(run: Run) -> Scanned | None:
    """The points of a run's scan that have shots; None without a scan.

    Raises:
        RecordingError: The scan in run.json is damaged.
    """
    points = scan_points(run)
    if not points or not points[0].parameters:  # --set may have replaced every address
        return None
    rows = [tuple(map(clean, row)) for row in run.scan["written"]]
    columns, values = list(zip(*rows, strict=True)), list(zip(*run.scan["points"], strict=True))
    numbers = [_numbers(*pair) for pair in zip(values, columns, strict=True)]
    addresses = list(map(clean, points[0].written))
    # an axis at least, even if all points have the same value
    varied = [i for i, column in enumerate(columns) if len({*column}) > 1] or [0]
    together: dict[int, list[str]] = {}
    # addresses that change together share an axis
    for i in varied:
        leader = next((k for k in together if _follows(columns, numbers, i, k)), i)
        together.setdefault(leader, []).append(addresses[i])
    axes = tuple(make_axis(" with ".join(names), columns[i], values[i]) for i, names in together.items())
    written = [tuple(map(clean, point.written.values())) for point in points]
    places = tuple(
        tuple(axis.labels.index(row[i]) for axis, i in zip(axes, together, strict=True)) for row in written
    )
    return Scanned(axes, places, tuple(points))


def make_axis(address: str, labels: Sequence[str], values: Sequence[Any]) -> Axis:
    """An axis from the labels and values, SI, of its points, of which some may be equal."""
    value_of_label = dict(zip(labels, values, strict=True))
    return Axis(address, tuple(value_of_label), _numbers([*value_of_label.values()], [*value_of_label]))


def _follows(
    columns: Sequence[Sequence[str]], numbers: Sequence[tuple[Sequence[float], str] | None], i: int, k: int
) -> bool:
    """Whether the values of address i change together with those of address k, and not by chance.

    No two points of an optimiser share a value; numbers must then rise or fall together.
    """
    leader, own_numbers, leader_numbers = columns[k], numbers[i], numbers[k]
    if len({*zip(columns[i], leader, strict=True)}) > len({*leader}):
        return False
    if len({*leader}) < len(leader) or own_numbers is None or leader_numbers is None:
        return True
    steps = np.diff(np.array(own_numbers[0])[np.argsort(leader_numbers[0], kind="stable")])
    return bool((steps >= 0).all() or (steps <= 0).all())


def _numbers(values: Sequence[Any], written: Sequence[str]) -> tuple[tuple[float, ...], str] | None:
    """Values as numbers in the unit of the largest, and that unit; None unless they have one dimension."""
    if not all(type(value) in (int, float) for value in values):
        return None
    units = [split_quantity(text)[1] for text in written]
    if len({dimension_of(unit) for unit in units}) > 1:
        return None
    unit = units[int(np.argmax(np.abs(values)))]
    # without the rounding error of the division: 0.3 ms, not 0.30000000000000004 ms
    return tuple(float(f"{value / factor_of(unit):.12g}") for value in values), re.sub(
        r"\bu(?=[msVWK]\b)", "µ", unit
    )


def is_geometric(values: Sequence[float]) -> bool:
    """Whether rising values have nearly equal ratios, over a wide range."""
    if len(values) < 3 or values[0] <= 0 or values[-1] < 20 * values[0]:
        return False
    steps = np.diff(np.log(values))
    return float(np.ptp(steps)) <= 0.5 * float(steps.mean())  # "1, 2, 5, 10" passes


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """The quantities to show at the points of a scan, and their fits.

    Attributes:
        names: Names of the quantities; none for :data:`DEFAULT`.
        fit: A model of :data:`labseq.analysis.fits.MODELS`, or None.
        fit_settings: "NAME=VALUE" for parameters of the fit.
    """

    names: tuple[str, ...] = ()
    fit: str | None = None
    fit_settings: tuple[str, ...] = ()


def scan_request(
    names: Sequence[str] | None,
    fit: str | None = None,
    fit_settings: Sequence[str] | None = None,
) -> ScanRequest | None:
    """The options of a command as a request; None if there are none.

    Raises:
        ConfigError: Settings of a fit are given without a fit.
    """
    if fit_settings and fit is None:
        raise ConfigError(Problem("this needs a fit", "--fit-set", expected="--fit MODEL as well"))
    if names is None and fit is None:
        return None
    return ScanRequest(tuple(name for name in names or () if name), fit, tuple(fit_settings or ()))


@dataclass(frozen=True, slots=True, eq=False)
class ScanReport:
    """Quantities at the points of a scan.

    Attributes:
        scan: The points.
        values: Each quantity with its mean at each point.
        fits: The fit of each quantity; empty without.
    """

    scan: Scanned
    values: tuple[tuple[Quantity, list[Estimated]], ...]
    fits: tuple[Fit, ...] = ()

    def as_text(self) -> list[str]:
        """A map for each quantity if all pairs of two values were scanned, else a table; then the fits."""
        axes, n_places = self.scan.axes, len({*self.scan.places})
        if len(axes) == 2 and n_places == math.prod(len(axis.labels) for axis in axes):
            tables = [
                line for quantity, values in self.values for line in (*self._map(quantity, values), "")
            ][:-1]
        else:
            tables = self.table()
        if not axes:
            tables = ["the run has no scan: these are all its shots", "", *tables]
        return [*tables, *(line for fit in self.fits for line in ("", *fit.lines()))]

    def table(self, most: int = 0) -> list[str]:
        """A row for each point.

        Args:
            most: Maximum number of rows; 0 for all.
        """
        written = [tuple(map(clean, point.written.values())) for point in self.scan.points]
        header = (*map(clean, self.scan.points[0].written), "shots", *(title_of(q) for q, _ in self.values))
        rows = [
            (
                *point_values,
                str(len(point.shots)),
                *(value_text(values[i], quantity) for quantity, values in self.values),
            )
            for i, (point_values, point) in enumerate(zip(written, self.scan.points, strict=True))
        ]
        return aligned([header, *rows], right=range(len(header)), most=most)

    def _map(self, quantity: Quantity, values: Sequence[Estimated]) -> list[str]:
        down, across = self.scan.axes
        at = {
            place: value_text(value, quantity, short=True)
            for place, value in zip(self.scan.places, values, strict=True)
        }
        rows = [
            (label, *(at.get((i, j), "-") for j in range(len(across.labels))))
            for i, label in enumerate(down.labels)
        ]
        header = ("", *across.labels)
        title = [title_of(quantity), f"down: {down.address}", f"across: {across.address}"]
        return [*title, *aligned([header, *rows], right=range(len(header)))]

    def as_json(self) -> dict[str, Any]:
        """The points and fits, SI: points are counted from 0."""
        points = [
            {
                "parameters": dict(point.parameters),
                "shots": len(point.shots),
                "values": {quantity.name: values[i] for quantity, values in self.values},
            }
            for i, point in enumerate(self.scan.points)
        ]
        names = [quantity.name for quantity, _ in self.values]
        fits = dict(zip(names, self.fits, strict=False))
        return {"points": points} | ({"fits": fits} if fits else {})

    def columns(self, units: Mapping[str, str]) -> list[Column]:
        """A row for each point, SI: scanned values, shots, quantities and their intervals.

        Args:
            units: Address -> SI unit.
        """
        points = self.scan.points
        columns = [
            make_column(name, [point.parameters[name] for point in points], units.get(name, ""), "scanned")
            for name in points[0].parameters
        ]
        columns.append(make_column("shots", [len(point.shots) for point in points], "", "shots at the point"))
        for quantity, means in self.values:
            description = description_of(quantity.name)
            parts = (
                ("", [mean.value for mean in means], f"mean over the shots of: {description}"),
                (" low", [mean.interval[0] for mean in means], "lower end of its 1 sigma interval"),
                (" high", [mean.interval[1] for mean in means], "upper end of its 1 sigma interval"),
            )
            columns += [
                make_column(f"{quantity.name}{end}", values, quantity.unit, meaning)
                for end, values, meaning in parts
            ]
        return columns


def scan_report(run: Run, request: ScanRequest) -> ScanReport:
    """Quantities at the points of a run's scan; without a scan, over all shots.

    Raises:
        ConfigError: The run has no shots, there is no such quantity, or the fit cannot be made.
        RecordingError: The scan in run.json is damaged.
    """
    if not run.shots:
        raise ConfigError(Problem("the run has no shots yet", visible(str(run.path))))
    scan = scanned(run) or Scanned((), ((),), (ScanPoint({}, {}, tuple(run.shots)),))
    names = request.names or (*_aim(run), *(WITHOUT_TARGET if run.target.is_none else DEFAULT))
    quantities = [find_quantity(run, name) for name in names]
    values = tuple((quantity, scan.over(quantity)) for quantity in quantities)
    for quantity, means in values if request.names else ():
        if all(math.isnan(mean.value) for mean in means):
            raise ConfigError(Problem(f"no shot has a value of '{quantity.name}'", clean(run.path.name)))
    fits = (
        tuple(_fit(run, scan, quantity, means, request) for quantity, means in values) if request.fit else ()
    )
    return ScanReport(scan, values, fits)


def _aim(run: Run) -> tuple[str, ...]:
    """The quantity that an adaptive scan optimises, unless it is shown anyway."""
    name = str(run.scan.get("figure") or "")
    return (name,) if name and name not in {*DEFAULT, "filling_fraction", "success"} else ()


def _fit(
    run: Run, scan: Scanned, quantity: Quantity, values: Sequence[Estimated], request: ScanRequest
) -> Fit:
    on_axis = scan.on_axis(0) if len(scan.axes) == 1 else None
    if on_axis is None:
        raise ConfigError(
            Problem("there is no axis to fit along", "--fit", expected="a scan of one numerical value")
        )
    x, unit = on_axis
    parameters: dict[str, str] = {}
    for setting in request.fit_settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(Problem(f"'{clean(setting)}' has no value", "--fit-set", expected="NAME=VALUE"))
        parameters[name.strip()] = value.strip()
    profile: Mapping[str, Any] = (run.record.get("resolved") or {}).get("profile") or {}
    units = si_unit_of(f"1 {unit}"), "%" if quantity.is_fraction else quantity.unit
    factor = factor_of(unit)
    assert request.fit is not None
    return fit_points(
        request.fit,
        [factor * number for number in x],
        values,
        units,
        parameters,
        profile.get("simulation") or {},
    )


def title_of(quantity: Quantity) -> str:
    """The name of a quantity in tables and titles."""
    return "defect-free" if quantity.name == "defect_free" else clean(quantity.name)


def value_text(value: Estimated, quantity: Quantity, *, short: bool = False) -> str:
    """A mean of a quantity with its error, in a readable unit."""
    if isinstance(value, Rate):
        return rate_text(value) if short else counted_text(value)
    if quantity.is_fraction:
        return share_text(value)
    unit, factor = shown_unit(quantity, [value.value])
    text = str(value.scaled(1 / factor))
    return text if text == "-" else f"{text} {unit}".rstrip()


def shown_unit(quantity: Quantity, values: Sequence[float]) -> tuple[str, float]:
    """A unit in which values of a quantity are readable, and its factor to SI."""
    if quantity.is_fraction:
        return "%", 0.01
    sizes = [abs(value) for value in values if math.isfinite(value)]
    dimension = dimension_of(quantity.unit)
    if not dimension or not sizes:
        return quantity.unit, 1.0
    unit = readable_unit(max(sizes), dimension)
    return unit, UNITS[dimension][unit]


def rate_text(rate: Rate) -> str:
    """A rate in per cent, with its interval.

    Example:
        >>> rate_text(Rate(7, 20)), rate_text(Rate(0, 0))
        ('35.0 % (25.3 to 46.2)', '-')
    """
    if not rate.n_trials:
        return "-"
    low, high = rate.interval
    return f"{100 * rate.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def share_text(fraction: Estimate) -> str:
    """A mean fraction in per cent.

    Example:
        >>> share_text(Estimate(0.97664, 0.0004))
        '97.66(4) %'
    """
    text = str(fraction.scaled(100.0))
    return text if text == "-" else f"{text} %"


def counted_text(rate: Rate) -> str:
    """A count, its total and its rate, with its interval.

    Example:
        >>> counted_text(Rate(7, 20)), counted_text(Rate(0, 0))
        ('7 of 20 (35.0 %), 25.3 to 46.2 %', '0 of 0')
    """
    if not rate.n_trials:
        return count_of(0, 0)
    low, high = rate.interval
    return f"{count_of(rate.n, rate.n_trials)}, {100 * low:.1f} to {100 * high:.1f} %"
