"""Quantities of a run by name, at the points of a scan, and fits of them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from labseq_virtual.atom_kernels import draw_atoms
from labseq_virtual.formulas import KELVIN

import labseq
from labseq.analysis.overview import map_picture, scan_picture
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.cli import main
from labseq.data.conditions import select_shots
from labseq.data.fit_models import MODELS, RB87_U
from labseq.data.fits import fit_points
from labseq.data.points import scan_points
from labseq.data.scanned import FitRequest
from labseq.data.site_maps import site_map
from labseq.errors import ConfigError
from labseq.model.estimate import Estimate, Estimated, Rate
from labseq.model.image_quantities import OF_IMAGES

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
        (
            "survivl:before,after",
            "no quantity 'survivl:before,after'; expected one of survival[:IMAGE,IMAGE]",
        ),
        ("survivl:before,after", "did you mean 'survival'?"),
        (
            "survival:befor,after",
            "no image 'befor' for 'survival:befor,after'; expected one of before, after; did",
        ),
        ("survival:before", "names 1 image; expected survival:IMAGE,IMAGE"),
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
    held = select_shots(lifetime, ["shot.hold.duration == 10 s", "status == complete", "shot > 0"])
    assert {shot.parameters["shot.hold.duration"] for shot in held} == {10.0}
    with pytest.raises(ConfigError, match=r"column 'shot.hold.durtion'.*did you mean 'shot.hold.duration'"):
        select_shots(lifetime, ["shot.hold.durtion == 10 s"])
    with pytest.raises(ConfigError, match="'<' does not compare text; expected == or !="):
        select_shots(lifetime, ["status < 3"])
    with pytest.raises(ConfigError, match="no shot meets loading:before > 2"):
        lifetime.select("loading:before > 2")
    with pytest.raises(ConfigError, match="'before full' is not a condition"):
        select_shots(lifetime, ["before full"])
    with pytest.raises(ConfigError, match=r"'30 Hz' does not have the unit of 'shot\.hold\.dur"):
        select_shots(lifetime, ["shot.hold.duration > 30 Hz"])
    assert not select_shots(lifetime, ["loading:9 != 1"])  # no shot has so many images


def test_a_lifetime_scan_gives_the_lifetime_of_the_profile(lifetime: labseq.Run) -> None:
    x = [point.parameters["shot.hold.duration"] for point in scan_points(lifetime)]
    fit = fit_points("exponential", x, at_points(lifetime, "survival:before,after"), ("s", "%"))
    assert abs(fit.parameters["decay"].value - 33.0) < fit.parameters["decay"].error < 1.5
    assert 0.2 < fit.reduced_chi_square < 2
    assert "  decay       33(1) s" in fit.lines()


def test_release_and_recapture_gives_the_temperature_of_the_profile(recapture: labseq.Run) -> None:
    fit = recapture.fit("survival:before,after", "release_recapture")
    temperature = fit.parameters["temperature"]
    assert abs(temperature.value - 15e-6) < 2.5 * temperature.error < 2e-6
    assert 0.2 < fit.reduced_chi_square < 3


@pytest.mark.parametrize(("temperature", "tolerance"), [(10e-6, 0.012), (60e-6, 0.015)])
def test_the_model_of_release_and_recapture_is_the_simulation_s_also_for_hot_atoms(
    temperature: float, tolerance: float
) -> None:
    waist, wavelength, depth, n = 0.98e-6, 808e-9, 300e-6, 20_000
    rayleigh = np.pi * waist**2 / wavelength
    depths = np.full(n, KELVIN * depth)
    atoms = draw_atoms(
        depths, np.full(len(depths), KELVIN * temperature), waist, rayleigh, np.random.default_rng(1)
    )
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
    rows = printed("show", run, "--shots", "--where", "shot.hold.duration > 30 s").splitlines()
    assert [row.split()[1:3] for row in rows[1:]].count(["80", "s"]) == 2
    assert len(rows) == 1 + 4
    assert printed("export", run, "--where", "loading > 0.74", "-o", "shots.csv").startswith("written: shots")
    assert len((tmp_path / "shots.csv").read_text().splitlines()) == 1 + len(shots)
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
    assert "this file already exists; expected a new name; --force replaces it" in printed(
        "plot", run, *scan, "-o", "scan.png"
    )
    assert (tmp_path / "scan.png").stat().st_size == 0
    assert printed("plot", run, "--scan", "-o", "scan.png", "--force") == "written: scan.png\n"


def test_maps_of_sites_add_up_to_the_quantity(lifetime: labseq.Run, tmp_path: Path) -> None:
    name = "survival:before,after@0:10,:"
    sites = site_map(lifetime, name)
    rate = lifetime.quantity(name).over(lifetime.shots)
    assert isinstance(rate, Rate)
    assert (sites.n.sum(), sites.n_trials.sum()) == (rate.n, rate.n_trials)
    before, after = (np.array([shot.occupancies[i] for shot in lifetime.shots]) for i in (0, -1))
    assert sites.n_trials[:10] == pytest.approx(before.sum(axis=0)[:10])
    assert not sites.n_trials[10:].any()
    is_known = sites.n_trials >= 5
    assert is_known.any()
    assert (np.isnan(sites.values) == ~is_known).all()
    survived = (before & after).sum(axis=0)[is_known] / before.sum(axis=0)[is_known]
    assert sites.values[is_known] == pytest.approx(survived)
    # the deviations of sites that are alike scatter by one
    assert 0.7 < np.nanstd(sites.deviations) < 1.3
    picture = map_picture(lifetime, [name, "loading"])
    picture.save(tmp_path / "map.png")
    assert [len(row) for row in picture.rows] == [2, 2]
    with pytest.raises(ConfigError, match="'n_atoms' has one value per shot, not one per site"):
        site_map(lifetime, "n_atoms")


def test_without_a_name_the_first_quantity_is_fitted_and_named(lifetime: labseq.Run) -> None:
    """The run measures its filling and defect-free shots; of the latter no fit can be made."""
    report = scan_report(lifetime, ScanRequest((), FitRequest("exponential", {})))
    assert [len(fits) for fits in report.fits] == [1, 0]
    assert sum(line.startswith("fit exponential of filling: ") for line in report.as_text()) == 1
    assert len(scan_picture(lifetime, ScanRequest((), FitRequest("exponential", {}))).rows[0]) == 2
