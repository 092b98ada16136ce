"""The axes of a scan, quantities at its points, and fits along an axis."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from labseq.data.fit_models import MODELS
from labseq.data.fits import Fit, fit_points
from labseq.data.points import ScanPoint, scan_points
from labseq.data.quantities import Quantity
from labseq.data.reader import Run
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, did_you_mean, listing
from labseq.model.estimate import Estimated
from labseq.units import dimension_of, factor_of, scaled, si_unit_of, split_quantity

if TYPE_CHECKING:
    from labseq.data.lab_models import LabModel


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of a scan: a scanned address and its values.

    Attributes:
        address: The address, and any addresses that change together with it.
        labels: Its different values as written, in the order of the scan.
        numbers: The same values as numbers, with their unit. None unless all are numbers of one dimension.
    """

    address: str
    labels: tuple[str, ...]
    numbers: tuple[tuple[float, ...], str] | None

    def value(self, number: int) -> float | str:
        """The value with this index, SI, or as written if it is not a number."""
        if self.numbers is None:
            return self.labels[number]
        return scaled(self.numbers[0][number], factor_of(self.numbers[1]))


@dataclass(frozen=True, slots=True, eq=False)
class Scanned:
    """The points of a scan on its axes.

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
        """True for two or more axes if at least half the combinations of their values have a point."""
        n_cells = math.prod(len(axis.labels) for axis in self.axes)
        return len(self.axes) > 1 and len({*self.places}) >= n_cells / 2

    def over(self, quantity: Quantity) -> list[Estimated]:
        """The mean of a quantity at each point."""
        return [quantity.over(point.shots) for point in self.points]

    def on_axis(self, number: int) -> tuple[list[float], str] | None:
        """Each point's value on an axis and its unit as written. None if the values are not numbers."""
        numbers = self.axes[number].numbers
        if numbers is None:
            return None
        return [numbers[0][place[number]] for place in self.places], numbers[1]


def scanned(run: Run) -> Scanned | None:
    """The points of a run's scan that have shots. None without a scan.

    Raises:
        RecordingError: The scan in run.json is damaged.
    """
    return on_axes(run.scan, scan_points(run))


def on_axes(scan: Mapping[str, Any], points: Sequence[ScanPoint]) -> Scanned | None:
    """Arrange points of a scan on its axes. None without any points.

    Args:
        scan: The scan's record in run.json.
        points: Some of its points.
    """
    if not points or not points[0].parameters:  # --set may have replaced every address
        return None
    rows = [tuple(map(clean, row)) for row in scan["written"]]
    columns, values = list(zip(*rows, strict=True)), list(zip(*scan["points"], strict=True))
    numbers = [_numbers(*pair) for pair in zip(values, columns, strict=True)]
    addresses = list(map(clean, points[0].written))
    # at least one axis, even if all points have the same value
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
    """An axis from the labels and the SI values of its points. Some points may be equal."""
    value_of_label = dict(zip(labels, values, strict=True))
    return Axis(address, tuple(value_of_label), _numbers([*value_of_label.values()], [*value_of_label]))


def _follows(
    columns: Sequence[Sequence[str]], numbers: Sequence[tuple[Sequence[float], str] | None], i: int, k: int
) -> bool:
    """Whether the values of address i change together with those of address k, and not by chance.

    No two points of an optimiser share a value, so there numbers must rise or fall together.
    """
    leader, own_numbers, leader_numbers = columns[k], numbers[i], numbers[k]
    if len({*zip(columns[i], leader, strict=True)}) > len({*leader}):
        return False
    if len({*leader}) < len(leader) or own_numbers is None or leader_numbers is None:
        return True
    steps = np.diff(np.array(own_numbers[0])[np.argsort(leader_numbers[0], kind="stable")])
    return bool((steps >= 0).all() or (steps <= 0).all())


