"""Fits of a scan of two values, at each value of the second."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import lmfit
import pytest

import labseq
from labseq.analysis.overview import scan_picture
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.data.scanned import FitRequest
from labseq.errors import ConfigError

from .conftest import LIFETIME, run_text

SURVIVAL = "survival:before,after"
TIME, VACUUM = "shot.hold.duration", "profile.simulation.lifetime"


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    """A scan of the time in the tweezers and of the vacuum's lifetime in the virtual lab."""
    text = LIFETIME.replace("repeats: 2", f"  {VACUUM}: [10 s, 33 s]\nrepeats: 1")
    return run_text(text, tmp_path_factory.mktemp("two"), seed=4)


def test_the_first_value_is_fitted_at_each_of_the_second(two: labseq.Run) -> None:
    report = scan_report(two, ScanRequest((SURVIVAL,), FitRequest("exponential", {})))
    (fits,) = report.fits
    assert [at.values for at in fits] == [{VACUUM: 10.0}, {VACUUM: 33.0}]
    for at in fits:
        assert at.fit is not None
        decay = at.fit.parameters["decay"]
        assert abs(decay.value - at.values[VACUUM]) < 3 * decay.error < 10
    *_, header, first, second = report.as_text()
    assert header.split() == [VACUUM, "amplitude", "decay", "chi-square"]
    assert [line.split()[:2] for line in (first, second)] == [["10", "s"], ["33", "s"]]
    answer: Any = report.as_json()["fits"][SURVIVAL]
    assert answer[1].as_json()["at"] == {VACUUM: 33.0}
    titles = [panel.keywords["title"] for row in picture_rows(two) for panel in row]
    assert titles[-2:] == ["amplitude of the exponential fits", "decay of the exponential fits"]


def test_of_several_quantities_one_that_cannot_be_fitted_is_named_beside_the_others(two: labseq.Run) -> None:
    report = scan_report(two, ScanRequest((SURVIVAL, "n_images"), FitRequest("exponential", {})))
    assert [at.fit is not None for fits in report.fits for at in fits] == [True, True, False]
    last = report.as_text()[-1]
    assert last == "no fit exponential of n_images: the quantity is the same at all points"
    with pytest.raises(ConfigError, match="the same at all points"):
        scan_report(two, ScanRequest(("n_images",), FitRequest("exponential", {})))


def picture_rows(run: labseq.Run) -> Any:
    picture = scan_picture(run, ScanRequest((SURVIVAL,), FitRequest("exponential", {})))
    picture.draw()
    return picture.rows


def test_a_condition_chooses_one_value_and_the_fit_is_that_of_one_axis(two: labseq.Run) -> None:
    fit = two.fit(
        SURVIVAL, "exponential", where=[f"{VACUUM} == 33 s"], free=["offset"], fixed={"amplitude": 1}
    )
    assert fit.parameters["offset"].error > 0
    assert fit.parameters["amplitude"].error == 0
    at_33 = two.fits(SURVIVAL, "exponential")[1].fit
    assert at_33 is not None
    assert two.select(f"{VACUUM} == 33 s").fit(SURVIVAL, "exponential").as_json() == at_33.as_json()
    with pytest.raises(ConfigError, match=f"there are 2 values of {VACUUM}, each with its own fit"):
        two.fit(SURVIVAL, "exponential")


def test_along_chooses_the_axis_and_a_failed_fit_leaves_the_others(two: labseq.Run) -> None:
    with pytest.raises(ConfigError, match="2 points are too few for a fit of 2 parameters"):
        two.fits(SURVIVAL, "exponential", along=VACUUM)
    with pytest.raises(ConfigError, match=f"no axis 'shot.hold.duratoin'.*did you mean '{TIME}'"):
        two.fits(SURVIVAL, "exponential", along="shot.hold.duratoin")
    at_10 = [shot for shot in two.shots if shot.parameters[VACUUM] == 10]
    one_left = [f"shot != {shot.index}" for shot in at_10[1:]]
    fits = two.fits(SURVIVAL, "exponential", where=one_left)
    bad, good = sorted(fits, key=lambda at: at.values[VACUUM])
    assert bad.fit is None
    assert bad.problem.startswith("1 point is too few")
    assert good.fit is not None
    assert math.isfinite(good.fit.reduced_chi_square)
    request = ScanRequest((SURVIVAL,), FitRequest("exponential", {}))
    assert scan_report(two.select(*one_left), request).as_text()[-1] == f"10 s: {bad.problem}"


