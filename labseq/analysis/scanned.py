"""What commands print of a scan: the quantities at its points and their fits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from labseq.console.report import aligned
from labseq.console.text import count_of
from labseq.data.columns import Column, make_column
from labseq.data.fits import Fit
from labseq.data.points import ScanPoint
from labseq.data.precision import follows
from labseq.data.quantities import (
    Quantity,
    description_of,
    find_quantity,
    measured_by,
    quantity_of,
)
from labseq.data.reader import Run
from labseq.data.results import own_fits, reported
from labseq.data.scanned import FitAt, FitRequest, Scanned, fits_along, scanned
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, visible
from labseq.model.estimate import Estimate, Estimated, Rate
from labseq.units import UNITS, dimension_of, readable_unit


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """The quantities to show at the points of a scan, and their fits.

    Attributes:
        names: Names of the quantities. Empty for the quantities that the run measures.
        fit: The fit of each quantity. None for the fits that the run's sequence asks for.
    """

    names: tuple[str, ...] = ()
    fit: FitRequest | None = None


def scan_request(
    names: Sequence[str] | None,
    fit: str | None = None,
    fit_settings: Sequence[str] | None = None,
    along: str | None = None,
) -> ScanRequest | None:
    """The options of a command as a request. None if no option is given.

    Raises:
        ConfigError: Settings of a fit are given without a fit, or without a value.
    """
    for option, value in (("--fit-set", fit_settings), ("--along", along)):
        if value and fit is None:
            raise ConfigError(Problem("this needs a fit", option, expected="--fit MODEL as well"))
    if names is None and fit is None:
        return None
    given = dict(map(_fit_setting, fit_settings or ()))
    wanted = None if fit is None else FitRequest(fit, given, along)
    return ScanRequest(tuple(name for name in names or () if name), wanted)


def _fit_setting(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(Problem(f"'{clean(text)}' has no value", "--fit-set", expected="NAME=VALUE"))
    return name.strip(), value.strip()


@dataclass(frozen=True, slots=True, eq=False)
class ScanReport:
    """Quantities at the points of a scan.

    Attributes:
        scan: The points.
        values: Each quantity with its mean at each point.
        fits: The fits of each quantity, at each combination of the other axes. Empty without fits.
    """

    scan: Scanned
    values: tuple[tuple[Quantity, list[Estimated]], ...]
    fits: tuple[list[FitAt], ...] = ()

    def as_text(self) -> list[str]:
        """A map for each quantity if all pairs of two values were scanned, else a table. Then the fits."""
        axes, n_places = self.scan.axes, len({*self.scan.places})
        if len(axes) == 2 and n_places == math.prod(len(axis.labels) for axis in axes):
            tables = [
                line for quantity, values in self.values for line in (*self._map(quantity, values), "")
            ][:-1]
        else:
            tables = self.table()
        if not axes:
            tables = ["the run has no scan: these are all its shots", "", *tables]
        lines: list[str] = []
        for (quantity, _), fits in zip(self.values, self.fits, strict=False):
            if fits:
                lines += ["", *fit_lines(fits, f" of {title_of(quantity)}" if len(self.values) > 1 else "")]
        return [*tables, *lines]

    def table(self, most: int = 0) -> list[str]:
        """A row for each point.

        Args:
            most: Maximum number of rows. 0 for all.
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
        n_scanned = len(self.scan.points[0].written)
        return aligned([header, *rows], right=range(len(header)), most=most, keys=n_scanned)

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
        """The points, counted from 0, and fits, in SI."""
        points = [
            {
                "parameters": dict(point.parameters),
                "shots": len(point.shots),
                "values": {quantity.name: values[i] for quantity, values in self.values},
            }
            for i, point in enumerate(self.scan.points)
        ]
        names = [quantity.name for quantity, _ in self.values]
        fits = {
            name: fits if fits[0].values else fits[0].fit or fits[0]
            for name, fits in zip(names, self.fits, strict=False)
            if fits
        }
        return {"points": points} | ({"fits": fits} if fits else {})

    def columns(self, units: Mapping[str, str]) -> list[Column]:
        """A table in SI with a row for each point: scanned values, shots, quantities and their intervals.

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
    """Evaluate quantities at the points of a run's scan. Without a scan, over all shots.

    Raises:
        ConfigError: The run has no shots, there is no such quantity, or the fit cannot be made.
        RecordingError: The scan in run.json is damaged.
    """
    if not run.shots:
        raise ConfigError(Problem("the run has no shots yet", visible(str(run.path))))
    scan = scanned(run) or Scanned((), ((),), (ScanPoint({}, {}, tuple(run.shots)),))
    if request.names:
        quantities = [find_quantity(run, name) for name in request.names]
    else:
        quantities = [quantity_of(run, name) for name in dict.fromkeys((*_aim(run), *measured_by(run)))]
    values = tuple((quantity, scan.over(quantity)) for quantity in quantities)
    for quantity, means in values if request.names else ():
        if all(math.isnan(mean.value) for mean in means):
            raise ConfigError(Problem(f"no shot has a value of '{quantity.name}'", clean(run.path.name)))
    fit = request.fit
    fits: tuple[list[FitAt], ...] = ()
    if fit is not None:
        # without a name, only the first quantity, because a model rarely suits the others
        wanted = quantities if request.names else quantities[:1]
        fits = _fits_of(run, scan, [one for one in values if one[0] in wanted], fit)
        fits += ([],) * (len(values) - len(wanted))
    elif not request.names:
        fits = tuple(own_fits(run, scan, quantity, means) for quantity, means in values)
    return ScanReport(scan, values, fits)


def _fits_of(
    run: Run, scan: Scanned, values: Sequence[tuple[Quantity, list[Estimated]]], request: FitRequest
) -> tuple[list[FitAt], ...]:
    """The fits of each quantity. If one of several fails, the others are still shown.

    Raises:
        ConfigError: No quantity can be fitted.
    """
    fits: list[list[FitAt]] = []
    errors: list[ConfigError] = []
    for quantity, means in values:
        try:
            fits.append(fits_along(run, scan, quantity, means, request))
        except ConfigError as error:
            errors.append(error)
            problem = "; ".join(problem.what for problem in error.problems)
            failed = f"no fit {clean(request.model)} of {title_of(quantity)}: {problem}"
            fits.append([FitAt({}, {}, None, failed)])
    if len(errors) == len(values):
        raise errors[0]
    return tuple(fits)


def results_of(run: Run, report: ScanReport) -> list[tuple[str, str]]:
    """The results of a run: name and value of the parameter that its sequence reports, in each fit."""
    rows: list[tuple[str, str]] = []
    is_one = sum(map(bool, report.fits)) == 1
    for (quantity, _), fits in zip(report.values, report.fits, strict=False):
        for at in fits:
            result = reported(run, quantity, at)
            if at.fit is not None and result is not None:
                where = f", {result.at}" if result.at else ""
                of = "" if is_one else f" of {title_of(quantity)}"
                rows.append((f"{result.name}{of}{where}", f"{result.value}{_doubt(at.fit)}"))
            elif at.problem:
                rows.append((title_of(quantity), at.problem))
    return rows


def _aim(run: Run) -> tuple[str, ...]:
    """The quantity that an adaptive scan optimises, unless it is shown anyway."""
    name = str(run.scan.get("figure") or "")
    return (name,) if name and name not in {"filling_fraction", "success"} else ()


def _doubt(fit: Fit) -> str:
    """A warning that the points do not follow the model, which a value's error does not show."""
    if follows(fit) or math.isnan(fit.reduced_chi_square):
        return ""
    return f" (reduced chi-square {fit.reduced_chi_square:.2g}: the points do not follow the model)"


def fit_lines(fits: Sequence[FitAt], of: str = "") -> list[str]:
    """A fit with a line for each parameter. Several fits are a table, followed by the reasons of failures.

    Args:
        fits: The fit, or the fits at each value of the other axes.
        of: Name of the fitted quantity if it must be given, such as " of filling".
    """
    made = [at.fit for at in fits if at.fit is not None]
    if not made:
        return [fits[0].problem]
    if not fits[0].values:
        return made[0].lines(of)
    names = list(dict.fromkeys(name for fit in made for name in fit.free))
    rows = [(*fits[0].written, *names, "chi-square")]
    for at in fits:
        results = ["-"] * (len(names) + 1)
        if at.fit is not None:
            results = [str(at.fit.parameters[name]) for name in names] + [f"{at.fit.reduced_chi_square:.2f}"]
        rows.append((*at.written.values(), *results))
    failed = [f"{', '.join(at.written.values())}: {at.problem}" for at in fits if at.problem]
    return [f"fit {made[0].model}{of}: {made[0].formula}", *aligned(rows, right=range(len(rows[0]))), *failed]


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
    """A unit in which values of a quantity are easy to read, and its factor to SI."""
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
