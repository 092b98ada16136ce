"""Quantities of a run by name, at the points of a scan, and fits of them."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from labseq_virtual.flight import KELVIN, draw_atoms

import labseq
from labseq.analysis.fits import MODELS, RB87_U, Fit, fit_points
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.cli import main
from labseq.data.points import scan_points
from labseq.data.quantities import OF_IMAGES, select_shots
from labseq.errors import ConfigError
from labseq.model.estimate import Estimate, Estimated, Rate

from .records import Write, make_shot


def at_points(run: labseq.Run, name: str) -> list[Estimated]:
    quantity = run.quantity(name)
    return [quantity.over(point.shots) for point in scan_points(run)]


def test_survival_between_named_images_is_counted_atom_by_atom(lifetime: labseq.Run) -> None:
    shot = lifetime.shots[0]
    before, after = shot.occupancies
    quantity = lifetime.quantity("survival:before,after")
    assert quantity.over([shot]) == Rate(int((before & after).sum()), int(before.sum()))
    assert lifetime.quantity("survival:0,1").over([shot]) == quantity.over([shot])
    assert lifetime.quantity("survival").over([shot]) == quantity.over([shot])


def test_atoms_are_followed_up_to_the_image_of_a_cycle_through_its_moves(write: Write) -> None:
    run = write([make_shot(0, n_cycles=2)])
    assert run.quantity("survival:0,1").over(run.shots) == Rate(6, 6)
    assert run.quantity("survival:1,2").over(run.shots) == Rate(6, 6)


def test_every_recorded_or_analysed_number_is_a_quantity(lifetime: labseq.Run) -> None:
    survival = [one.value for one in at_points(lifetime, "survival:before,after")]
    analysed = lifetime.quantity("analysis.survival.survival")
    assert [analysed.of_shot(shot) for shot in lifetime.shots] == pytest.approx(
        lifetime.to_dataframe()["analysis.survival.survival"].tolist()
    )
    assert [one.value for one in at_points(lifetime, "analysis.survival.survival")] == pytest.approx(
        survival, abs=0.01
    )
    assert lifetime.to_xarray(occupancies=False)["analysis.survival.survival"].dims == (
        "shot.hold.duration",
        "repeat",
    )
    held = at_points(lifetime, "stage.step_2_hold_s")
    assert [one.value for one in held] == pytest.approx([1, 5, 10, 20, 40, 80])
    assert lifetime.quantity("stage.step_2_hold_s").unit == "s"
    assert isinstance(at_points(lifetime, "filling:before")[0], Estimate)


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("survivl:before,after", "no quantity 'survivl:before,after'; expected one of survival:IMAGE,IMAGE"),
        ("survivl:before,after", "did you mean 'survival'?"),
        (
            "survival:befor,after",
            "no image 'befor' for 'survival:befor,after'; expected one of before, after; did",
        ),
        ("survival:before", "names 1; expected two images"),
        ("filing_fraction", "did you mean 'filling_fraction'?"),
    ],
)
def test_a_wrong_name_is_answered_with_the_nearest(lifetime: labseq.Run, name: str, printed: str) -> None:
    with pytest.raises(ConfigError) as caught:
        lifetime.quantity(name)
    assert printed in str(caught.value)


def test_shots_are_selected_by_any_quantity(lifetime: labseq.Run) -> None:
    chosen = select_shots(lifetime, ["loading:before > 0.74", "stage.step_2_hold_s <= 10 s"])
    wanted = [
        s
        for s in lifetime.shots
        if s.occupancies[0].mean() > 0.74 and s.parameters["shot.hold.duration"] <= 10
    ]
    assert 0 < len(chosen) < 6
    assert list(chosen) == wanted
    with pytest.raises(ConfigError, match="this is not a condition: 'before full'"):
        select_shots(lifetime, ["before full"])


def test_a_lifetime_scan_gives_the_lifetime_of_the_profile(lifetime: labseq.Run) -> None:
    x = [point.parameters["shot.hold.duration"] for point in scan_points(lifetime)]
    fit = fit_points("exponential", x, at_points(lifetime, "survival:before,after"), ("s", "%"))
    assert abs(fit.values["decay"].value - 33.0) < fit.values["decay"].error < 1.5
    assert 0.2 < fit.chi2 < 2
    assert "  decay       33(1) s" in fit.lines()


def test_release_and_recapture_gives_the_temperature_of_the_profile(recapture: labseq.Run) -> None:
    (fit,) = scan_report(recapture, ScanRequest(("survival:before,after",), fit="release_recapture")).fits
    temperature = fit.values["temperature"]
    assert abs(temperature.value - 15e-6) < 2.5 * temperature.error < 2e-6
    assert 0.2 < fit.chi2 < 3


@pytest.mark.parametrize(("temperature", "tolerance"), [(10e-6, 0.012), (60e-6, 0.015)])
def test_the_model_of_release_and_recapture_is_the_simulation_s_also_for_hot_atoms(
    temperature: float, tolerance: float
) -> None:
    waist, wavelength, depth, n = 0.98e-6, 808e-9, 300e-6, 20_000
    rayleigh = np.pi * waist**2 / wavelength
    depths = np.full(n, KELVIN * depth)
    atoms = draw_atoms(depths, KELVIN * temperature, waist, rayleigh, np.random.default_rng(1))
    t_s = np.array([5e-6, 15e-6, 40e-6])
    kept: list[float] = []
    for t in t_s:
        x, y, z = (atoms[:, :3] + t * atoms[:, 3:]).T
        width = 1 + (z / rayleigh) ** 2
        trap = KELVIN * depth / width * np.exp(-2 * (x**2 + y**2) / (waist**2 * width))
        kept.append(float(((atoms[:, 3:] ** 2).sum(axis=1) / 2 < trap).mean()))
    model = MODELS["release_recapture"].evaluate(t_s, temperature, 1.0, depth, waist, wavelength, RB87_U)
    assert model == pytest.approx(kept, abs=tolerance)


def test_the_commands_show_write_and_draw_the_same_points(
    lifetime: labseq.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run, scan = str(lifetime.path), ["--scan", "survival:before,after"]

    def printed(*arguments: str) -> str:
        with pytest.raises(SystemExit) as leaving:
            main([*arguments])
        assert leaving.value.code in (0, 2)
        captured = capsys.readouterr()
        return captured.out + captured.err

    shown = printed("show", run, *scan, "--fit", "exponential")
    rate = at_points(lifetime, "survival:before,after")[0]
    assert isinstance(rate, Rate)
    assert f"1 s      2  {rate.n} of {rate.n_trials} (" in shown
    assert "decay       33(1) s" in shown
    answer = json.loads(printed("show", run, *scan, "--json", "--where", "loading > 0.74"))
    shots = select_shots(lifetime, ["loading > 0.74"])
    assert sum(point["shots"] for point in answer["points"]) == len(shots) < 12
    assert printed("export", run, *scan, "-o", "points.csv") == (
        "written: points.csv\nwritten: points.units.csv\n"
    )
    with (tmp_path / "points.units.csv").open(newline="") as file:
        assert [*csv.reader(file)] == [
            ["column", "units", "description"],
            ["shot.hold.duration", "s", "scanned"],
            ["shots", "", "shots at the point"],
            ["survival:before,after", "", f"mean over the shots of: {OF_IMAGES['survival'].about}"],
            ["survival:before,after low", "", "lower end of its 1 sigma interval"],
            ["survival:before,after high", "", "upper end of its 1 sigma interval"],
        ]
    header, first, *rest = (tmp_path / "points.csv").read_text().splitlines()
    assert header.startswith('shot.hold.duration,shots,"survival:before,after","survival:before,after low"')
    assert [float(number) for number in first.split(",")[2:]] == [rate.value, *rate.interval]
    assert len(rest) == 5
    (tmp_path / "scan.png").touch()
    assert printed("plot", run, *scan, "--fit", "exponential") == "written: scan_1.png\n"
    assert "this file exists already; expected a new name; --force replaces it" in printed(
        "plot", run, *scan, "-o", "scan.png"
    )
    assert (tmp_path / "scan.png").stat().st_size == 0
    assert printed("plot", run, "--scan", "-o", "scan.png", "--force") == "written: scan.png\n"


TRAP = {"static_depth": 300e-6, "static_waist": 0.98e-6, "static_wavelength": 808e-9}
TRUTH = {
    "exponential": {"amplitude": 0.9, "decay": 0.03, "offset": 0.05},
    "gaussian": {"amplitude": -0.6, "centre": 0.041, "sigma": 0.006, "offset": 0.9},
    "lorentzian": {"amplitude": 0.5, "centre": 0.055, "fwhm": 0.02, "offset": 0.1},
    "linear": {"slope": -3.0, "intercept": 0.7},
    "saturation": {"level": 0.8, "time": 0.03},
    "step": {"before": 0.95, "after": 0.1, "centre": 0.04, "width": 0.01},
    "plateau": {"amplitude": 0.9, "centre": 0.04, "half_width": 0.02, "edge": 0.005},
    "lowering": {"temperature": 15e-6, "amplitude": 0.98},
    "release_recapture": {"temperature": 25e-6, "amplitude": 0.98},
}


def fitted(model: str, n: int = 15, given: dict[str, str] | None = None, settings: object = TRAP) -> Fit:
    """A fit to points of the model with normal errors."""
    x = np.linspace(2e-6, 60e-6, n) if model == "release_recapture" else np.linspace(0.0, 0.1, n)
    rest = (
        {"depth": 300e-6, "waist": 0.98e-6, "wavelength": 808e-9, "mass": 87.0}
        if model == "release_recapture"
        else {"depth": 300e-6}
        if model == "lowering"
        else {}
    )
    y = MODELS[model].evaluate(x, **TRUTH[model], **rest) + np.random.default_rng(3).normal(0, 0.01, n)
    values: Sequence[Estimated] = [Estimate(float(one), 0.01) for one in y]
    return fit_points(
        model, x.tolist(), values, ("s", "%"), given, settings if isinstance(settings, dict) else {}
    )


@pytest.mark.parametrize("model", MODELS)
def test_each_model_finds_its_parameters_from_its_own_starting_values(model: str) -> None:
    found = fitted(model, given={"offset": "free"} if model == "exponential" else {})
    for name, true in TRUTH[model].items():
        one = found.values[name]
        assert abs(one.value - true) < 3 * one.error < 0.5 * abs(true)
    assert 0.3 < found.chi2 < 2.5


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
        found = fit_points("linear", x.tolist(), values, ("s", "%")).values
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
    with pytest.raises(ConfigError, match=r"there is no fit 'gausian'.*did you mean 'gaussian'"):
        fit_points("gausian", [1.0], [Estimate(1.0, math.nan)], ("", ""))
