"""Fits of a quantity against a scanned value, with lmfit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, Problem, one_of
from labseq.messages import clean, did_you_mean
from labseq.model.estimate import Estimate, Estimated
from labseq.units import UNITS, dimension_of, parse_any, readable_unit

Floats = NDArray[np.float64]

RB87_U, ATOMIC_MASS_KG = 86.909180531, 1.66053906660e-27
"""Mass of 87Rb (AME2020), and the unit that it is in (CODATA 2018)."""
N_STEPS: Final = 600
"""Points at which their distribution is integrated."""
FURTHEST: Final = 3.0
"""Largest distance of an atom from the focus in Rayleigh lengths, where the intensity is a tenth. Without an
end, there would be infinitely many atoms that are barely bound."""
ROUNDING: Final = 1e-9
"""Relative error below which a value counts as without error."""
MAX_ERROR: Final = 10.0
"""Largest error of a parameter, relative to its value or to the range of the points."""


@dataclass(frozen=True, slots=True)
class FitModel:
    """A function that can be fitted.

    Attributes:
        formula: The function of x.
        units: Parameter -> its unit: "x", "y" or "y/x" for those of the data, or an SI unit.
        evaluate: The function: x and the parameters.
        guess: Starting values from x, y and the known parameters.
        fixed: Parameters that are fixed unless the user frees them; nan if the user must give the value.
        at_least: Smallest values.
        relative_step: For the derivatives; 0 for the smallest that is useful.
    """

    formula: str
    units: Mapping[str, str]
    evaluate: Callable[..., Floats]
    guess: Callable[[Floats, Floats], dict[str, float]]
    fixed: Mapping[str, float]
    at_least: Mapping[str, float]
    relative_step: float = 0.0


def _exponential(x: Floats, amplitude: float, decay: float, offset: float) -> Floats:
    return amplitude * np.exp(-x / decay) + offset


def _guess_exponential(x: Floats, y: Floats) -> dict[str, float]:
    # the logarithms of values near 0 are noise
    positive = y > 0.02 * y.max()
    slope = np.polyfit(x[positive], np.log(y[positive]), 1)[0] if positive.sum() > 1 else 0.0
    return {"amplitude": float(y[0]), "decay": -1 / slope if slope < 0 else float(np.ptp(x)), "offset": 0.0}


def _peak(x: Floats, y: Floats) -> tuple[float, float, float, float]:
    """Offset, height, centre and full width at half maximum of a peak or a dip."""
    offset = (
        float(np.median(np.sort(y)[[0, 1, -2, -1]])) if len(y) < 6 else float(np.median(y[[0, 1, -2, -1]]))
    )
    at = int(np.argmax(np.abs(y - offset)))
    within = x[np.abs(y - offset) >= abs(y[at] - offset) / 2]
    spacing = float(np.ptp(x)) / (len(x) - 1)
    return offset, float(y[at] - offset), float(x[at]), max(float(np.ptp(within)), spacing)


def _gaussian(x: Floats, amplitude: float, centre: float, sigma: float, offset: float) -> Floats:
    return amplitude * np.exp(-((x - centre) ** 2) / (2 * sigma**2)) + offset


def _guess_gaussian(x: Floats, y: Floats) -> dict[str, float]:
    offset, height, centre, width = _peak(x, y)
    # the full width at half maximum is 2.355 standard deviations
    return {"amplitude": height, "centre": centre, "sigma": width / 2.355, "offset": offset}


def _lorentzian(x: Floats, amplitude: float, centre: float, fwhm: float, offset: float) -> Floats:
    return amplitude / (1 + (2 * (x - centre) / fwhm) ** 2) + offset


def _guess_lorentzian(x: Floats, y: Floats) -> dict[str, float]:
    offset, height, centre, width = _peak(x, y)
    return {"amplitude": height, "centre": centre, "fwhm": width, "offset": offset}


def _linear(x: Floats, slope: float, intercept: float) -> Floats:
    return slope * x + intercept


def _guess_linear(x: Floats, y: Floats) -> dict[str, float]:
    slope, intercept = np.polyfit(x, y, 1)
    return {"slope": float(slope), "intercept": float(intercept)}


def _saturation(x: Floats, level: float, time: float) -> Floats:
    return level * (1 - np.exp(-x / time))


def _guess_saturation(x: Floats, y: Floats) -> dict[str, float]:
    level = float(y.max())
    rises = x[np.argmax(y >= 0.63 * level)]  # 1 - 1/e
    return {"level": level, "time": float(rises) or float(np.ptp(x)) / 3}


def _step(x: Floats, before: float, after: float, centre: float, width: float) -> Floats:
    from scipy.special import ndtr

    return before + (after - before) * ndtr((x - centre) / width)


def _guess_step(x: Floats, y: Floats) -> dict[str, float]:
    centre = float(np.interp(0.0, *_rising((y[0] + y[-1]) / 2 - y, x)))  # where y is half way
    return {"before": float(y[0]), "after": float(y[-1]), "centre": centre, "width": float(np.ptp(x)) / 8}


def _plateau(x: Floats, amplitude: float, centre: float, half_width: float, edge: float) -> Floats:
    from scipy.special import ndtr

    return amplitude * ndtr((half_width - np.abs(x - centre)) / edge)


def _guess_plateau(x: Floats, y: Floats) -> dict[str, float]:
    high = x[y > y.max() / 2]
    centre, half_width = float(np.ptp(high)) / 2 + float(high.min()), float(np.ptp(high)) / 2
    half_width = max(half_width, float(np.ptp(x)) / (len(x) - 1))
    return {"amplitude": float(y.max()), "centre": centre, "half_width": half_width, "edge": half_width / 4}


def _rising(y: Floats, x: Floats) -> tuple[Floats, Floats]:
    order = np.argsort(y)
    return y[order], x[order]


LOWERING: Final = (1.6, 0.56)
"""Scale and exponent of the energy up to which a ramp keeps atoms, relative to the depth before."""


def _lowering(x: Floats, temperature: float, amplitude: float, depth: float) -> Floats:
    """Fraction of atoms that stay in a tweezer whose depth is slowly reduced to a fraction x.

    An adiabatic ramp keeps atoms below an energy that goes as a power of the depth; scale and exponent
    describe atoms moved by Newton's equations in a Gaussian beam (``docs/make_response_tables.py``).
    Energies are distributed as in a harmonic well.

    Args:
        x: Depths at the end, as fractions of the one before.
        temperature: Temperature before, in K.
        amplitude: Fraction that stays if x is large.
        depth: Depth before, in K.
    """
    energy = LOWERING[0] * depth / temperature * x ** LOWERING[1]
    return amplitude * (1 - np.exp(-energy) * (1 + energy + energy**2 / 2))


def _guess_lowering(x: Floats, y: Floats) -> dict[str, float]:
    del x
    return {"temperature": 20e-6, "amplitude": float(y.max())}


@cache
def _draws() -> Floats:
    """Uniform random numbers of atoms, float64 (6, n)."""
    # the same ones each time: a fit cannot tell noise from the effect of a parameter
    return np.random.default_rng(0).random((6, 20_000))


@lru_cache(maxsize=2)  # a fit comes back to the temperature after a step of another parameter
def _bound_atoms(eta: float) -> tuple[Floats, Floats]:
    """Atoms of the Boltzmann distribution in a Gaussian beam, restricted to bound ones.

    Where the trap has the depth a, the density is ``exp(a) P(a)``, where ``P(a) = erf(sqrt(a)) - 2 sqrt(a /
    pi) exp(-a)`` of the Maxwell distribution is slow enough to be bound. In a plane of constant z the
    integral over x and y is one over a. The distributions of z, of a in its plane, and of the speed are
    inverted one after the other.

    Args:
        eta: Depth in units of kT.

    Returns:
        Positions in waists, along z in Rayleigh lengths, and velocities in units of sqrt(kT / mass); both
        float64 (3, n_atoms).
    """
    from scipy.special import gammainc, gammaincinv  # takes a moment

    a = eta * np.linspace(0.0, 1.0, N_STEPS) ** 2  # dense where P(a) / a goes as a root
    below = np.zeros(N_STEPS)  # integral of exp(a) P(a) / a from 0
    mean = (a[1:] + a[:-1]) / 2
    below[1:] = np.cumsum(np.exp(mean - eta) * gammainc(1.5, mean) / mean * np.diff(a))
    z = np.linspace(-FURTHEST, FURTHEST, N_STEPS)
    in_plane = (1 + z**2) * np.interp(eta / (1 + z**2), a, below)
    up_to = np.cumsum(in_plane) - in_plane / 2
    along, depth, slow, turn, polar, azimuth = _draws()
    z = np.interp(along * up_to[-1], up_to, z)
    width = 1 + z**2
    local = np.interp(depth * np.interp(eta / width, a, below), below, a)
    radius = np.sqrt(width / 2 * np.log(eta / width / np.maximum(local, 1e-12)).clip(0.0))
    speed = np.sqrt(2 * gammaincinv(1.5, slow * gammainc(1.5, local)))
    across = np.sqrt(1 - (2 * polar - 1) ** 2)
    turn, azimuth = 2 * np.pi * turn, 2 * np.pi * azimuth
    places = np.stack([radius * np.cos(turn), radius * np.sin(turn), z])
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), 2 * polar - 1])
    return places, speed * directions


def _release_recapture(
    x: Floats,
    temperature: float,
    amplitude: float,
    depth: float,
    waist: float,
    wavelength: float,
    mass: float,
) -> Floats:
    """Fraction of atoms that a Gaussian tweezer recaptures after they flew freely for a time.

    Atoms start from the thermal distribution of bound ones and fly straight on. An atom is recaptured if its
    kinetic energy is less than the depth of the trap at its new place (Tuchendler et al., Phys. Rev. A 78,
    033425, 2008). Gravity is left out.

    Args:
        x: Times without the trap, in s.
        temperature: Temperature in K.
        amplitude: Recaptured fraction at x = 0.
        depth: Depth of the trap in K.
        waist: 1/e^2 radius of its intensity in m.
        wavelength: Its wavelength in m.
        mass: Mass of an atom in atomic mass units.
    """
    eta = depth / temperature
    rayleigh = math.pi * waist**2 / wavelength
    places, velocities = _bound_atoms(eta)
    kinetic = (velocities**2).sum(axis=0) / 2  # in kT
    # Boltzmann constant in J/K (CODATA 2018)
    flight = velocities * math.sqrt(1.380649e-23 * temperature / (mass * ATOMIC_MASS_KG))
    flight /= np.array([waist, waist, rayleigh])[:, None]

    def recaptured(t: float) -> float:
        at = places + t * flight
        width = 1 + at[2] ** 2
        return float((kinetic < eta / width * np.exp(-2 * (at[0] ** 2 + at[1] ** 2) / width)).mean())

    return amplitude * np.array([recaptured(t) for t in x])


def _guess_release(x: Floats, y: Floats) -> dict[str, float]:
    return {"temperature": 20e-6, "amplitude": float(np.clip(y[np.argmin(x)], 0.05, 1.0))}


MODELS: Final[Mapping[str, FitModel]] = {
    "exponential": FitModel(
        "amplitude exp(-x / decay) + offset",
        {"amplitude": "y", "decay": "x", "offset": "y"},
        _exponential,
        _guess_exponential,
        {"offset": 0.0},
        {},
    ),
    "gaussian": FitModel(
        "amplitude exp(-(x - centre)^2 / (2 sigma^2)) + offset",
        {"amplitude": "y", "centre": "x", "sigma": "x", "offset": "y"},
        _gaussian,
        _guess_gaussian,
        {},
        {"sigma": 0.0},
    ),
    "lorentzian": FitModel(
        "amplitude / (1 + (2 (x - centre) / fwhm)^2) + offset",
        {"amplitude": "y", "centre": "x", "fwhm": "x", "offset": "y"},
        _lorentzian,
        _guess_lorentzian,
        {},
        {"fwhm": 0.0},
    ),
    "linear": FitModel(
        "slope x + intercept", {"slope": "y/x", "intercept": "y"}, _linear, _guess_linear, {}, {}
    ),
    "saturation": FitModel(
        "level (1 - exp(-x / time))",
        {"level": "y", "time": "x"},
        _saturation,
        _guess_saturation,
        {},
        {"time": 0.0},
    ),
    "step": FitModel(
        "from before to after at centre, as the integral of a Gaussian of s.d. width",
        {"before": "y", "after": "y", "centre": "x", "width": "x"},
        _step,
        _guess_step,
        {},
        {"width": 1e-12},
    ),
    "plateau": FitModel(
        "amplitude within half_width of centre, falling to 0 as the integral of a Gaussian of s.d. edge",
        {"amplitude": "y", "centre": "x", "half_width": "x", "edge": "x"},
        _plateau,
        _guess_plateau,
        {},
        {"half_width": 0.0, "edge": 1e-12},
    ),
    "lowering": FitModel(
        "atoms that stay when the depth is slowly reduced to a fraction x",
        {"temperature": "K", "amplitude": "y", "depth": "K"},
        _lowering,
        _guess_lowering,
        {"depth": math.nan},
        {"temperature": 1e-9, "amplitude": 0.0},
    ),
    "release_recapture": FitModel(
        "recapture of atoms after a free flight of duration x",
        {"temperature": "K", "amplitude": "y", "depth": "K", "waist": "m", "wavelength": "m", "mass": "u"},
        _release_recapture,
        _guess_release,
        {"depth": math.nan, "waist": math.nan, "wavelength": math.nan, "mass": RB87_U},
        {"temperature": 1e-9, "amplitude": 0.0},
        0.02,  # its atoms are counted: smaller steps would see their number jump
    ),
}
"""The models that ``--fit`` offers. An offset of an exponential is fixed at 0 unless it is freed."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fit.

    Attributes:
        model: Name of the model.
        values: Parameter -> its value with its error, SI; the error is 0 if it was fixed.
        units: Parameter -> SI unit; "%" for a fraction.
        chi2: Reduced chi-square; nan if the points have no errors.
        n_points: Number of points.
    """

    model: str
    values: Mapping[str, Estimate]
    units: Mapping[str, str]
    chi2: float
    n_points: int

    def at(self, x: Floats) -> Floats:
        """The fitted function at values of x in SI."""
        return MODELS[self.model].evaluate(x, **{name: value.value for name, value in self.values.items()})

    def lines(self) -> list[str]:
        """The result, a line for each parameter."""
        chi2 = "-, the points have no errors" if math.isnan(self.chi2) else f"{self.chi2:.2f}"
        width = max(map(len, (*self.values, "chi-square")))
        return [
            f"fit {self.model}: {MODELS[self.model].formula}",
            *(
                f"  {name.ljust(width)}  {parameter_text(value, self.units[name])}"
                for name, value in self.values.items()
            ),
            f"  {'chi-square'.ljust(width)}  {chi2} (reduced, {self.n_points} points)",
        ]

    def short_lines(self) -> list[str]:
        """The result for the legend of a picture: what was fitted, and the reduced chi-square."""
        free = [
            f"{name} {parameter_text(value, self.units[name])}"
            for name, value in self.values.items()
            if value.error
        ]
        return [
            self.model,
            *free,
            *([] if math.isnan(self.chi2) else [f"reduced chi-square {self.chi2:.2f}"]),
        ]

    def as_json(self) -> dict[str, Any]:
        """The result, JSON-ready, SI."""
        parameters = {
            name: {
                "value": value.value,
                "error": value.error,
                "unit": "" if self.units[name] == "%" else self.units[name],
            }
            for name, value in self.values.items()
        }
        return {
            "model": self.model,
            "parameters": parameters,
            "reduced_chi_square": self.chi2,
            "points": self.n_points,
        }


def parameter_text(value: Estimate, unit: str) -> str:
    """A value with its error in a readable unit.

    Example:
        >>> parameter_text(Estimate(32.9, 0.8), "s"), parameter_text(Estimate(15e-6, 0), "K")
        ('32.9(8) s', '15 uK (fixed)')
        >>> parameter_text(Estimate(0.97, 0.01), "%"), parameter_text(Estimate(-0.02, 0.001), "%/s")
        ('97(1) %', '-2.0(1) %/s')
    """
    dimension, factor = dimension_of(unit), 1.0
    if unit.startswith("%"):  # also of a slope, "%/s"
        factor = 0.01
    elif dimension:
        unit = readable_unit(value.value, dimension)
        factor = UNITS[dimension][unit]
    text = f"{value.scaled(1 / factor)} {unit}".rstrip()
    return text if value.error else f"{text} (fixed)"


def fit_points(
    model: str,
    x: Sequence[float],
    values: Sequence[Estimated],
    units: tuple[str, str],
    given: Mapping[str, str] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Fit:
    """Fit a model to points, weighted with their errors.

    Args:
        model: A name of :data:`MODELS`.
        x: The scanned values, SI.
        values: A mean at each; those that are nan are left out.
        units: SI units of both; "%" for a fraction.
        given: Parameter -> its value with a unit, at which it is fixed, or "free".
        settings: Settings of the profile's simulation.

    Raises:
        ConfigError: There are too few points, a parameter is missing, or the fit fails; says which.
    """
    if model not in MODELS:
        raise _problem(f"there is no fit '{clean(model)}'", one_of([*MODELS]), did_you_mean(model, MODELS))
    function = MODELS[model]
    rows = [
        (at, value.value, _error(value))
        for at, value in zip(x, values, strict=True)
        if not math.isnan(value.value)
    ]
    at, y, error = np.array(sorted(rows), np.float64).reshape(-1, 3).T
    fixed = _fixed(function, given or {}, settings or {})
    free = [name for name in function.units if name not in fixed]
    if len(np.unique(at)) <= len(free):
        problem = (
            f"{len(np.unique(at))} points are too few for a fit of {len(free)} parameters ({', '.join(free)})"
        )
        raise _problem(problem, f"at least {len(free) + 1} different values with a result")
    # a point without an error, such as one of a single shot, counts as the worst of the others
    has_error = np.isfinite(error) & (error > ROUNDING * np.abs(y))
    sigma = (
        np.where(has_error, error, error[has_error].max(initial=0.0)) if has_error.any() else np.ones_like(y)
    )
    start = {**function.guess(at, y), **fixed}
    values_of, chi2 = _minimise(function, at, y, sigma, start, fixed, is_weighted=bool(has_error.any()))
    _check_determined(function, values_of, at, y)
    x_unit, y_unit = units
    unit_of = {"x": x_unit, "y": y_unit, "y/x": f"{y_unit}/{x_unit}" if x_unit else y_unit}
    parameter_units = {name: unit_of.get(unit, unit) for name, unit in function.units.items()}
    return Fit(model, values_of, parameter_units, chi2, len(at))


def _minimise(
    model: FitModel,
    x: Floats,
    y: Floats,
    sigma: Floats,
    start: Mapping[str, float],
    fixed: Mapping[str, float],
    *,
    is_weighted: bool,
) -> tuple[dict[str, Estimate], float]:
    import lmfit  # takes a second

    parameters: Any = lmfit.Parameters()
    for name in model.units:
        parameters.add(name, start[name], vary=name not in fixed, min=model.at_least.get(name, -math.inf))

    def residual(trial: Any) -> Floats:
        return (model.evaluate(x, **trial.valuesdict()) - y) / sigma

    # its square root is the relative step of MINPACK
    options: dict[str, Any] = {"epsfcn": model.relative_step**2} if model.relative_step else {}
    try:
        # the scatter about the fit stands for errors that the points do not have
        result: Any = lmfit.minimize(residual, parameters, scale_covar=not is_weighted, **options)
    except (ValueError, FloatingPointError, OverflowError) as error:
        raise _problem(f"the fit failed: {error}", "points that follow the model") from error
    values = {
        name: Estimate(float(fitted.value), float(fitted.stderr or math.nan) if fitted.vary else 0.0)
        for name, fitted in result.params.items()
    }
    if not result.success:
        raise _problem("the fit did not converge", "points that follow the model, over a wider range")
    return values, float(result.redchi) if is_weighted else math.nan


def _check_determined(model: FitModel, values: Mapping[str, Estimate], x: Floats, y: Floats) -> None:
    """Refuse a fit with an error that is far larger than the range of the points."""
    ranges = {"x": float(np.ptp(x)), "y": float(np.ptp(y)), "y/x": float(np.ptp(y) / np.ptp(x))}
    undetermined = [
        name
        for name, value in values.items()
        if not math.isfinite(value.error)
        or value.error > MAX_ERROR * max(abs(value.value), ranges.get(model.units[name], 0.0))
    ]
    if undetermined:
        problem = f"the points do not determine {' and '.join(undetermined)}"
        raise _problem(
            problem, "points that follow the model, over a wider range; or fewer parameters (--fit-set)"
        )


def _error(value: Estimated) -> float:
    low, high = value.interval
    return (high - low) / 2


def _fixed(model: FitModel, given: Mapping[str, str], settings: Mapping[str, Any]) -> dict[str, float]:
    """The parameters that are not fitted."""
    fixed = dict(model.fixed)
    keys = {"depth": "static_depth", "waist": "static_waist", "wavelength": "static_wavelength"}
    for name, key in keys.items():
        if name in fixed and isinstance(settings.get(key), int | float):
            fixed[name] = float(settings[key])
    for name, text in given.items():
        if name not in model.units:
            raise _problem(
                f"the fit has no parameter '{clean(name)}'",
                one_of([*model.units]),
                did_you_mean(name, model.units),
            )
        fixed.pop(name, None)
        if text != "free":
            fixed[name] = _value(name, text)
    missing = [name for name, value in fixed.items() if math.isnan(value)]
    if missing:
        problem = f"the fit needs {' and '.join(missing)}, which the run's profile does not have"
        raise _problem(problem, " ".join(f"--fit-set {name}=VALUE" for name in missing))
    return fixed


def _value(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        try:
            return parse_any(text)[0]
        except ValueError as error:
            raise _problem(f"{name}: {error}", "a number with its unit, or 'free'") from error


def _problem(message: str, expected: str, hint: str = "") -> ConfigError:
    return ConfigError(Problem(message, "--fit", expected=expected, hint=hint))
