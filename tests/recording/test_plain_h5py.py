"""What an analyst needs of a run is in its files, in SI and with names."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import labseq
from labseq.analysis.overview import overview, picture_of
from labseq.analysis.shot import save_shot, shot_picture
from labseq.cli.show import shot_rows, shot_table
from labseq.cli.summary import Summary
from labseq.data.images import average_frame, loading_map, signals_of

from .records import make_shot, write

SEQUENCE = """\
labseq: 1
name: release
profile: virtual
seed: 3
record_frames: none
target: {pattern: compact, rows: 10, cols: 10}
scan: {shot.hold.duration: [1 ms, 20 ms]}
shot:
  - load: {}
  - image: {}
    name: before
  - wait: {duration: 1 ms}
    name: hold
  - rearrange: {cycles: 2, window: 60 ms, stop_when: never}
  - image: {}
"""
CHANGES = (
    "shot.before.exposure=80 ms",
    "profile.mobile_tweezers.pick_up=0.0002 s",
    "planner.degree_of_parallelism=5",
)
EXPOSURE, PICK_UP, HOLD = (
    "shot.before.exposure",
    "profile.mobile_tweezers.pick_up",
    "shot.hold.duration",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> labseq.Run:
    folder = tmp_path_factory.mktemp("release")
    (folder / "release.yaml").write_text(SEQUENCE, "utf-8")
    with labseq.Session.open(folder / "release.yaml", output=folder, overrides=CHANGES) as session:
        return session.run()


def test_filling_per_cycle_and_survival_between_named_images(run: labseq.Run) -> None:
    shot_file = run.shots[0].file
    with h5py.File(shot_file) as file:
        entry: Any = file["entry"]
        images, sites = entry["detection/images"][()], entry["detection/occupancy"][()] == 1
        target = entry["target/fill"][()] == 1
    filling = {cycle: sites[images["cycle"] == cycle][:, target].mean() for cycle in (0, 1)}
    before, after = (sites[images["name"] == name][0] for name in (b"before", b"image"))
    survival = (before & after).sum() / before.sum()

    names = ["before", "rearrange_cycle_0", "rearrange_cycle_1", "image"]
    assert [name.decode() for name in images["name"]] == names == [one.name for one in run.shots[0].images]
    assert filling[1] > 0.9
    assert 0.5 < survival < 1


def test_other_thresholds_need_no_frames(run: labseq.Run) -> None:
    with h5py.File(run.shots[0].file) as file:
        found: Any = file["entry/detection"]
        signal, threshold, occupancy = found["signal"], found["threshold"], found["occupancy"]
        np.testing.assert_array_equal(signal[()] > threshold[()], occupancy[()])
        assert (signal.attrs["units"], threshold.attrs["units"]) == (b"counts", b"counts")
        assert signal.attrs["dimensions"] == b"image, row, col"
        assert found["sites_px"].shape == (*threshold.shape, 2)
        assert "camera" not in file["entry"]  # pyright: ignore[reportOperatorIssue] - a group
        steps: Any = file["entry/run/steps"]
        assert json.loads(steps[()]) == ["load", "before", "hold", "rearrange", "image"]


def test_what_is_set_or_scanned_is_a_number_in_si_with_its_unit(run: labseq.Run) -> None:
    expected = {EXPOSURE: (0.08, "s"), PICK_UP: (2e-4, "s"), "planner.degree_of_parallelism": (5, "")}
    record = json.loads((run.path / "run.json").read_bytes())
    assert record["overrides"][EXPOSURE] == {"value": 0.08, "unit": "s", "written": "80 ms"}
    index = [json.loads(line) for line in (run.path / "index.jsonl").read_text("utf-8").splitlines()]
    for shot, hold_s in zip(index, (0.001, 0.02), strict=True):
        with h5py.File(run.path / shot["file"]) as file:
            parameters: Any = file["entry/parameters"]
            for address, (value, unit) in {**expected, HOLD: (hold_s, "s")}.items():
                assert shot["parameters"][address] == parameters[address][()] == value
                assert parameters[address].attrs["units"].decode() == record["units"].get(address, "") == unit
    table, data = run.to_dataframe(), run.to_xarray()
    assert table[EXPOSURE].tolist() == [0.08, 0.08]
    assert table.attrs["units"][PICK_UP] == data[PICK_UP].attrs["units"] == data[HOLD].attrs["units"] == "s"
    assert data[HOLD].values.tolist() == [0.001, 0.02]
    assert not [name for name in table.columns if " " in name]


def test_a_sequence_without_a_target_is_run_shown_and_drawn(tmp_path: Path) -> None:
    steps = "[{load: {}}, {image: {}, name: before}, {wait: {duration: 10 ms}}, {image: {}, name: after}]"
    path = tmp_path / "release.yaml"
    path.write_text(f"labseq: 1\nname: release\nseed: 3\nshots: 2\nshot: {steps}\n", "utf-8")
    with labseq.Session.open(path, output=tmp_path) as session:
        run = session.run()
    assert [shot.row.success for shot in run.shots] == [None] * 2
    assert all(math.isnan(shot.row.filling_fraction) for shot in run.shots)
    assert [math.isnan(shot.filling_fraction) for shot in run.shots] == [True, True]
    assert all("not judged" not in line and "defect" not in line for line in Summary.of(run).as_text())
    assert any("on the first image" in line for line in Summary.of(run).as_text())
    assert run.shots[0].row.measured.keys() == {"survival:before,after"}
    assert "survival:before,after" in shot_table(shot_rows(run, run.shots))[0]
    overview(run).save(tmp_path / "overview.png")
    save_shot(tmp_path / "shot.png", shot_picture(run, 0))

    path.write_text(path.read_text("utf-8").replace("{wait:", "{rearrange: {}}, {wait:"), "utf-8")
    with pytest.raises(labseq.ConfigError, match=r"5:.*'rearrange' needs a target"):
        labseq.Session.open(path)


def test_average_image_loading_map_and_counts_of_any_run(
    run: labseq.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "labseq.pictures.figures.encode_figure", lambda draw, *_, **__: bool(draw()) * b"drawn"
    )
    values, n = loading_map(run.shots)
    np.testing.assert_array_equal(values, np.mean([shot.occupancies[0] for shot in run.shots], axis=0))
    signals, thresholds, unit = signals_of(run.shots, image=-1)
    np.testing.assert_array_equal(signals > thresholds, [shot.occupancies[-1] for shot in run.shots])
    assert (n, unit) == (2, "counts")
    for what in ("loading", "counts"):
        picture_of(run, what).save(tmp_path / f"{what}.png")
    with pytest.raises(labseq.ConfigError) as caught:
        picture_of(run, "image")
    assert str(caught.value).startswith(f"{run.path}: ")
    assert "--set record_frames=all" in str(caught.value)

    kept = write(tmp_path, make_shot(0), make_shot(1))
    mean, n = average_frame(kept.shots, image=1)
    np.testing.assert_array_equal(mean, np.mean([shot.frames[1] for shot in kept.shots], axis=0))
    picture_of(kept, "image").save(tmp_path / "image.png")


def test_a_file_that_is_open_in_h5py_can_be_read(run: labseq.Run) -> None:
    shot = labseq.open_run(run.path).shots[0]
    with h5py.File(shot.file) as file:
        there: Any = file["entry/detection/occupancy"]
        assert np.array_equal(shot.occupancies, there[()])
