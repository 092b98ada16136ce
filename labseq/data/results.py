"""The main results of a run: fitted parameters that its sequence asks for, or means of quantities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from labseq.data.best import best_point
from labseq.data.fits import Fit
from labseq.data.numbers import Parameter, Result
from labseq.data.quantities import Quantity, measured_by, measures_of, quantity_of
from labseq.data.reader import Run
from labseq.data.scanned import FitAt, Scanned, fits_along, request_of, scanned
from labseq.errors import ConfigError
from labseq.model.estimate import Estimated, Rate


def results_of(run: Run) -> list[Result]:
    """The results of a run, the most important first. Empty without shots.

    For each quantity that the run measures, these are the parameters of its fits, or the mean over all
    shots if no fit succeeded. For an adaptive scan, the best mean comes first.

    Raises:
        RecordingError: The run is damaged.
    """
    scan, best = scanned(run), best_point(run)
    results = (
        []
        if best is None
        else [Result(f"best {best.quantity.name}", as_parameter(best.quantity, best.value))]
    )
    for name in measured_by(run):
        quantity = quantity_of(run, name)
        fits = [] if scan is None else own_fits(run, scan, quantity, scan.over(quantity))
        fitted = [result for at in fits if (result := reported(run, quantity, at)) is not None]
        results += fitted or [Result(name, as_parameter(quantity, quantity.over(run.shots)))]
    return [result for result in results if not math.isnan(result.value.value)]


def own_fits(run: Run, scan: Scanned, quantity: Quantity, means: Sequence[Estimated]) -> list[FitAt]:
    """The fits of a quantity that the run's sequence asks for. A fit that fails has a ``problem``."""
    wanted = next((one for one in measures_of(run) if one["value"] == quantity.name and "fit" in one), None)
    if wanted is None or not scan.axes:
        return []
    try:
        return fits_along(run, scan, quantity, means, request_of(wanted))
    except ConfigError as error:
        problem = "; ".join(str(replace(problem, source="")) for problem in error.problems)
        return [FitAt({}, {}, None, f"no fit {wanted['fit']}: {problem}")]


def reported(run: Run, quantity: Quantity, at: FitAt) -> Result | None:
    """The parameter of a fit that the run's sequence reports, or else the first. None if there is none."""
    name = next((one.get("report") for one in measures_of(run) if one["value"] == quantity.name), None)
    if at.fit is None or not (name := name or _first_free(at.fit)) or name not in at.fit.parameters:
        return None
    return Result(name, at.fit.parameters[name], ", ".join(at.written.values()))


def _first_free(fit: Fit) -> str:
    return next(iter(fit.free), "")


def as_parameter(quantity: Quantity, mean: Estimated) -> Parameter:
    """The mean of a quantity in the form of a fitted parameter. The error of a rate is half its interval."""
    low, high = mean.interval
    error = (high - low) / 2 if isinstance(mean, Rate) else mean.error
    # an error of 0 would mean that the value was fixed
    return Parameter(mean.value, error or math.nan, "%" if quantity.is_fraction else quantity.unit)
