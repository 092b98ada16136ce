"""What a run measures: `measure` in a sequence, its defaults, its mistakes, and the values in the index."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import labseq
from labseq.data.follower import Follower
from labseq.data.quantities import measured_by
from labseq.errors import ConfigError, StopRequested

from .small_runs import Interrupting, resumed
from .whole_runs import SMALL_FRAMES

HEAD = "labseq: 1\nname: m\nseed: 5\nshots: 2\n"
SURVIVAL = (
    "shot: [{load: {}}, {name: before, image: {}}, {wait: {duration: 5 s}}, {name: after, image: {}}]\n"
)
ARRAY = (
    "target: {pattern: compact, rows: 5, cols: 5}\n"
    "shot:\n  - load: {}\n  - image: {}\n  - rearrange: {cycles: 2}\n  - {name: before, image: {}}\n"
    "  - wait: {duration: 5 s}\n  - {name: after, image: {}}\n"
)
SCAN = "scan: {shot.2.wait.duration: [1 s, 2 s]}\n"


def opened(tmp_path: Path, text: str) -> labseq.Session:
    path = tmp_path / "m.yaml"
    path.write_text(text, "utf-8")
    return labseq.Session.open(path, output=tmp_path, overrides=SMALL_FRAMES)


def message(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as error:
        opened(tmp_path, text)
    return str(error.value).removeprefix(f"{tmp_path / 'm.yaml'}:")


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (HEAD + SURVIVAL, ["survival:before,after"]),
        (HEAD + ARRAY, ["filling", "defect_free"]),
        (HEAD + "shot: [{load: {}}, {image: {}}]\n", ["loading"]),
        (HEAD + "shot: [{load: {}}, {image: {}}, {load: {}}, {name: b, image: {}}]\n", ["loading:b"]),
        (HEAD + "shot: [{wait: {duration: 1 s}}]\n", []),
        (HEAD + "measure: survival:0,1\n" + SURVIVAL, ["survival:0,1"]),
        (HEAD + "measure: ['filling:before@0:10,:']\n" + ARRAY, ["filling:before@0:10,:"]),
    ],
)
def test_without_measure_the_steps_say_it(tmp_path: Path, text: str, names: list[str]) -> None:
    with opened(tmp_path, text) as session:
        assert [one["value"] for one in session.assembly.resolved["measure"]] == names


def test_runs_of_earlier_versions_measure_what_their_steps_say(tmp_path: Path) -> None:
    with opened(tmp_path, HEAD + SURVIVAL) as session:
        run = session.run()
    del run.record["resolved"]["measure"]
    assert measured_by(run) == ("survival:before,after",)


def test_some_sites_are_measured(tmp_path: Path) -> None:
    names = ["survival:before,after@target", "survival:before,after", "loading:before@0:3,2"]
    with opened(tmp_path, HEAD + f"measure: [{', '.join(map(repr, names))}]\n" + ARRAY) as session:
        run = session.run()
    assert list(measured_by(run)) == names
    for shot in run.shots:
        before, after = shot.occupancies[-2:]
        fill = run.target.fill
        in_target, everywhere, loading = (shot.row.measured[name] for name in names)
        assert in_target == (np.sum(before & after & fill), np.sum(before & fill))
        assert everywhere == (np.sum(before & after), np.sum(before))
        assert loading == (before[:3, 2].mean(), 1)
        assert in_target[1] < everywhere[1]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("measure: [survivl]", "5:11: there is no quantity 'survivl' to measure; expected one of survival[:"),
        ("measure: [{value: loading, fot: x}]", "5:28: 'fot' is not a setting"),
        ("measure: ['survival:before,aftr']", "did you mean 'after'?"),
        ("measure: [loading@target]", "5:11: there are no sites 'target' (the run has no target) to measure"),
        (
            "measure: ['loading@30,:']",
            "5:11: there are no sites '30,:' (of 20 x 20) to measure; expected target",
        ),
        ("measure: [loading@]", "5:11: 'loading@' names no sites after the '@' to measure"),
        ("measure: [loading@left]", "5:11: 'left' is not a set of sites to measure"),
        ("measure: []", "5:10: "),
        ("measure: loadin", "5:10: there is no quantity 'loadin' to measure"),
        ("measure: [loading, survival, loading]", "5:30: 'loading' is listed a second time"),
        ("measure: ['survival:before,before']", "must name an earlier and a later image to measure"),
        ("measure: ['survival:after,before']", "expected the earlier image first"),
        ("measure: [filling]", "5:11: there is no 'filling': the run has no target to measure"),
        ("measure: [{value: loading, fit: gausian}]", "5:33: there is no model 'gausian'"),
        (
            "measure: [{value: loading, report: decay}]",
            "5:28: 'report' is given without a fit; expected 'fit' as well",
        ),
        ("measure: [{value: analysis.x.y}]", "the sequence must list the analysis"),
        (
            "measure: [reading.camera.temperature]",
            "5:11: no device of the profile and no step gives 'reading.camera.temperature' to measure",
        ),
    ],
)
def test_a_mistake_is_named_with_its_place(tmp_path: Path, line: str, expected: str) -> None:
    text = HEAD + line + "\n" + SURVIVAL
    assert expected in message(tmp_path, text).replace(";  ", "; ")


def test_survival_needs_two_images(tmp_path: Path) -> None:
    text = HEAD + "measure: survival\nshot: [{load: {}}, {name: first, image: {}}]\n"
    assert "5:10: there is no 'survival' to measure because the shot has one image, 'first'" in message(
        tmp_path, text
    )


LASER = (
    "devices={laser: {use: serial, port: simulated, write_ends_with: ';', read_ends_with: ';', values: "
    "{power_w: {ask: 'P?', poll: true}, age: {ask: 'A?'}}}}"
)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("reading.laser.power_w", ""),
        ("reading.laser.age", "'reading.laser.power_w'"),
        ("reading.overlay.error_m", ""),
        ("reading.tweezers.noise", "'reading.overlay.<name>'"),
    ],
)
def test_readings_are_those_of_devices_and_steps(tmp_path: Path, name: str, problem: str) -> None:
    """A serial instrument says which values it records, and a step what it notes."""
    shot = ARRAY + "  - check_overlay: {every: 2}\n"
    path = tmp_path / "m.yaml"
    path.write_text(HEAD + f"measure: {name}\n" + shot, "utf-8")
    overrides = [*SMALL_FRAMES, f"profile.{LASER}"]
    if not problem:
        labseq.Session.open(path, output=tmp_path, overrides=overrides).close()
        return
    with pytest.raises(ConfigError) as error:
        labseq.Session.open(path, output=tmp_path, overrides=overrides)
    assert problem in str(error.value)


@pytest.mark.parametrize(
    ("measure", "expected"),
    [
        ("fit: exponential, report: tau", "the model 'exponential' has no parameter 'tau'; expected one of"),
        ("fit: exponential, parameters: {ofset: 0}", "did you mean 'offset'?"),
    ],
)
def test_a_fit_has_the_parameters_of_its_model(tmp_path: Path, measure: str, expected: str) -> None:
    text = HEAD.replace("shots: 2\n", "") + SCAN + "measure: [{value: loading, " + measure + "}]\n" + SURVIVAL
    assert expected in message(tmp_path, text)


def test_a_fit_needs_a_scan(tmp_path: Path) -> None:
    text = HEAD + "measure: [{value: loading, fit: exponential}]\n" + SURVIVAL
    assert "a fit needs a scan; expected 'scan'" in message(tmp_path, text)


SCANNED = HEAD.replace("shots: 2\n", "repeats: 40\norder: shuffled\n") + SCAN.replace("2 s]", "9 s, 60 s]")


@pytest.mark.parametrize(
    ("measure", "expected"),
    [
        ("stop_when: {tau: 2 %}", "7:59: the model 'exponential' has no parameter 'tau'; expected one of"),
        (
            "stop_when: {decay: 2}",
            "7:66: '2' has no unit; expected the error to reach: 2 % of the value, or 0.1 s",
        ),
        ("stop_when: {decay: 2 mV}", "7:66: '2 mV' does not have the unit of the parameter"),
        ("stop_when: {decay: 0 %}", "7:66: '0 %' is not a valid error"),
        ("stop_when: {offset: 2 %}", "7:59: 'offset' is fixed"),
    ],
)
def test_an_error_to_reach_is_one_of_a_fitted_parameter(tmp_path: Path, measure: str, expected: str) -> None:
    text = SCANNED + "measure: [{value: survival, fit: exponential, " + measure + "}]\n" + SURVIVAL
    assert expected in message(tmp_path, text).replace(";  ", "; ")


def test_an_error_has_the_unit_of_what_is_fitted_along(tmp_path: Path) -> None:
    one_value = SCANNED.replace("scan: {", "scan: {profile.simulation.loading: [60 %], ")
    slope = "measure: [{value: survival, fit: linear, stop_when: {slope: 1 %/s}}]\n"
    assert "or a number in 1/s" in message(tmp_path, one_value + slope + SURVIVAL)
    decay = "measure: [{value: survival, fit: exponential, stop_when: {decay: 1 s}}]\n"
    opened(tmp_path, one_value + decay + SURVIVAL)


def test_a_run_that_takes_point_after_point_cannot_end_early(tmp_path: Path) -> None:
    text = SCANNED.replace("order: shuffled\n", "")
    text += "measure: [{value: survival, fit: exponential, stop_when: {decay: 2 %}}]\n" + SURVIVAL
    assert "the run cannot end early because it takes all shots of a point" in message(tmp_path, text)


def test_a_scan_of_names_cannot_be_fitted(tmp_path: Path) -> None:
    scan = "scan: {shot.1.image.correct_overlay: [false, true]}\n"
    text = SCANNED.replace(SCANNED[SCANNED.index("scan:") :], scan)
    text += "measure: [{value: survival, fit: exponential}]\n" + SURVIVAL
    assert "a fit needs numbers" in message(tmp_path, text)


FITS = """
import threading

