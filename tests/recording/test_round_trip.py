"""What is written comes back, whatever it is."""

from __future__ import annotations

import dataclasses
import itertools
import re
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from labseq.data.images import average_frame
from labseq.data.reader import open_run
from labseq.errors import RecordingError
from labseq.messages import install_hint
from labseq.model import (
    CALIBRATION_KINDS,
    CycleRecord,
    Frame,
    ImageRecord,
    Plan,
    PlanReport,
    ShotRecord,
    StageTiming,
    TargetPattern,
)
from labseq.plain import dumps
from labseq.recording.writer import RunWriter

from .records import assert_same, make_run, make_shot, write

text = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=20)
small = st.integers(0, 2**31 - 1)
real = st.floats(allow_nan=True, allow_infinity=True)
finite = st.floats(allow_nan=False, allow_infinity=False)
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | finite | text,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(text, inner, max_size=3),
    max_leaves=5,
)
values = st.dictionaries(text, plain, max_size=3)


def arrays(dtype: Any, shape: tuple[int, ...]) -> st.SearchStrategy[Any]:
    return hnp.arrays(dtype, shape)


@st.composite
def images(draw: st.DrawFn, shape: tuple[int, int]) -> ImageRecord:
    frame_shape = draw(st.sampled_from([(3, 4), (3, 4), (2, 1), (0, 3)]))
    pixels = arrays(np.uint16, frame_shape)
    frame = st.none() | st.builds(Frame, pixels, finite, finite, st.sampled_from(["camera", "", "a/b", "日"]))
    return ImageRecord(
        draw(frame),
        draw(arrays(np.bool_, shape)),
        draw(arrays(np.float32, shape)),
        draw(small),
        draw(st.integers(0, 99)),
        draw(real),
        draw(real),
        draw(text),
        draw(arrays(np.float64, shape)),
    )


@st.composite
def cycles(draw: st.DrawFn, shape: tuple[int, int]) -> CycleRecord:
    sizes = draw(st.lists(st.integers(0, 3), max_size=4))
    n = len(sizes)
    shape_of_paths = st.just((0, 0, 0)) | st.tuples(st.integers(1, 3), st.integers(1, 2), st.integers(1, 2))
    shapes = np.array(draw(st.lists(shape_of_paths, min_size=n, max_size=n)), np.int32).reshape(n, 3)
    n_tones = shapes[:, 1] + shapes[:, 2]
    plan = Plan(
        draw(arrays(np.int16, (sum(sizes), 4))),
        np.cumsum([0, *sizes], dtype=np.int32),
        draw(arrays(np.bool_, (n,))),
        shapes,
        draw(arrays(np.float64, (int(shapes[:, 0] @ n_tones),))),
        draw(arrays(np.int32, (int(n_tones.sum()),))),
    )
    report = PlanReport(
        draw(arrays(np.bool_, shape)),
        draw(arrays(np.float64, (n,))),
        draw(arrays(np.int32, (n,))),
        draw(small),
        draw(small),
    )
    played = draw(st.integers(0, n))
    return CycleRecord(draw(small), draw(small), plan, report, played, draw(real), draw(real), draw(real))


@st.composite
def shots(draw: st.DrawFn, shape: tuple[int, int]) -> ShotRecord:
    timing = st.builds(StageTiming, text, small, small, real, real, real, real)
    return ShotRecord(
        shot_index=draw(st.integers(0, 999)),
        attempt=draw(st.integers(0, 3)),
        seed=draw(st.integers(0, 2**128)),
        t_start_utc=draw(text),
        t_end_utc=draw(text),
        status=draw(st.sampled_from(["complete", "interrupted", "failed"])),
        error=draw(text),
        images=draw(st.lists(images(shape), max_size=3)),
        cycles=draw(st.lists(cycles(shape), max_size=3)),
        timing=draw(st.lists(timing, max_size=3)),
        seen_defect_free_cycle=draw(small),
        success=draw(st.booleans()),
        filling_fraction=draw(st.floats(0, 1) | st.just(float("nan"))),
        n_missing_atoms=draw(small),
        readings=draw(values),
        parameters=draw(values),
        calibrations=draw(st.dictionaries(st.sampled_from(list[str](CALIBRATION_KINDS)), text)),
        thresholds=draw(arrays(np.float64, shape)),
        sites_px=draw(arrays(np.float64, (*shape, 2))),
        signal_unit=draw(text),
    )


@st.composite
def runs_and_shots(draw: st.DrawFn) -> tuple[dict[str, Any], ShotRecord]:
    shape = draw(st.tuples(st.integers(1, 4), st.integers(1, 4)))
    fill = draw(arrays(np.bool_, shape))
    target = TargetPattern(fill, draw(arrays(np.bool_, shape)) & ~fill, draw(text))
    changes = {
        "name": draw(text),
        "target": target,
        "sequence_text": draw(text),
        "resolved": draw(values),
        "devices": draw(st.dictionaries(text, values, max_size=3)),
        "provenance": draw(values),
    }
    return changes, draw(shots(shape))


folder_number = itertools.count()


