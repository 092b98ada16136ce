"""The functions that labseq fits, with starting values for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from itertools import combinations
from typing import Final

import numpy as np

from labseq.data.least_squares import Floats, minimise
from labseq.model.estimate import Estimate

RB87_U, ATOMIC_MASS_KG = 86.909180531, 1.66053906660e-27
"""Mass of 87Rb (AME2020) in atomic mass units, and the atomic mass unit in kg (CODATA 2018)."""
N_STEPS: Final = 600
"""Number of points at which the distributions of atoms are integrated."""
FURTHEST: Final = 3.0
"""Largest distance of an atom from the focus in Rayleigh lengths, where the intensity is a tenth. Without a
limit, there would be infinitely many barely bound atoms."""
ETA_STEP: Final = 0.05
"""Step of the logarithm of a trap's depth in kT. Between two steps, recapture is linear within 0.001."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """The points of a fit in rising order of x, each float64 (n_points,).

    Attributes:
        x: The scanned values, SI.
        y: The values there.
        error: Their standard errors. 1 for all points if none is known.
        has_errors: Whether any error is known. If not, the scatter about the fit is used instead.
        n_trials: Number of trials of a rate. 0 for any other quantity.
    """

    x: Floats
    y: Floats
    error: Floats
    has_errors: bool
    n_trials: Floats

    def scale(self, unit: str) -> float:
        """The range of the points in the unit of a parameter, see :class:`FitModel`. 0 for another unit."""
        ranges = {"x": float(np.ptp(self.x)), "y": float(np.ptp(self.y)), "1": 1.0, "rad": 1.0}
        numerator, _, denominator = unit.partition("/")
        power = float(denominator.partition("^")[2] or 1) if denominator else 0.0
        return ranges.get(numerator, 0.0) / ranges["x"] ** power

    def with_errors_of(self, probabilities: Floats) -> Points:
        """The points, with the errors that rates with these probabilities have."""
        # half an event of either kind is added so that rates of 0 and 1 have an error, too
        expected = (self.n_trials * probabilities.clip(0.0, 1.0) + 0.5) / (self.n_trials + 1)
        error = np.sqrt(expected * (1 - expected) / np.maximum(self.n_trials, 1))
        return replace(self, error=np.where(self.n_trials > 0, error, self.error))


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The result of a fit: the best parameters and the fitted function.

    Attributes:
        values: Parameter -> its value and error. The error is 0 if it was fixed.
        reduced_chi_square: Reduced chi-square. nan if the points have no errors.
        function: The fitted function of x.
    """

    values: Mapping[str, Estimate]
    reduced_chi_square: float
    function: Callable[[Floats], Floats]

    @property
    def start(self) -> dict[str, float]:
        """Parameter -> its value."""
        return {name: value.value for name, value in self.values.items()}