def _numbers(values: Sequence[Any], written: Sequence[str]) -> tuple[tuple[float, ...], str] | None:
    """Values as numbers in the unit of the largest, and that unit. None unless they have one dimension."""
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
    """Whether rising values need a logarithmic axis, with nearly even ratios or crowded at the low end.

    Example:
        >>> is_geometric([1, 2, 5, 10, 20]), is_geometric([1, 10, 20, 30, 40])
        (True, False)
        >>> is_geometric([10, 15, 20, 30, 45, 100, 300, 1000, 3000])  # most would be at 0 on a linear axis
        True
    """
    if len(values) < 3 or values[0] <= 0 or values[-1] < 20 * values[0]:
        return False
    steps = np.diff(np.log(values))
    is_even = float(np.ptp(steps)) <= 0.5 * float(steps.mean())  # "1, 2, 5, 10" passes
    return is_even or values[len(values) // 2] <= values[0] + (values[-1] - values[0]) / 20


@dataclass(frozen=True, slots=True)
class FitRequest:
    """What to fit along an axis of a scan.

    Attributes:
        model: Name of the model.
        given: Parameter -> the value at which it is fixed, with a unit if it is text, or "free".
        along: Scanned address to fit along. None for the first axis.
        lab_model: The model, if it comes from a plugin that is already loaded.
    """

    model: str
    given: Mapping[str, str | float]
    along: str | None = None
    lab_model: LabModel | None = None


def request_of(measure: Mapping[str, Any], lab_model: LabModel | None = None) -> FitRequest:
    """The fit for an entry of ``measure`` that has one, see :func:`labseq.data.quantities.measures_of`."""
    return FitRequest(measure["fit"], measure.get("parameters") or {}, lab_model=lab_model)


@dataclass(frozen=True, slots=True, eq=False)
class FitAt:
    """The fit at one combination of the values of the other axes.

    Attributes:
        values: Address of each other axis -> its value, SI if it is a number.
        written: The same values in the units of the sequence.
        fit: The fit. None if it failed.
        problem: Why it failed, or "".
        points: Indices of the fitted points among the points of the scan.
    """

    values: Mapping[str, Any]
    written: Mapping[str, str]
    fit: Fit | None
    problem: str
    points: tuple[int, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The result as JSON-ready values, SI."""
        result = {"error": self.problem} if self.fit is None else self.fit.as_json()
        return {"at": dict(self.values), **result}


def fits_along(
    run: Run, scan: Scanned, quantity: Quantity, means: Sequence[Estimated], request: FitRequest
) -> list[FitAt]:
    """Fit a quantity along one axis, at each combination of values of the other axes.

    Args:
        means: Mean of the quantity at each point, see :meth:`Scanned.over`.

    Raises:
        ConfigError: There is no such axis, or every fit failed.
    """
    i_along = _axis_number(scan, request.along)
    groups: dict[tuple[int, ...], list[int]] = {}
    for i, place in enumerate(scan.places):
        groups.setdefault((*place[:i_along], *place[i_along + 1 :]), []).append(i)
    others = [axis for axis in scan.axes if axis is not scan.axes[i_along]]
    numbers, unit = scan.on_axis(i_along) or ([], "")
    fit_of = fitter(run, quantity, unit, request)
    fits: list[FitAt] = []
    errors: list[ConfigError] = []
    for place, members in sorted(groups.items()):
        fit, problem = None, ""
        try:
            fit = fit_of([numbers[i] for i in members], [means[i] for i in members])
        except ConfigError as error:
            errors.append(error)
            problem = "; ".join(problem.what for problem in error.problems)
        at = list(zip(others, place, strict=True))
        values = {axis.address: axis.value(i) for axis, i in at}
        written = {axis.address: axis.labels[i] for axis, i in at}
        fits.append(FitAt(values, written, fit, problem, tuple(members)))
    if errors and len(errors) == len(fits):
        raise errors[0]
    return fits


def fitter(
    run: Run, quantity: Quantity, unit: str, request: FitRequest
) -> Callable[[Sequence[float], Sequence[Estimated]], Fit]:
    """Make a function that fits a quantity to points: scanned values in ``unit`` and the mean at each.

    The function raises the same errors as :func:`labseq.data.fits.fit_points`.

    Raises:
        ConfigError: There is no such model.
    """
    profile: Mapping[str, Any] = (run.record.get("resolved") or {}).get("profile") or {}
    lab_model = request.lab_model
    if lab_model is None and request.model not in MODELS:
        from labseq.data.lab_models import find_lab_model  # loading plugins takes a while

        lab_model = find_lab_model(run, request.model)

    def fit(x: Sequence[float], means: Sequence[Estimated]) -> Fit:
        return fit_points(
            request.model,
            [factor_of(unit) * number for number in x],
            means,
            (si_unit_of(f"1 {unit}"), "%" if quantity.is_fraction else quantity.unit),
            request.given,
            profile.get("simulation") or {},
            lab_model,
        )

    return fit


def _axis_number(scan: Scanned, address: str | None) -> int:
    """The number of the axis to fit along.

    Raises:
        ConfigError: There is none, or its values are not numbers.
    """
    addresses = [axis.address for axis in scan.axes]
    if address is not None and address not in addresses:
        hint = did_you_mean(address, addresses)
        problem = f"the scan has no axis '{clean(address)}'"
        raise ConfigError(Problem(problem, "--along", expected=listing(addresses), hint=hint))
    number = 0 if address is None else addresses.index(address)
    if not addresses or scan.on_axis(number) is None:
        numerical = [axis.address for axis in scan.axes if axis.numbers is not None]
        hint = f"--along {numerical[0]} fits along another axis" if numerical else ""
        expected = "a scan of a numerical value"
        raise ConfigError(Problem("there is no axis to fit along", "--fit", expected=expected, hint=hint))
    return number
