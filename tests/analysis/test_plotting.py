"""``labseq plot`` on a run of the virtual lab."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps

import labseq
from labseq.analysis.charts import COLOURS
from labseq.analysis.plotting import PlotRequest, plot_run
from labseq.cli import main
from labseq.errors import ConfigError
from labseq.pictures.figures import LIGHT
from tests.pictures.pixels import are_at, decoded, is_colour, on_lattice, spots

from .records import SHAPE, Write, image, make_shot


def test_the_newest_run_goes_to_the_current_folder(
    compact: labseq.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("LABSEQ_DATA", str(compact.path.parents[1]))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as leaving:
        main(["plot", "--what", "filling"])
    assert leaving.value.code == 0
    assert capsys.readouterr().out == "written: filling.png\n"
    assert decoded((tmp_path / "filling.png").read_bytes()).shape[:2] == (547, 1110)  # two panels


def test_each_shot_has_a_point_at_its_filling(write: Write, tmp_path: Path) -> None:
    defects = (0, 3, 1, 2)
    run = write([make_shot(i, n_defects=n, n_cycles=0) for i, n in enumerate(defects)])
    plot_run(run.path, PlotRequest(what="filling"), tmp_path / "filling.png")
    pixels = decoded((tmp_path / "filling.png").read_bytes(), "RGB")
    assert are_at(
        spots(is_colour(pixels, LIGHT)), [*enumerate(defects)]
    )  # defects count downwards, as y does


def test_loading_is_shown_site_by_site(write: Write, tmp_path: Path) -> None:
    sites = [(0, 1), (1, 3), (3, 0)]
    atoms = np.zeros(SHAPE, np.bool_)
    atoms[tuple(np.transpose(sites))] = True
    run = write([make_shot(0, n_cycles=0, images=[image(atoms, 1, -1, 0.5)])])
    plot_run(run.path, PlotRequest(what="loading"), tmp_path / "loading.png")
    always = is_colour(decoded((tmp_path / "loading.png").read_bytes(), "RGB"), colormaps[COLOURS](1.0))
    assert are_at(spots(always, least=2000), on_lattice(sites))


def test_each_picture_has_a_name_of_its_own(
    compact: labseq.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plot_run(compact.path, PlotRequest(what="defects"), None)
    plot_run(compact.path, PlotRequest(shot=1, cycle=0), None)
    assert {path.name for path in tmp_path.iterdir()} == {"defects.png", "shot-1-cycle-0.png"}


@pytest.mark.parametrize(
    ("request_", "output", "printed"),
    [
        (PlotRequest(what="x"), "a.png", "no picture 'x' of a run; expected one of 'counts', 'defects'"),
        (PlotRequest(), "a.bmp", "not the name of a PNG or SVG or PDF file"),
        (PlotRequest(what="scan"), "a.png", "nothing to show of the scan; expected a run of a sequence with"),
        (PlotRequest(shot=1, what="scan"), "a.png", "--what and --shot: these are different pictures"),
        (PlotRequest(cycle=1), "a.png", "--cycle: a cycle needs a shot; expected --shot as well"),
    ],
)
def test_what_cannot_be_drawn_is_reported(
    compact: labseq.Run, tmp_path: Path, request_: PlotRequest, output: str, printed: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        plot_run(compact.path, request_, tmp_path / output)
    assert printed in str(caught.value)
    assert not list(tmp_path.iterdir())