@dataclass(frozen=True, slots=True)
class FitModel:
    """A function that can be fitted.

    Attributes:
        formula: The function of x as text.
        units: Parameter -> its unit: an SI unit, or "x", "y", "1/x", "y/x", "y/x^2", ... of the points.
        evaluate: Computes the function from x and the parameters.
        guess: Computes starting values from x and y.
        fixed: Parameters that are fixed unless the user frees them. nan if the user must give the value.
        at_least: Parameter -> its smallest value.
        relative_step: Relative step of the derivatives.
        without: Parameter -> the value at which it is fixed if the fit fails with it free.
        significance: Parameter -> how many of its errors it must differ from 0, to tell it from noise.
        advice: What helps if the points do not determine the parameters.
    """

    formula: str
    units: Mapping[str, str]
    evaluate: Callable[..., Floats]
    guess: Callable[[Floats, Floats], dict[str, float]]
    fixed: Mapping[str, float] = field(default_factory=dict[str, float])
    at_least: Mapping[str, float] = field(default_factory=dict[str, float])
    relative_step: float = 1e-7
    without: Mapping[str, float] = field(default_factory=dict[str, float])
    significance: Mapping[str, float] = field(default_factory=dict[str, float])
    advice: str = "points that follow the model, over a wider range, or fewer parameters (--fit-set)"

    def solve(
        self, points: Points, fixed: Mapping[str, float], near: Solution | None = None
    ) -> Solution | None:
        """Fit the parameters that are not fixed. None if the fit does not converge.

        Args:
            near: An earlier solution from which the fit starts.
        """
        free = [name for name in self.units if name not in fixed]

        def residuals(values: Floats) -> Floats:
            parameters = dict(zip(free, values.tolist(), strict=True))
            return (self.evaluate(points.x, **fixed, **parameters) - points.y) / points.error

        with np.errstate(all="ignore"):  # a trial may leave the range of the function
            start = self.guess(points.x, points.y) if near is None else near.start
            minimum = minimise(
                residuals,
                np.array([start[name] for name in free]),
                np.array([self.at_least.get(name, -math.inf) for name in free]),
                np.array([points.scale(self.units[name]) for name in free]),
                self.relative_step,
            )
        if minimum is None:
            return None
        reduced = minimum.chi2 / (len(points.x) - len(free))
        variances = np.diag(minimum.covariance) * (1.0 if points.has_errors else reduced)
        found = dict(
            zip(free, map(Estimate, minimum.parameters.tolist(), np.sqrt(variances).tolist()), strict=True)
        )
        values = {name: found.get(name) or Estimate(fixed[name], 0.0) for name in self.units}
        function = partial(self.evaluate, **{name: value.value for name, value in values.items()})
        return Solution(values, reduced if points.has_errors else math.nan, partial(_quietly, function))


def _quietly(function: Callable[[Floats], Floats], x: Floats) -> Floats:
    """Evaluate a function without warnings, because x may have values beyond its range."""
    with np.errstate(all="ignore"):
        return function(x)


def _exponential(x: Floats, amplitude: float, decay: float, offset: float) -> Floats:
    return amplitude * np.exp(-x / decay) + offset


def _guess_exponential(x: Floats, y: Floats) -> dict[str, float]:
    # the logarithms of values near 0 are noise
    positive = y > 0.02 * y.max()
    slope = np.polyfit(x[positive], np.log(y[positive]), 1)[0] if positive.sum() > 1 else 0.0
    return {"amplitude": float(y[0]), "decay": -1 / slope if slope < 0 else float(np.ptp(x)), "offset": 0.0}


def _double_exponential(
    x: Floats,
    amplitude_fast: float,
    decay_fast: float,
    amplitude_slow: float,
    decay_slow: float,
    offset: float,
) -> Floats:
    if decay_fast > decay_slow:  # the fit may not exchange the two
        return np.full_like(x, math.nan)
    return amplitude_fast * np.exp(-x / decay_fast) + amplitude_slow * np.exp(-x / decay_slow) + offset


def _guess_double_exponential(x: Floats, y: Floats) -> dict[str, float]:
    decays = np.geomspace(_spacing(x) / 2, 4 * float(np.ptp(x)), 20)
    pairs = np.array([(fast, slow) for fast, slow in combinations(decays, 2) if slow > 2 * fast])
    best, amplitudes = _best_linear(np.exp(-x[:, None] / pairs[:, None, :]), y)
    return {
        "amplitude_fast": amplitudes[0],
        "decay_fast": float(pairs[best, 0]),
        "amplitude_slow": amplitudes[1],
        "decay_slow": float(pairs[best, 1]),
        "offset": 0.0,
    }


def _damped_cosine(
    x: Floats, amplitude: float, frequency: float, phase: float, decay: float, offset: float
) -> Floats:
    return amplitude * np.exp(-x / decay) * np.cos(2 * np.pi * frequency * x + phase) + offset