@settings(deadline=None, max_examples=12, suppress_health_check=[HealthCheck.too_slow])
@given(runs_and_shots())
def test_every_record_comes_back(
    tmp_path_factory: pytest.TempPathFactory, drawn: tuple[dict[str, Any], ShotRecord]
) -> None:
    changes, shot = drawn
    record = make_run(**changes)
    writer = RunWriter.create(tmp_path_factory.getbasetemp() / f"run{next(folder_number)}", record)
    row = writer.write_shot(shot)
    writer.finish("complete")
    run = open_run(writer.run_dir)
    (found,) = run.shots if shot.status == "complete" else run.attempts
    found.verify()
    assert dumps(found.row) == dumps(row)
    assert_same(found.record(), shot)
    assert_same(run.target, record.target)
    assert run.record["resolved"] == record.resolved
    assert (writer.run_dir / "sequence.yaml").read_bytes().decode() == record.sequence_text


def test_a_rich_shot_comes_back_by_every_door(tmp_path: Path) -> None:
    shot = make_shot(seed=2**100)
    (found,) = write(tmp_path, shot).shots
    assert_same(found.record(), shot)
    assert_same(found.frames, np.stack([i.frame.image for i in shot.images if i.frame]))
    assert_same(found.occupancies, np.stack([i.occupancy for i in shot.images]))
    assert_same(found.confidences, np.stack([i.confidence for i in shot.images]))
    assert_same(found.plans, tuple(cycle.plan for cycle in shot.cycles))
    assert_same(found.cycles, tuple(shot.cycles))
    assert_same(found.timing, tuple(shot.timing))
    assert found.parameters == shot.parameters
    assert found.readings == shot.readings
    assert found.calibrations == shot.calibrations
    assert found.provenance["packages"] == {"numpy": "2"}
    assert found.provenance["none"] is None
    assert found.provenance["resolved"] == make_run().resolved
    assert found.provenance["git_dirty"] is True
    assert found.devices["camera"] == {"model": "EMCCD"}


def test_values_that_json_lacks_become_null(tmp_path: Path) -> None:
    readings = {"power_w": float("nan"), "spectrum": np.array([1.0, np.inf]), "n": np.int16(3)}
    (found,) = write(tmp_path, make_shot(readings=readings, parameters={3: np.float32(0.5)})).shots
    assert found.readings == {"power_w": None, "spectrum": [1.0, None], "n": 3}
    assert found.parameters == {"3": 0.5}
    assert found.row.parameters == {"3": 0.5}


def test_text_that_hdf5_refuses_is_escaped(tmp_path: Path) -> None:
    (found,) = write(
        tmp_path,
        make_shot(error="a\0b\udc80", status="failed"),
        provenance={"user": "a\udc80", "log": "x\0" * 400},
    ).attempts
    assert found.record().error == "a\\x00b\\udc80"
    assert found.provenance["user"] == "a\udc80"


@pytest.mark.parametrize(("record_frames", "kept"), [("last", [2]), ("none", [])])
def test_frames_that_are_not_kept_are_none(tmp_path: Path, record_frames: str, kept: list[int]) -> None:
    shot = make_shot()
    (found,) = write(tmp_path, shot, record_frames=record_frames).shots
    images = [
        image if i in kept else dataclasses.replace(image, frame=None) for i, image in enumerate(shot.images)
    ]
    assert_same(found.record(), dataclasses.replace(shot, images=images))
    assert len(found.frames) == len(kept)


@pytest.mark.needs("hdf5plugin")
def test_frames_that_were_compressed_later_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import hdf5plugin

    shot = make_shot()
    (found,) = write(tmp_path, shot).shots
    with h5py.File(found.file, "r+") as file:
        camera: Any = file["entry/camera/camera"]
        frames = camera["frames"][()]
        del camera["frames"]
        camera.create_dataset("frames", data=frames, **hdf5plugin.Bitshuffle(cname="lz4"))
    assert_same(found.record(), shot)
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(
        RecordingError, match=re.escape(f"need hdf5plugin to be read; {install_hint('compress')}")
    ):
        _ = found.frames


def test_frames_of_several_sizes_are_given_one_by_one(tmp_path: Path) -> None:
    shot = make_shot()
    shot.images[1] = dataclasses.replace(shot.images[1], frame=Frame(np.ones((2, 3), np.uint16), 0.1, 0.2))
    (found,) = write(tmp_path, shot).shots
    with pytest.raises(RecordingError, match="several sizes"):
        _ = found.frames
    assert_same(found.record(), shot)


def test_frames_of_another_size_are_left_out_of_an_average(tmp_path: Path) -> None:
    other = Frame(np.ones((2, 3), np.uint16), 0.1, 0.2)
    shots = [make_shot(index, n_images=1) for index in range(3)]
    shots[1].images[0] = dataclasses.replace(shots[1].images[0], frame=other)
    average, n = average_frame(write(tmp_path, *shots).shots)
    frames = [shot.images[0].frame for shot in (shots[0], shots[2])]
    assert n == 2
    assert np.array_equal(average, np.mean([frame.image for frame in frames if frame], axis=0))