PLUGIN = """
import threading

import lmfit
import numpy as np
from labseq.plugin import hookimpl

LABSEQ_API = 1


def decays(t, lifetime, kept=1.0):
    return kept * np.exp(-t / lifetime)


def wrong(t, lifetime=1.0):
    return np.zeros(3)


def raises(t, lifetime=1.0):
    return t / lifetime["s"]


def model():
    made = lmfit.Model(decays)
    made.set_param_hint("lifetime", value=5.0, min=0.0)
    made.set_param_hint("kept", vary=False)
    return made


def hangs(t, lifetime=1.0):
    threading.Event().wait()
    return t


@hookimpl
def labseq_register(registry):
    registry.fit("own_decay", model, {"lifetime": "x", "kept": "y"})
    registry.fit("own_peak", lmfit.models.GaussianModel, {"center": "x"})
    registry.fit("own_start", lambda: lmfit.Model(decays))
    registry.fit("own_wrong", lambda: lmfit.Model(wrong))
    registry.fit("own_raise", lambda: lmfit.Model(raises))
    registry.fit("own_hang", lambda: lmfit.Model(hangs))
    registry.fit("own_none", lambda: 3)
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    assert lmfit.Model  # imported before, so that loading the plugin is quick
    path = tmp_path / "own_fits.py"
    path.write_text(PLUGIN, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    return path


def test_a_plugin_s_lmfit_model_is_fitted_by_its_name(lifetime: labseq.Run, plugin: Path) -> None:
    own, labseqs = (
        lifetime.fit(SURVIVAL, "own_decay"),
        lifetime.fit(SURVIVAL, "exponential", fixed={"amplitude": 1}),
    )
    tau, expected = own.parameters["lifetime"], labseqs.parameters["decay"]
    assert tau.unit == "s"
    assert tau.value == pytest.approx(expected.value, rel=1e-3)
    assert tau.error == pytest.approx(expected.error, rel=1e-2)
    assert own.parameters["kept"].error == 0
    assert own.residuals == pytest.approx(labseqs.residuals, abs=1e-3)
    assert lifetime.fit(SURVIVAL, "own_decay", free=["kept"]).parameters["kept"].error > 0
    with pytest.raises(ConfigError, match=r"there is no fit 'own_dcay'.*own_peak.*did you mean 'own_decay'"):
        lifetime.fit(SURVIVAL, "own_dcay")


@pytest.mark.parametrize(
    ("model", "problem"),
    [
        (
            "own_start",
            "plugin 'own_fits': fit 'own_start' lacks a starting value; write model.set_param_h",
        ),
        (
            "own_wrong",
            r"fit 'own_wrong' returned values of shape \(3,\) .* expected one number .*own_fits.py:15\)",
        ),
        ("own_raise", r"fit 'own_raise' raised TypeError: .*own_fits.py:20\)"),
        ("own_hang", "fit 'own_hang' did not return within 2 s and was abandoned"),
        ("own_none", "fit 'own_none' returned a int, without fit; expected an lmfit.Model"),
    ],
)
def test_a_plugin_s_model_that_is_wrong_is_named_in_one_line(
    lifetime: labseq.Run, plugin: Path, monkeypatch: pytest.MonkeyPatch, model: str, problem: str
) -> None:
    monkeypatch.setattr("labseq.data.lab_models.MAX_WAIT_S", 2.0 if model == "own_hang" else 30.0)
    with pytest.raises(ConfigError, match=problem) as caught:
        lifetime.fit(SURVIVAL, model)
    assert "\n" not in str(caught.value)