import lmfit
import numpy as np
from labseq.plugin import hookimpl

LABSEQ_API = 1


def decays(t, life=20.0):
    return np.exp(-t / life)


def raises(t, life=20.0):
    return t / life["s"]


def hangs(t, life=20.0):
    threading.Event().wait()


@hookimpl
def labseq_register(registry):
    registry.fit("own", lambda: lmfit.Model(decays), {"life": "x"})
    registry.fit("broken", lambda: lmfit.Model(raises), {"life": "x"})
    registry.fit("stuck", lambda: lmfit.Model(hangs), {"life": "x"})
"""


@pytest.mark.parametrize(("fit", "name"), [("exponential", "decay"), ("own", "life")])
def test_a_run_ends_when_its_result_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fit: str, name: str
) -> None:
    (tmp_path / "fits.py").write_text(FITS, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    measure = f"measure: [{{value: survival, fit: {fit}, stop_when: {{{name}: 5 %}}}}]\n"
    with opened(tmp_path, SCANNED + measure + SURVIVAL) as session:
        run = session.run()
    assert run.status == "complete"
    assert 6 <= len(run.shots) < 120
    assert len(run.shots) % 3 == 0
    parameter = run.fit("survival", fit).parameters[name]
    assert run.ended_early == f"stop_when reached: {name} {parameter}"
    assert parameter.error <= 0.05 * parameter.value
    before = run.select(f"shot < {len(run.shots) - 3}").fit("survival", fit)
    value = before.parameters[name]
    assert value.error > 0.05 * value.value or before.reduced_chi_square > 4
    with pytest.raises(ConfigError, match="the run cannot be resumed: it is complete: stop_when reached"):
        labseq.Session.resume(run.path)


def test_a_resumed_run_ends_at_the_same_shot(tmp_path: Path) -> None:
    measure = "measure: [{value: survival, fit: exponential, stop_when: {decay: 1.3 %}}]\n"
    runs: list[labseq.Run] = []
    for n_before in (0, 64):
        observer = Interrupting("shot_finished", n_before)
        path = tmp_path / "m.yaml"
        path.write_text(SCANNED + measure + SURVIVAL, "utf-8")
        with labseq.Session.open(
            path, seed=1, output=tmp_path, overrides=SMALL_FRAMES, observer=observer
        ) as session:
            observer.session = session
            with suppress(StopRequested):
                session.run()
        assert session.run_dir is not None
        runs.append(resumed(session.run_dir) if n_before else labseq.open_run(session.run_dir))
    assert (len(runs[0].shots), runs[0].ended_early) == (len(runs[1].shots), runs[1].ended_early)
    assert 66 < len(runs[0].shots) < 120


@pytest.mark.parametrize(
    ("fit", "name", "warning"),
    [
        ("linear", "slope", ""),
        ("broken", "life", "raised TypeError"),
        ("stuck", "life", "the fit stuck did not end within"),
    ],
)
def test_points_that_do_not_follow_or_a_broken_model_do_not_end_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fit: str, name: str, warning: str
) -> None:
    (tmp_path / "fits.py").write_text(FITS, "utf-8")
    monkeypatch.setenv("LABSEQ_PLUGIN_PATH", str(tmp_path))
    if fit == "stuck":
        monkeypatch.setattr("labseq.session.precision.MAX_FIT_S", 0.1)
    measure = f"measure: [{{value: survival, fit: {fit}, stop_when: {{{name}: 50 %}}}}]\n"
    text = SCANNED.replace("repeats: 40", "repeats: 3") + measure + SURVIVAL
    with opened(tmp_path, text) as session:
        run = session.run()
    assert (len(run.shots), run.ended_early) == (9, "")
    warnings = [event.values["text"] for event in Follower(run.path).log() if event.name == "warning"]
    assert sum("the run takes all its shots" in text and warning in text for text in warnings) == bool(
        warning
    )


REGIONS = """regions:
  corner: "0:3,2"
  two: [[0, 0], [3, 5]]
  drawn: {pattern: bitmap, sites: "##.\\n.#.", origin: [4, 1]}