def _guess_damped_cosine(x: Floats, y: Floats) -> dict[str, float]:
    """Try all frequencies that the points can resolve, each with several decays.

    With both given, the function is linear in its quadratures and the offset. Without the decay this
    is the periodogram of Lomb and Scargle with a free mean (Zechmeister, Kuerster, A&A 496, 577, 2009).
    """
    span = float(np.ptp(x))
    # largest number of periods within the points for which an oscillation is searched for
    highest = min(max(0.5 * span / _spacing(x), 1.0), 300.0)
    # each number of periods within the points has its own minimum, so the steps are a tenth of a period
    frequencies = np.arange(0.3, highest + 0.1, 0.1) / span
    decays = float(np.abs(x).max()) * np.array([10.0, 1.0, 0.3])
    frequency, decay = (grid.ravel() for grid in np.meshgrid(frequencies, decays))
    angle, envelope = 2 * np.pi * np.outer(frequency, x), np.exp(-x / decay[:, None])
    curves = np.stack([envelope * np.cos(angle), -envelope * np.sin(angle), np.ones_like(angle)], axis=-1)
    best, (in_phase, quadrature, offset) = _best_linear(curves, y)
    return {
        "amplitude": math.hypot(in_phase, quadrature),
        "frequency": float(frequency[best]),
        "phase": math.atan2(quadrature, in_phase),
        "decay": float(decay[best]),
        "offset": offset,
    }


def _spacing(x: Floats) -> float:
    """A typical distance between neighbouring points: the median, as some may be repeated or far away."""
    return float(np.median(np.diff(np.unique(x))))


def _best_linear(curves: Floats, y: Floats) -> tuple[int, list[float]]:
    """The set of curves whose linear combination is closest to the points, and the coefficients.

    Args:
        curves: float64 (n_sets, n_points, n_curves).
        y: float64 (n_points,).
    """
    products = np.einsum("spi,spj->sij", curves, curves)
    # a small diagonal is added because curves may be equal at all points
    products += 1e-9 * np.einsum("sii->s", products)[:, None, None] * np.eye(curves.shape[-1])
    projections = np.einsum("spi,p->si", curves, y)
    coefficients = np.linalg.solve(products, projections[..., None])[..., 0]
    best = int(np.argmax((coefficients * projections).sum(axis=1)))
    return best, coefficients[best].tolist()


def _polynomial(x: Floats, c0: float, c1: float, c2: float, c3: float, c4: float) -> Floats:
    return c0 + x * (c1 + x * (c2 + x * (c3 + x * c4)))


def _guess_polynomial(x: Floats, y: Floats) -> dict[str, float]:
    coefficients = np.polynomial.Polynomial.fit(x, y, min(2, len(np.unique(x)) - 1)).convert().coef.tolist()
    return {f"c{i}": coefficients[i] if i < len(coefficients) else 0.0 for i in range(5)}


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


def _normal_cdf(x: Floats) -> Floats:
    """The integral of the standard normal distribution. Importing scipy's would take most of a second."""
    return np.array([0.5 * math.erfc(-one / math.sqrt(2)) for one in x])


def _step(x: Floats, before: float, after: float, centre: float, width: float) -> Floats:
    return before + (after - before) * _normal_cdf((x - centre) / width)


def _guess_step(x: Floats, y: Floats) -> dict[str, float]:
    centre = float(np.interp(0.0, *_rising((y[0] + y[-1]) / 2 - y, x)))  # where y is half way
    return {"before": float(y[0]), "after": float(y[-1]), "centre": centre, "width": float(np.ptp(x)) / 8}


def _plateau(
    x: Floats, amplitude: float, centre: float, half_width: float, edge: float, offset: float
) -> Floats:
    return offset + amplitude * _normal_cdf((half_width - np.abs(x - centre)) / edge)


def _guess_plateau(x: Floats, y: Floats) -> dict[str, float]:
    high = x[y >= y.max() / 2]
    centre, half_width = float(np.ptp(high)) / 2 + float(high.min()), float(np.ptp(high)) / 2
    half_width = max(half_width, float(np.ptp(x)) / (len(x) - 1))
    values = {"amplitude": float(y.max()), "centre": centre, "half_width": half_width, "edge": half_width / 4}
    return values | {"offset": 0.0}


def _rising(y: Floats, x: Floats) -> tuple[Floats, Floats]:
    order = np.argsort(y)
    return y[order], x[order]


LOWERING: Final = (1.6, 0.56)
"""Scale and exponent of the energy below which a ramp keeps atoms, relative to the depth before."""


