"""Fits of a quantity against a scanned value."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from labseq.data.fit_models import MODELS, FitModel, Points, Solution
from labseq.data.least_squares import Floats
from labseq.data.numbers import Parameter
from labseq.errors import ConfigError, Problem, one_of
from labseq.messages import clean, did_you_mean
from labseq.model.estimate import Estimate, Estimated
from labseq.units import parse_any

if TYPE_CHECKING:
    from labseq.data.lab_models import LabModel  # with the plugins, it takes a while to import

    Model: TypeAlias = FitModel | LabModel

ROUNDING: Final = 1e-9
"""Relative error below which a value counts as without error."""
MAX_ERROR: Final = 10.0
"""Largest error of a parameter, relative to its value or to the range of the points."""
COMMON_FREEDOM: Final = 4.0
"""Degrees of freedom with which the mean variance of all points enters the variance of each point."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fit of a quantity against a scanned value.

    Attributes:
        model: Name of the model.
        formula: The model's function of x as text.
        parameters: Name -> value, error and unit.
        reduced_chi_square: Reduced chi-square. nan if the points have no errors.
        x: The scanned values of the points, SI, rising.
        y: The quantity at each point.
        errors: Standard errors of the quantity.
    """

    model: str
    formula: str
    parameters: Mapping[str, Parameter]
    reduced_chi_square: float
    x: Floats
    y: Floats
    errors: Floats
    _function: Callable[[Floats], Floats]

    def at(self, x: ArrayLike) -> Floats:
        """The fitted function at values of x, SI."""
        return self._function(np.asarray(x, np.float64))

    @property
    def residuals(self) -> Floats:
        """The points minus the fitted function."""
        return self.y - self.at(self.x)

    @property
    def free(self) -> Mapping[str, Parameter]:
        """The parameters that were not fixed."""
        return {name: parameter for name, parameter in self.parameters.items() if parameter.error}

    def lines(self, of: str = "") -> list[str]:
        """The result as text, one line per parameter.

        Args:
            of: Name of the fitted quantity if it must be given, such as " of filling".
        """
        has_errors = math.isfinite(self.reduced_chi_square)
        chi2 = f"{self.reduced_chi_square:.2f}" if has_errors else "-, the points have no errors"
        width = max(map(len, (*self.parameters, "chi-square")))
        return [
            f"fit {self.model}{of}: {self.formula}",
            *(f"  {name.ljust(width)}  {parameter}" for name, parameter in self.parameters.items()),
            f"  {'chi-square'.ljust(width)}  {chi2} (reduced, {len(self.x)} points)",
        ]

    def caption(self) -> str:
        """The result for a picture, without line breaks in its numbers: model, parameters, chi-square."""
        values = [f"{name} {parameter}" for name, parameter in self.free.items()]
        if math.isfinite(self.reduced_chi_square):
            values.append(f"reduced chi-square {self.reduced_chi_square:.2f}")
        return f"fit {self.model}: " + ", ".join(value.replace(" ", "\xa0") for value in values)

    def as_json(self) -> dict[str, Any]:
        """The result as JSON-ready values, SI."""
        return {
            "model": self.model,
            "parameters": {name: parameter.as_json() for name, parameter in self.parameters.items()},
            "reduced_chi_square": self.reduced_chi_square,
            "points": len(self.x),
        }


def fit_points(
    name: str,
    x: Sequence[float],
    values: Sequence[Estimated],
    units: tuple[str, str],
    given: Mapping[str, str | float] | None = None,
    settings: Mapping[str, Any] | None = None,
    lab_model: LabModel | None = None,
) -> Fit:
    """Fit a model to points, weighted with their errors.

    Args:
        x: The scanned values, SI.
        values: A mean at each scanned value. Those that are nan are left out.
        units: SI units of x and of the values. "%" for a fraction.
        given: Parameter -> the value at which it is fixed, with a unit if it is text, or "free".
        settings: Settings of the profile's simulation.
        lab_model: The model, if it comes from a plugin.

    Raises:
        ConfigError: There are too few points, a parameter is missing, or the fit fails.
    """
    model = MODELS[name] if lab_model is None else lab_model
    points, fixed = _points(x, values), _fixed(model, given or {}, settings or {})
    points, solution = _solve_determined(model, points, fixed, {*(given or {})})
    parameters = {
        name: Parameter(value.value, value.error, parameter_unit(model.units.get(name, ""), *units))
        for name, value in solution.values.items()
    }
    return Fit(
        name,
        model.formula,
        {name: _within_a_turn(parameter) for name, parameter in parameters.items()},
        solution.reduced_chi_square,
        points.x,
        points.y,
        points.error,
        solution.function,
    )


def _points(x: Sequence[float], values: Sequence[Estimated]) -> Points:
    rows = [
        (
            at,
            value.value,
            (value.interval[1] - value.interval[0]) / 2,
            value.n if isinstance(value, Estimate) else 0,
            0 if isinstance(value, Estimate) else value.n_trials,
        )
        for at, value in zip(x, values, strict=True)
        if not math.isnan(value.value)
    ]
    if not rows:
        raise _problem("no point has a result", "shots that have this quantity")
    at, y, error, n_shots, n_trials = np.array(sorted(rows), np.float64).T
    error = _moderated(error, n_shots)
    is_known = np.isfinite(error) & (error > ROUNDING * np.abs(y))
    if not is_known.any():
        if np.ptp(y) == 0:
            raise _problem("the quantity is the same at all points", "a scan that changes the quantity")
        return Points(at, y, np.ones_like(y), has_errors=False, n_trials=n_trials)
    # a point without an error counts as the worst of the others
    error = np.where(is_known, error, error[is_known].max())
    return Points(at, y, error, has_errors=True, n_trials=n_trials)


def _moderated(error: Floats, n_shots: Floats) -> Floats:
    """The errors of means over a few shots, each drawn towards the error of all points.

    The scatter of two or five shots is a poor measure of their error. A point whose shots agree by chance
    would get most of the weight, and the errors of the parameters would come out up to five times too small.
    The variance of a point is averaged with the variance of all points, which counts as much as five shots at
    that point (Smyth, Stat. Appl. Genet. Mol. Biol. 3, 3, 2004).

    Args:
        error: Standard errors of the points. nan for a single shot.
        n_shots: Number of shots of each. 0 for a point that is not a mean.
    """
    is_known = n_shots > 1
    if not is_known.any():
        return error
    freedom = np.maximum(n_shots - 1, 0)
    variance = np.where(is_known, error**2 * n_shots, 0.0)
    common = np.average(variance, weights=freedom)
    moderated = (COMMON_FREEDOM * common + freedom * variance) / (COMMON_FREEDOM + freedom)
    return np.where(n_shots > 0, np.sqrt(moderated / np.maximum(n_shots, 1)), error)


def _solve_determined(
    model: Model, points: Points, fixed: Mapping[str, float], given: Collection[str]
) -> tuple[Points, Solution]:
    """Fit all free parameters, or fix those that the model can do without if that fails."""
    try:
        return _solve(model, points, fixed)
    except ConfigError:
        without = {name: value for name, value in model.without.items() if name not in given}
        if not without:
            raise
        return _solve(model, points, {**fixed, **without})


def _solve(model: Model, points: Points, fixed: Mapping[str, float]) -> tuple[Points, Solution]:
    """Fit, with rates weighted by the errors that the fit itself expects.

    If by chance only few of a few atoms survive, the error seems smaller than if many do. Such points would
    pull the fit, by half an error at 20 atoms per point.
    """
    _check_number(model, points, fixed)
    solution = model.solve(points, fixed)
    for _ in range(2 if points.n_trials.any() else 0):
        if solution is not None:
            points = points.with_errors_of(solution.function(points.x))
            solution = model.solve(points, fixed, solution)
    if solution is None:
        raise _problem("the fit did not converge", model.advice)
    _check_determined(model, solution.values, points)
    return points, solution


def _check_number(model: Model, points: Points, fixed: Mapping[str, float]) -> None:
    free = [name for name in model.units if name not in fixed]
    if not free:
        raise _problem("all parameters are fixed", "at least one to fit")
    n_values = len(np.unique(points.x))
    if n_values <= len(free):
        come = "1 point is" if n_values == 1 else f"{n_values} points are"
        problem = f"{come} too few for a fit of {len(free)} parameters ({', '.join(free)})"
        raise _problem(problem, f"at least {len(free) + 1} different values with a result")


def parameter_unit(unit: str, x_unit: str, y_unit: str) -> str:
    """The SI unit of a parameter. "%" stands for a fraction.

    Args:
        unit: Its unit in the model, see :class:`labseq.data.fit_models.FitModel`.
        x_unit: SI unit of the scanned value.
        y_unit: SI unit of the quantity. "%" for a fraction.
    """
    numerator, _, denominator = unit.partition("/")
    top = {"x": x_unit, "y": y_unit}.get(numerator, numerator)
    if not denominator or not x_unit:
        return "" if top == "1" else top
    inverse = {"1/s": "Hz", "1/Hz": "s"} if numerator == "1" else {}
    text = f"{top or '1'}/{denominator.replace('x', x_unit)}"
    return inverse.get(text, text)


def _within_a_turn(parameter: Parameter) -> Parameter:
    """Shift a phase to between -pi and pi. Other parameters are returned as they are."""
    if parameter.text_unit != "rad":
        return parameter
    return replace(parameter, value=math.remainder(parameter.value, math.tau))


def _check_determined(model: Model, values: Mapping[str, Estimate], points: Points) -> None:
    """Refuse parameters with an error far larger than the range of the points, or no larger than noise."""
    undetermined = [
        name
        for name, value in values.items()
        if not math.isfinite(value.error)
        or value.error > MAX_ERROR * max(abs(value.value), points.scale(model.units.get(name, "")))
    ]
    if undetermined:
        raise _problem(f"the points do not determine {' and '.join(undetermined)}", model.advice)
    for name, least in model.significance.items():
        if values[name].error and abs(values[name].value) < least * values[name].error:
            raise _problem(f"{name} cannot be told from noise", model.advice)


def _fixed(model: Model, given: Mapping[str, str | float], settings: Mapping[str, Any]) -> dict[str, float]:
    """The parameters that are not fitted, with their values."""
    fixed = dict(model.fixed)
    keys = {"depth": "static_depth", "waist": "static_waist", "wavelength": "static_wavelength"}
    for name, key in keys.items():
        if name in fixed and isinstance(settings.get(key), int | float):
            fixed[name] = float(settings[key])
    for name, value in given.items():
        if name not in model.units:
            raise _problem(
                f"the fit has no parameter '{clean(name)}'",
                one_of([*model.units]),
                did_you_mean(name, model.units),
            )
        fixed.pop(name, None)
        if value != "free":
            fixed[name] = _value(name, value)
    missing = [name for name, value in fixed.items() if math.isnan(value)]
    if missing:
        problem = f"the fit needs {' and '.join(missing)}, which the run's profile does not have"
        raise _problem(problem, " ".join(f"--fit-set {name}=VALUE" for name in missing))
    return fixed


def _value(name: str, value: str | float) -> float:
    try:
        return float(value)
    except ValueError:
        try:
            return parse_any(str(value))[0]
        except ValueError as error:
            raise _problem(f"{name}: {error}", "a number with its unit, or 'free'") from error


def _problem(message: str, expected: str, hint: str = "") -> ConfigError:
    return ConfigError(Problem(message, "--fit", expected=expected, hint=hint))
