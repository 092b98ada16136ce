"""``labseq plot`` on a run of the virtual lab."""

from __future__ import annotations

from pathlib import Path

import pytest

import labseq
from labseq.cli import main
from labseq.cli.plot import plot_run
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
        main(["plot", "--figure", "5"])
    assert leaving.value.code == 0
    assert capsys.readouterr().out == "written: figure-5.png\n"
    assert (tmp_path / "figure-5.png").read_bytes().startswith(b"\x89PNG")


def test_two_runs_in_one_picture(run_dir: Path, tmp_path: Path) -> None:
    plot_run(run_dir, "5", tmp_path / "both.svg", run_dir / "run.json")
    assert "both.svg" in {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("figure", "output", "told"),
    [
        ("6", "a.png", "no figure '6' of a run; expected one of '4', '5'"),
        ("5", "a.bmp", "no name of a PNG or SVG or PDF file"),
        ("4", "a.png", "it does not scan planner.degree_of_parallelism; expected a run of a sequence like"),
    ],
)
def test_what_cannot_be_drawn_is_told(
    run_dir: Path, tmp_path: Path, figure: str, output: str, told: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        plot_run(run_dir, figure, tmp_path / output, None)
    assert told in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_what_is_no_run_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        plot_run(tmp_path, "5", tmp_path / "a.png", None)
