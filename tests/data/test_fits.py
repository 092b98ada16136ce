"""Fits of points to labseq's models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import lmfit
import numpy as np
import pytest

from labseq.data.fit_models import MODELS
from labseq.data.fits import Fit, fit_points
from labseq.errors import ConfigError
from labseq.model.estimate import Estimate, Estimated, Rate, mean

TRAP = {"static_depth": 300e-6, "static_waist": 0.98e-6, "static_wavelength": 808e-9}
TRUTH = {
    "exponential": {"amplitude": 0.9, "decay": 0.03, "offset": 0.05},
    "gaussian": {"amplitude": -0.6, "centre": 0.041, "sigma": 0.006, "offset": 0.9},
    "lorentzian": {"amplitude": 0.5, "centre": 0.055, "fwhm": 0.02, "offset": 0.1},
    "double_exponential": {
        "amplitude_fast": 0.4,
        "decay_fast": 0.006,
        "amplitude_slow": 0.5,
        "decay_slow": 0.08,
    },
    "damped_cosine": {"amplitude": 0.4, "frequency": 31.0, "phase": 1.0, "decay": 0.1, "offset": 0.5},
    "polynomial": {"c0": 0.3, "c1": 12.0, "c2": -110.0},
    "linear": {"slope": -3.0, "intercept": 0.7},
    "saturation": {"level": 0.8, "time": 0.03},
    "step": {"before": 0.95, "after": 0.1, "centre": 0.04, "width": 0.01},
    "plateau": {"amplitude": 0.9, "centre": 0.04, "half_width": 0.02, "edge": 0.005, "offset": 0.05},
    "lowering": {"temperature": 15e-6, "amplitude": 0.98},
    "release_recapture": {"temperature": 25e-6, "amplitude": 0.98},
}


def fitted(
    model: str, n: int = 25, given: dict[str, str] | None = None, settings: object = TRAP, error: float = 0.01
) -> Fit:
    """A fit to points of the model with normal errors."""
    x = np.linspace(2e-6, 60e-6, n) if model == "release_recapture" else np.linspace(0.0, 0.1, n)
    rest = (
        {"depth": 300e-6, "waist": 0.98e-6, "wavelength": 808e-9, "mass": 87.0}
        if model == "release_recapture"
        else {"depth": 300e-6}
        if model == "lowering"
        else {}
    )
    rest |= {name: value for name, value in MODELS[model].fixed.items() if name not in {*rest, *TRUTH[model]}}
    y = MODELS[model].evaluate(x, **TRUTH[model], **rest) + np.random.default_rng(3).normal(0, 0.01, n)
    values: Sequence[Estimated] = [Estimate(float(one), error) for one in y]
    return fit_points(
        model, x.tolist(), values, ("s", "%"), given, settings if isinstance(settings, dict) else {}
    )


@pytest.mark.parametrize("model", MODELS)
def test_each_model_finds_its_parameters_from_its_own_starting_values(model: str) -> None:
    found = fitted(model, given={"offset": "free"} if model in ("exponential", "plateau") else {})
    for name, true in TRUTH[model].items():
        one = found.parameters[name]
        assert abs(one.value - true) < 3 * one.error < 0.5 * abs(true)
    assert 0.3 < found.reduced_chi_square < 2.5


def test_points_count_by_their_errors() -> None:
    """Against the formulas of a weighted straight line; and all errors ten times larger change no value."""
    x, y = np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.1, 0.9, 2.2, 9.0])
    errors = np.array([0.1, 0.05, 0.1, 2.0])
    weights = errors**-2
    x_mean, y_mean = np.average(x, weights=weights), np.average(y, weights=weights)
    spread = (weights * (x - x_mean) ** 2).sum()
    slope = (weights * (x - x_mean) * (y - y_mean)).sum() / spread
    for scale in (1.0, 10.0):
        values = [Estimate(*one) for one in zip(y.tolist(), (scale * errors).tolist(), strict=True)]
        found = fit_points("linear", x.tolist(), values, ("s", "%")).parameters
        assert found["slope"].value == pytest.approx(slope, rel=1e-4)
        assert found["slope"].error == pytest.approx(scale * spread**-0.5, rel=1e-3)
        assert found["intercept"].value == pytest.approx(y_mean - slope * x_mean, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (
            {"model": "linear", "n": 2},
            "2 points are too few for a fit of 2 parameters (slope, intercept); expected",
        ),
        ({"model": "release_recapture", "settings": None}, "the fit needs depth and waist and wavelength"),
        ({"model": "linear", "given": {"slop": "1"}}, "the fit has no parameter 'slop'; expected one of"),
        ({"model": "linear", "given": {"slope": "fast"}}, "slope: 'fast' is not a number with a unit"),
    ],
)
def test_a_fit_that_cannot_be_made_is_refused(arguments: dict[str, object], printed: str) -> None:
    with pytest.raises(ConfigError) as caught:
        fitted(**arguments)  # type: ignore[arg-type]
    assert printed in str(caught.value)


def test_points_that_do_not_determine_the_parameters_are_refused() -> None:
    flat = [Estimate(0.5 + 0.001 * (-1) ** i, 0.01) for i in range(8)]
    with pytest.raises(ConfigError, match=r"the points do not determine|did not converge"):
        fit_points("gaussian", [float(i) for i in range(8)], flat, ("s", "%"))


@pytest.mark.parametrize("model", MODELS)
def test_values_and_errors_are_those_of_lmfit(model: str) -> None:
    """Also without errors of the points, where the scatter about the fit takes their place."""
    for error in (0.01,) if model == "release_recapture" else (0.01, math.nan):
        found = fitted(model, error=error)
        parameters = lmfit.Parameters()
        for name, one in found.parameters.items():
            parameters.add(name, one.value * (1.02 if name in found.free else 1), vary=name in found.free)

        def residual(trial: Any, found: Fit = found) -> Any:
            evaluate = MODELS[found.model].evaluate
            return (evaluate(found.x, **trial.valuesdict()) - found.y) / found.errors

        step = MODELS[model].relative_step
        result: Any = lmfit.minimize(residual, parameters, scale_covar=math.isnan(error), epsfcn=step**2)
        counts_atoms = model == "release_recapture"
        for name, one in found.free.items():
            assert abs(result.params[name].value - one.value) < (0.3 if counts_atoms else 1e-2) * one.error
            assert result.params[name].stderr == pytest.approx(one.error, rel=0.1 if counts_atoms else 0.01)


RABI = {"amplitude": 0.45, "frequency": 40e3, "phase": 0.0, "decay": 60e-6, "offset": 0.5}
EVEN, UNEVEN = np.linspace(0.0, 100e-6, 21), np.sort(np.random.default_rng(5).uniform(0.0, 100e-6, 21))


@pytest.mark.parametrize(
    ("model", "truth", "x", "n"),
    [
        pytest.param("damped_cosine", RABI, EVEN, 100, id="rabi"),
        pytest.param("damped_cosine", RABI, EVEN, 20, id="rabi of few atoms"),
        pytest.param("damped_cosine", RABI | {"frequency": 12e3}, EVEN, 300, id="little more than a period"),
        pytest.param("damped_cosine", RABI | {"phase": -1.2}, UNEVEN, 200, id="uneven points"),
        pytest.param("damped_cosine", RABI, np.geomspace(1e-6, 100e-6, 25), 200, id="a logarithmic scan"),
        pytest.param(
            "double_exponential",
            {
                "amplitude_fast": 0.4,
                "decay_fast": 0.02,
                "amplitude_slow": 0.55,
                "decay_slow": 0.5,
                "offset": 0,
            },
            np.geomspace(0.002, 1.5, 18),
            3000,
            id="two decays",
        ),
        pytest.param(
            "exponential",
            {"amplitude": 0.95, "decay": 33.0, "offset": 0.0},
            np.array([1.0, 5, 10, 20, 40, 80]),
            30,
            id="a lifetime of few atoms",
        ),
        pytest.param(
            "polynomial",
            {"c0": 0.5, "c1": 8e3, "c2": -4e7, "c3": 0.0, "c4": 0.0},
            np.linspace(0.0, 200e-6, 12),
            300,
            id="a parabola",
        ),
    ],
)
def test_the_errors_cover_the_truth_as_often_as_they_should(
    model: str, truth: dict[str, float], x: Any, n: int
) -> None:
    """Counts of atoms: 68.3 % of the values lie within their errors, and they lie about the truth."""
    seeds, deviations = 120, dict[str, list[float]]()
    p = MODELS[model].evaluate(x, **truth)
    for seed in range(seeds):
        counts = np.random.default_rng(seed).binomial(n, p).tolist()
        fit = fit_points(model, x.tolist(), [Rate(count, n) for count in counts], ("s", "%"))
        for name, one in fit.free.items():
            deviations.setdefault(name, []).append((one.value - truth[name]) / one.error)
    for name, values in deviations.items():
        assert len(values) > 0.9 * seeds, name  # the others showed no decay
        assert 0.55 < np.mean(np.abs(values) < 1) < 0.8, name
        assert abs(np.median(values)) < 0.4, name


@pytest.mark.parametrize("n_shots", [2, 5])
def test_shots_that_agree_by_chance_do_not_shrink_the_errors(n_shots: int) -> None:
    """The filling of 400 sites, as the mean of a few shots at each point."""
    x, truth = np.array([10.0, 20, 40, 60, 100, 150, 250, 500]), 50.0
    rng, p = np.random.default_rng(1), 0.75 * (1 - np.exp(-x / truth))
    deviations: list[float] = []
    for _ in range(120):
        values = [mean(rng.binomial(400, at, n_shots) / 400) for at in p]
        time = fit_points("saturation", x.tolist(), values, ("ms", "%")).parameters["time"]
        deviations.append((time.value - truth) / time.error)
    assert 0.55 < np.mean(np.abs(deviations) < 1) < 0.8
    assert max(map(abs, deviations)) < 5


def rates(x: Any, p: Any, n: int, seed: int = 0) -> tuple[list[float], list[Rate]]:
    counts = np.random.default_rng(seed).binomial(n, np.broadcast_to(p, x.shape)).tolist()
    return x.tolist(), [Rate(count, n) for count in counts]


def test_an_oscillation_that_does_not_decay_is_fitted_without_a_decay() -> None:
    full = 0.5 + 0.45 * np.cos(2 * np.pi * 40e3 * EVEN)
    fits = [fit_points("damped_cosine", *rates(EVEN, full, 400, seed), ("s", "%")) for seed in range(20)]
    assert any(math.isinf(fit.parameters["decay"].value) for fit in fits)
    for fit in fits:
        frequency = fit.parameters["frequency"]
        assert abs(frequency.value - 40e3) < 4 * frequency.error < 1e3
        assert frequency.unit == "Hz"


@pytest.mark.parametrize(
    ("model", "p", "printed"),
    [
        ("damped_cosine", 0.5, "amplitude cannot be told from noise; expected points over more of the"),
        ("double_exponential", np.exp(-EVEN / 30e-6), "expected points that show two decays, or --fit expon"),
        (
            "exponential",
            1.0,
            "the points do not determine decay; expected points that follow",
        ),
    ],
)
def test_what_the_points_do_not_show_is_refused_with_what_to_do(model: str, p: Any, printed: str) -> None:
    with pytest.raises(ConfigError) as caught:
        fit_points(model, *rates(EVEN, p, 400), ("s", "%"))
    assert printed in str(caught.value)


def test_a_result_has_units_and_residuals() -> None:
    x, values = rates(np.linspace(-1e6, 1e6, 15), 0.5 + np.linspace(-0.2, 0.2, 15), 500)
    fit = fit_points("linear", x, values, ("Hz", "%"))
    slope = fit.parameters["slope"]
    assert slope.unit == "1/Hz"
    assert str(slope) == f"{slope.value * 1e8:.1f}({slope.error * 1e9:.0f}) %/MHz"
    assert fit.residuals == pytest.approx(fit.y - slope.value * fit.x - fit.parameters["intercept"].value)
    assert fit.at([0.0])[0] == fit.parameters["intercept"].value