def _lowering(x: Floats, temperature: float, amplitude: float, depth: float) -> Floats:
    """Fraction of atoms that stay in a tweezer whose depth is slowly reduced to a fraction x.

    An adiabatic ramp keeps atoms below an energy that scales as a power of the depth. Scale and exponent
    describe atoms moved by Newton's equations in a Gaussian beam. Energies are distributed as in a harmonic
    well.

    Args:
        x: Depth at the end, as a fraction of the depth before.
        temperature: Temperature before the ramp, in K.
        amplitude: Fraction that stays if x is large.
        depth: Depth before the ramp, in K.
    """
    energy = LOWERING[0] * depth / temperature * x ** LOWERING[1]
    return amplitude * (1 - np.exp(-energy) * (1 + energy + energy**2 / 2))


def _guess_lowering(x: Floats, y: Floats) -> dict[str, float]:
    del x
    return {"temperature": 20e-6, "amplitude": float(y.max())}


@cache
def _draws() -> Floats:
    """Uniform random numbers for the simulated atoms, float64 (6, n)."""
    # the same ones each time, because a fit cannot tell noise from the effect of a parameter
    return np.random.default_rng(0).random((6, 20_000))


@lru_cache(maxsize=16)  # 1 MB each, and a fit needs a few of them again at the next fit of a run in progress
def _bound_atoms(eta: float) -> tuple[Floats, Floats]:
    """Draw bound atoms from the Boltzmann distribution in a Gaussian beam.

    Where the trap has the depth a in units of kT, the density of bound atoms is ``exp(a) P(a)``. Of the
    Maxwell distribution, the fraction ``P(a) = erf(sqrt(a)) - 2 sqrt(a / pi) exp(-a)`` is slow enough to be
    bound. In a plane of constant z the integral over x and y becomes one of ``exp(a) P(a) / a`` over a.
    The distributions of z, of a in its plane, and of the speed are inverted one after the other.

    Args:
        eta: Depth in units of kT.

    Returns:
        Positions in waists, along z in Rayleigh lengths, and velocities in units of sqrt(kT / mass). Each
        is float64 (3, n_atoms).
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
    """Fraction of atoms that a Gaussian tweezer recaptures after a time of free flight.

    Atoms start from the thermal distribution of bound atoms and fly straight. An atom is recaptured if its
    kinetic energy is less than the depth of the trap at its new place (Tuchendler et al., Phys. Rev. A 78,
    033425, 2008). Gravity is neglected.

    Args:
        x: Times without the trap, in s.
        temperature: Temperature in K.
        amplitude: Recaptured fraction at x = 0.
        depth: Depth of the trap in K.
        waist: 1/e^2 radius of its intensity in m.
        wavelength: Its wavelength in m.
        mass: Mass of an atom in atomic mass units.
    """
    # drawing atoms takes far longer than the flight, so they are drawn at fixed depths in units of kT
    place = math.log(min(max(depth / temperature, 0.05), 1e6)) / ETA_STEP
    lower, share = math.floor(place), place % 1
    trap = (depth, waist, wavelength, mass)
    below, above = (_recaptured(tuple(x), math.exp(ETA_STEP * step), *trap) for step in (lower, lower + 1))
    return amplitude * ((1 - share) * below + share * above)


@lru_cache(maxsize=32)  # most steps of a fit are between the same two depths
def _recaptured(
    x: tuple[float, ...], eta: float, depth: float, waist: float, wavelength: float, mass: float
) -> Floats:
    """The recaptured fraction at a given depth in units of kT, without the amplitude."""
    rayleigh = math.pi * waist**2 / wavelength
    places, velocities = _bound_atoms(eta)
    kinetic = (velocities**2).sum(axis=0) / 2  # in kT
    # Boltzmann constant in J/K (CODATA 2018)
    flight = velocities * math.sqrt(1.380649e-23 * depth / eta / (mass * ATOMIC_MASS_KG))
    flight /= np.array([waist, waist, rayleigh])[:, None]

    def recaptured(t: float) -> float:
        at = places + t * flight
        width = 1 + at[2] ** 2
        return float((kinetic < eta / width * np.exp(-2 * (at[0] ** 2 + at[1] ** 2) / width)).mean())

    return np.array([recaptured(t) for t in x])


def _guess_release(x: Floats, y: Floats) -> dict[str, float]:
    return {"temperature": 20e-6, "amplitude": float(np.clip(y[np.argmin(x)], 0.05, 1.0))}


MODELS: Final[Mapping[str, FitModel]] = {
    "exponential": FitModel(
        "amplitude exp(-x / decay) + offset",
        {"amplitude": "y", "decay": "x", "offset": "y"},
        _exponential,
        _guess_exponential,
        {"offset": 0.0},
    ),
    "double_exponential": FitModel(
        "amplitude_fast exp(-x / decay_fast) + amplitude_slow exp(-x / decay_slow) + offset",
        {"amplitude_fast": "y", "decay_fast": "x", "amplitude_slow": "y", "decay_slow": "x", "offset": "y"},
        _double_exponential,
        _guess_double_exponential,
        {"offset": 0.0},
        {"decay_fast": 0.0, "decay_slow": 0.0},
        significance={"amplitude_fast": 2.0, "amplitude_slow": 2.0},
        advice="points that show two decays, or --fit exponential",
    ),
    "damped_cosine": FitModel(
        "amplitude exp(-x / decay) cos(2 pi frequency x + phase) + offset",
        {"amplitude": "y", "frequency": "1/x", "phase": "rad", "decay": "x", "offset": "y"},
        _damped_cosine,
        _guess_damped_cosine,
        at_least={"frequency": 0.0, "decay": 0.0},
        without={"decay": math.inf},
        # one of the many frequencies always fits noise with an amplitude of about three errors
        significance={"amplitude": 4.0},
        advice="points over more of the oscillation, several in each period",
    ),
    "gaussian": FitModel(
        "amplitude exp(-(x - centre)^2 / (2 sigma^2)) + offset",
        {"amplitude": "y", "centre": "x", "sigma": "x", "offset": "y"},
        _gaussian,
        _guess_gaussian,
        at_least={"sigma": 0.0},
        significance={"amplitude": 2.0},
    ),
    "lorentzian": FitModel(
        "amplitude / (1 + (2 (x - centre) / fwhm)^2) + offset",
        {"amplitude": "y", "centre": "x", "fwhm": "x", "offset": "y"},
        _lorentzian,
        _guess_lorentzian,
        at_least={"fwhm": 0.0},
        significance={"amplitude": 2.0},
    ),
    "linear": FitModel("slope x + intercept", {"slope": "y/x", "intercept": "y"}, _linear, _guess_linear),
    "polynomial": FitModel(
        "c0 + c1 x + c2 x^2 + c3 x^3 + c4 x^4",
        {"c0": "y", "c1": "y/x", "c2": "y/x^2", "c3": "y/x^3", "c4": "y/x^4"},
        _polynomial,
        _guess_polynomial,
        {"c3": 0.0, "c4": 0.0},
    ),
    "saturation": FitModel(
        "level (1 - exp(-x / time))",
        {"level": "y", "time": "x"},
        _saturation,
        _guess_saturation,
        at_least={"time": 0.0},
    ),
    "step": FitModel(
        "from before to after at centre, as the integral of a Gaussian of s.d. width",
        {"before": "y", "after": "y", "centre": "x", "width": "x"},
        _step,
        _guess_step,
        at_least={"width": 1e-12},
    ),
    "plateau": FitModel(
        "offset + amplitude within half_width of centre, falling as the integral of a Gaussian of s.d. edge",
        {"amplitude": "y", "centre": "x", "half_width": "x", "edge": "x", "offset": "y"},
        _plateau,
        _guess_plateau,
        {"offset": 0.0},
        at_least={"half_width": 0.0, "edge": 1e-12},
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
        {"temperature": 1e-9, "amplitude": 0.0, "depth": 1e-9, "waist": 1e-9},
        0.02,  # atoms are counted, and smaller steps would see their number jump
    ),
}
"""The models that ``--fit`` offers. Offsets of exponentials and of a plateau are fixed at 0 unless freed."""
