"""``labseq plot`` on a run of the virtual lab."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.analysis.terminal import PlotRequest, plot_run
from labseq.cli import main
from labseq.errors import ConfigError

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sequence, profile = (
        ROOT / "sequences" / "figure5_multicycle.yaml",
        ROOT / "hardware_profiles" / "virtual.yaml",
    )
    root = tmp_path_factory.mktemp("data")
    with labseq.Session.open(sequence, profile=str(profile), shots=2, seed=1, output=root) as session:
        return session.run().path


def test_the_newest_run_goes_to_the_current_folder(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LABSEQ_DATA", str(run_dir.parents[1]))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as leaving:
        main(["plot", "--what", "filling"])
    assert leaving.value.code == 0
    assert capsys.readouterr().out == "written: filling.png\n"
    assert (tmp_path / "filling.png").read_bytes().startswith(b"\x89PNG")


def test_without_options_the_whole_run_is_drawn(run_dir: Path, tmp_path: Path) -> None:
    plot_run(run_dir, PlotRequest(), tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")


def test_each_picture_has_a_name_of_its_own(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plot_run(run_dir, PlotRequest(what="defects"), None)
    plot_run(run_dir, PlotRequest(shot=2, cycle=1), None)
    assert {path.name for path in tmp_path.iterdir()} == {"defects.png", "shot-2-cycle-1.png"}


@pytest.mark.parametrize(
    ("request_", "output", "printed"),
    [
        (PlotRequest(what="x"), "a.png", "no picture 'x' of a run; expected one of 'defects', 'filling'"),
        (PlotRequest(), "a.bmp", "no name of a PNG or SVG or PDF file"),
        (PlotRequest(what="scan"), "a.png", "nothing to show of the scan; expected a run of a sequence with"),
        (PlotRequest(shot=9), "a.png", "--shot: the run has no shot 9; expected one from 1 to 2"),
        (PlotRequest(shot=1, what="scan"), "a.png", "--what and --shot: these are different pictures"),
        (PlotRequest(cycle=1), "a.png", "--cycle: a cycle belongs to a shot; expected --shot as well"),
    ],
)
def test_what_cannot_be_drawn_is_reported(
    run_dir: Path, tmp_path: Path, request_: PlotRequest, output: str, printed: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        plot_run(run_dir, request_, tmp_path / output)
    assert printed in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_missing_run_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        plot_run(tmp_path, PlotRequest(), tmp_path / "a.png")
