"""What a run measures, at its points and fitted, is what the library computes from the same files."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

import labseq
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.data.quantities import find_quantity
from labseq.data.reader import open_run
from labseq.data.scanned import FitRequest
from labseq.model import ShotRecord, TargetPattern
from labseq.model.estimate import Rate
from labseq.plain import to_plain
from labseq.recording.results import ResultsLog, results_file
from labseq.recording.writer import RunWriter
from tests.recording.records import SHAPE, make_shot

from .clients import Client, client_of, path_of, write_run

ROOT = Path(__file__).parents[2]
SURVIVAL = "survival:image_0,image_1"
HELD_S = (1.0, 2.0, 5.0, 10.0, 20.0)
NO_TARGET = TargetPattern(np.zeros(SHAPE, np.bool_), np.zeros(SHAPE, np.bool_), "none")


def held(index: int, point: int, life_s: float = 8.0) -> ShotRecord:
    """A shot without a target: 20 atoms, of which some are left at the end."""
    shot = make_shot(index, n_images=2, batches=(), success=None, filling_fraction=np.nan)
    n_left = round(20 * np.exp(-HELD_S[point] / life_s))
    left = np.arange(20).reshape(SHAPE) < n_left
    first, last = shot.images
    images = [replace(first, occupancy=np.ones(SHAPE, np.bool_)), replace(last, occupancy=left)]
    return replace(shot, images=images, parameters={"shot.hold.duration": HELD_S[point]})


def scan_of_holds(root: Path, n_points: int = len(HELD_S), *, measured: str = SURVIVAL) -> RunWriter:
    """A run in progress that scans how long the atoms are held."""
    scan = {
        "addresses": ["shot.hold.duration"],
        "points": [[held_s] for held_s in HELD_S],
        "written": [[f"{held_s:g} s"] for held_s in HELD_S],
        "repeats": 1,
        "order": "sequential",
        "point_of_shot": [0, 1, 2, 3, 4],
    }
    measure = [{"value": measured, "fit": "exponential", "report": "decay", "parameters": {}}]
    resolved = {"measure": measure, "profile": {"name": "virtual"}}
    writer = write_run(root, 0, n_shots=5, target=NO_TARGET, scan=scan, resolved=resolved)
    for index in range(n_points):
        writer.write_shot(held(index, index))
    return writer


def scan_of_two(root: Path) -> RunWriter:
    """A run of ten shots, none of which is taken yet: how long atoms are held, at two pressures."""
    points = [[held_s, pressure] for held_s in HELD_S for pressure in (2.0, 1.0)]
    scan = {
        "addresses": ["shot.hold.duration", "variables.pressure"],
        "points": points,
        "written": [[f"{held_s:g} s", f"{pressure:g}"] for held_s, pressure in points],
        "repeats": 1,
        "order": "sequential",
        "point_of_shot": [*range(10)],
    }
    resolved = {"measure": [{"value": SURVIVAL, "fit": "exponential", "report": "decay"}]}
    return write_run(root, 0, n_shots=10, target=NO_TARGET, scan=scan, resolved=resolved)


def held_at(index: int) -> ShotRecord:
    shot, pressure = held(index, index // 2, 8.0 / (2, 1)[index % 2]), (2.0, 1.0)[index % 2]
    return replace(shot, parameters={**shot.parameters, "variables.pressure": pressure})


def scan_at(client: Client, writer: RunWriter, quantity: str = "") -> Any:
    answer = client.get(f"{path_of(writer.run_dir)}/scan?quantity={quote(quantity)}")
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_points_and_fit_of_a_scan_without_a_target(tmp_path: Path) -> None:
    writer = scan_of_holds(tmp_path)
    (shown,) = (scan := scan_at(client_of(tmp_path), writer))["quantities"]
    run = open_run(writer.run_dir)
    report = scan_report(run, ScanRequest((SURVIVAL,), fit=FitRequest("exponential", {})))
    ((_, means),) = report.values
    assert [point["values"][0]["value"] for point in scan["points"]] == [mean.value for mean in means]
    assert [point["values"][0]["interval"] for point in scan["points"]] == [[*m.interval] for m in means]
    ((fitted_at,),) = report.fits
    assert fitted_at.fit is not None
    expected, fit = to_plain(fitted_at.fit), shown["fits"][0]
    assert fit["error"] == ""
    for name, about in expected["parameters"].items():
        assert fit["parameters"][name]["value"] == pytest.approx(about["value"])
        assert fit["parameters"][name]["error"] == pytest.approx(about["error"])
    assert fit["report"]["name"] == "decay"
    assert fit["reduced_chi_square"] == pytest.approx(expected["reduced_chi_square"])
    residuals = [one["value"] for one in fit["residuals"]]
    fitted = fitted_at.fit.at(np.array(HELD_S))
    assert residuals == pytest.approx([m.value for m in means] - fitted)
    assert (fit["curve"][0][0], fit["curve"][0][-1]) == (1.0, 20.0)


def test_a_run_without_a_target_shows_what_it_measures_and_nothing_of_a_target(tmp_path: Path) -> None:
    writer = scan_of_holds(tmp_path)
    client = client_of(tmp_path)
    mean = find_quantity(run := open_run(writer.run_dir), SURVIVAL).over(run.shots)
    assert isinstance(mean, Rate)
    listed = client.get("/api/v1/runs").json()["runs"][0]
    shots = client.get(f"{path_of(writer.run_dir)}/shots").json()
    for values in (
        client.get(path_of(writer.run_dir)).json(),
        client.get("/api/v1/now").json(),
        listed,
        shots,
    ):
        (measured,) = values["measured"]
        assert (measured["name"], measured["n"], measured["n_trials"]) == (SURVIVAL, mean.n, mean.n_trials)
        assert measured["interval"] == [*mean.interval]
    newest = shots["shots"][0]
    assert (newest["shot"], newest["scanned"], newest["n_defects"]) == (4, ["20 s"], None)
    assert newest["measured"] == [round(20 * np.exp(-20 / 8)) / 20]


def test_any_quantity_can_be_asked_for(tmp_path: Path) -> None:
    """One of the index, one in the files of shots, and results that come after their shots."""
    writer = scan_of_holds(tmp_path)
    client, run = client_of(tmp_path), open_run(writer.run_dir)
    log = ResultsLog(results_file(writer.run_dir, "heat"), {"analysis": "heat"})
    log.write(0, {"n": 3.0})
    of_sites = "survival:image_0,image_1@0:2,1"
    for name in ("n_atoms", "reading.laser.power_w", of_sites, "analysis.heat.n"):
        scan = scan_at(client, writer, name)
        expected = [find_quantity(run, name).of_shot(shot) for shot in run.shots]
        values = [point["values"][0]["value"] for point in scan["points"]]
        assert values == pytest.approx([None if np.isnan(one) else one for one in expected])
        assert ([one["name"] for one in scan["quantities"]], scan["n_unread"]) == ([name], 0)
    log.write(1, {"n": 5.0})
    assert scan_at(client, writer, "analysis.heat.n")["points"][1]["values"][0]["value"] == 5.0
    assert {SURVIVAL, "n_atoms", "analysis.heat.n"} <= {*scan_at(client, writer)["choices"]}


def test_a_quantity_that_no_shot_has_is_answered_with_those_that_there_are(tmp_path: Path) -> None:
    writer = scan_of_holds(tmp_path)
    answer = client_of(tmp_path).get(f"{path_of(writer.run_dir)}/scan?quantity=survival:image_0,image_7")
    assert answer.status_code == 409
    assert "there is no image 'image_7'" in answer.json()["error"]


def test_a_fit_with_too_few_points_says_so_and_is_made_when_there_are_enough(tmp_path: Path) -> None:
    writer = scan_of_holds(tmp_path, 2)
    client = client_of(tmp_path)
    fit = scan_at(client, writer)["quantities"][0]["fits"][0]
    assert "2 points are too few" in fit["error"]
    assert "\n" not in fit["error"]
    for index in range(2, 5):
        writer.write_shot(held(index, index))
    assert scan_at(client, writer)["quantities"][0]["fits"][0]["n_points"] == 5


def test_a_scan_of_two_values_is_fitted_at_each_of_the_second(tmp_path: Path) -> None:
    """And where the points of one are too few, its row says so beside the fit of the other."""
    writer, client = scan_of_two(tmp_path), client_of(tmp_path)
    for index in (0, 1, 2, 3, 4, 6, 8):
        writer.write_shot(held_at(index))
    first, second = scan_at(client, writer)["quantities"][0]["fits"]
    assert (first["at"], first["n_points"], second["at"]) == (["2"], 5, ["1"])
    assert "2 points are too few" in second["error"]
    for index in (5, 7, 9):
        writer.write_shot(held_at(index))
    fits = scan_at(client, writer)["quantities"][0]["fits"]
    (expected,) = scan_report(open_run(writer.run_dir), ScanRequest()).fits
    assert [fit["at"] for fit in fits] == [[*at.written.values()] for at in expected]
    for fit, at in zip(fits, expected, strict=True):
        assert at.fit is not None
        assert fit["report"]["text"] == str(at.fit.parameters["decay"])
        assert [one["value"] for one in fit["residuals"]] == pytest.approx(at.fit.residuals.tolist())
        assert fit["residuals"][0]["interval"][0] < fit["residuals"][0]["value"]


def test_the_page_goes_on_while_a_model_hangs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()

    def hang(*_: Any) -> Any:
        release.wait(60.0)
        raise ZeroDivisionError("the model\nfailed")

    monkeypatch.setattr("labseq.data.scanned.fit_points", hang)
    monkeypatch.setattr("labseq.web.runs.Catalogue.warm", lambda _: None)  # which fits, too
    writer = scan_of_holds(tmp_path, 4)
    client = client_of(tmp_path)
    path = f"{path_of(writer.run_dir)}/state"
    assert client.get(path).json()["run"]["n_done"] == 4
    writer.write_shot(held(4, 4))
    state = client.get(path).json()
    assert state["run"]["n_done"] == 5
    assert "computed" in state["scan"]["quantities"][0]["fits"][0]["error"]
    release.set()
    assert "ZeroDivisionError" in scan_at(client, writer)["quantities"][0]["fits"][0]["error"]


def test_the_last_good_shot_is_shown_after_attempts_that_failed(tmp_path: Path) -> None:
    writer = write_run(tmp_path, 2, n_shots=3)
    for attempt in range(2):
        writer.write_shot(make_shot(2, attempt=attempt, status="failed", error="no light"))
    state = client_of(tmp_path).get(f"{path_of(writer.run_dir)}/state").json()
    assert (state["shot"]["shot"], state["shot"]["status"], len(state["shot"]["images"])) == (
        1,
        "complete",
        3,
    )
    assert any("2 attempts" in alarm["title"] for alarm in state["alarms"])


def test_a_run_of_the_shipped_lifetime_sequence_has_its_decay(tmp_path: Path) -> None:
    profile = str(ROOT / "hardware_profiles" / "virtual.yaml")
    options: Any = {"profile": profile, "seed": 1, "output": tmp_path}
    options["overrides"] = ["scan={shot.hold.duration: [1 s, 10 s, 40 s]}", "repeats=1"]
    with labseq.Session.open(ROOT / "sequences" / "lifetime.yaml", **options) as session:
        run = open_run(session.run().path)
    answer = client_of(tmp_path).get(f"{path_of(run.path)}/scan").json()
    report = scan_report(run, ScanRequest(fit=FitRequest("exponential", {})))
    ((fitted_at,),) = report.fits
    assert fitted_at.fit is not None
    decay = answer["quantities"][0]["fits"][0]["parameters"]["decay"]
    assert decay["value"] == pytest.approx(fitted_at.fit.parameters["decay"].value)
    (listed,) = client_of(tmp_path).get("/api/v1/runs?q=decay").json()["runs"]
    assert listed["results"] == [{"name": "decay", "text": f"decay {fitted_at.fit.parameters['decay']}"}]
    assert listed["scanned"] == "hold.duration 1 s to 40 s, 3 values"


def test_a_map_has_the_quantity_at_each_site(tmp_path: Path) -> None:
    writer = scan_of_holds(tmp_path)
    path = path_of(writer.run_dir)
    client = client_of(tmp_path)
    shown = client.get(f"{path}/map").json()
    assert shown["quantity"] == SURVIVAL == shown["choices"][0]
    survived = np.array([shot.occupancies[1] for shot in open_run(writer.run_dir).shots]).mean(axis=0)
    assert np.array(shown["values"]) == pytest.approx(survived)
    assert (np.array(shown["n_trials"]) == len(HELD_S)).all()
    for choice in shown["choices"]:
        assert client.get(f"{path}/map?quantity={quote(choice)}").status_code == 200, choice
    assert client.get(f"{path}/map?quantity=n_batches").status_code == 409