"""


def test_named_regions_are_sites_of_quantities(tmp_path: Path) -> None:
    names = ["loading:before@corner", "loading:before@two", "survival:before,after@drawn"]
    with opened(
        tmp_path, HEAD + REGIONS + f"measure: [{', '.join(map(repr, names))}]\n" + SURVIVAL
    ) as session:
        run = session.run()
    for shot in labseq.open_run(run.path).shots:
        before, after = shot.occupancies
        drawn = np.zeros(before.shape, np.bool_)
        drawn[4, 1:3] = drawn[5, 2] = True
        values = [shot.row.measured[name] for name in names]
        expected = (np.sum(before & after & drawn), np.sum(before & drawn))
        assert values == [(before[:3, 2].mean(), 1), (before[[0, 3], [0, 5]].mean(), 1), expected]
        assert run.quantity("loading:before@drawn").of_shot(shot) == before[drawn].mean()


@pytest.mark.parametrize(
    ("regions", "expected"),
    [
        ("{left: '30,:'}", "5:17: there are no sites '30,:' (of 20 x 20)"),
        ("{left: [[0, 30]]}", "5:18: [0, 30] is not a site of the grid of 20 x 20"),
        ("{left: [[0]]}", "5:18: left.0 has 1 "),
        ("{left: {pattern: bitmap, sites: '...'}}", "5:"),
        ("{left: {pattern: compact, rows: 30, cols: 2}}", "5:17: "),
        ("{target: '1,1'}", "5:11: 'target' cannot be the name of a region"),
        ("{left: 'a b'}", "5:17: 'a b' is not a set of sites"),
    ],
)
def test_a_wrong_region_is_one_error(tmp_path: Path, regions: str, expected: str) -> None:
    text = message(tmp_path, HEAD + f"regions: {regions}\nmeasure: [loading@left]\n" + SURVIVAL)
    assert text.startswith(expected)
    assert "\n" not in text
