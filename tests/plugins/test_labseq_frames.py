"""The camera that plays back frames: the promises of a camera, and what is its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from labseq_frames.camera import FramesCamera, FramesSettings
from numpy.typing import NDArray
from PIL import Image

from labseq.model import ImageRecord, RunRecord, ShotRecord, TargetPattern
from labseq.plugin import ConfigError, Context, DeviceError, Frame
from labseq.recording.writer import RunWriter
from labseq.testing import CameraContract
from labseq.testing.fakes import FakeClock

UTC = "2026-11-20T10:00:00.000000+00:00"

Stack = NDArray[np.uint16]


def stack_of(n_frames: int, shape: tuple[int, int] = (4, 6)) -> Stack:
    """Frame k begins with the count 1000 k."""
    return (1000 * np.arange(n_frames)[:, None, None] + np.arange(np.prod(shape)).reshape(shape)).astype("u2")


def write_run(
    root: Path,
    frames_of_shots: Sequence[Stack],
    exposure_s: float = 0.01,
    record_frames: str = "all",
    ends: bool = True,
) -> Path:
    """A run with these frames; image i of shot k was taken at 100 k + i seconds."""
    sites = np.ones((1, 2), np.bool_)
    record: dict[Any, Any] = {**dict.fromkeys(RunRecord.__slots__)}
    record |= {"name": "earlier", "n_shots": len(frames_of_shots), "seed": 1, "simulated": True}
    record |= {
        "target": TargetPattern(sites, ~sites, "x"),
        "t_start_utc": UTC,
        "record_frames": record_frames,
    }
    record |= {"sequence_text": "", "profile_text": "", "grid_spacing_m": 5e-6, "lattice": "square"}
    record |= {"resolved": {}, "overrides": {}, "devices": {}, "plugins": (), "provenance": {}}
    record |= {"scan": {}, "steps": (), "units": {}}
    writer = RunWriter.create(root, RunRecord(**record))
    for k, pixels in enumerate(frames_of_shots):
        frames = [Frame(one, exposure_s, 100.0 * k + i, "emccd") for i, one in enumerate(pixels)]
        confidence = np.ones(sites.shape, np.float32)
        images = [ImageRecord(one, sites, confidence, 1, 0, 0.1, exposure_s) for one in frames]
        shot = ShotRecord(k, 0, 1, UTC)
        shot.images, shot.status, shot.t_end_utc = images, "complete", UTC
        writer.write_shot(shot)
    if ends:
        writer.finish("complete")
    return writer.run_dir


def write_pngs(folder: Path, frames: Stack) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, pixels in enumerate(frames):
        Image.fromarray(pixels).save(folder / f"frame{i}.png")
    return folder


def write_tiff(file: Path, frames: Stack, **options: Any) -> Path:
    tifffile.imwrite(file, frames, photometric="minisblack", **options)
    return file


class FilesContract(CameraContract):
    @pytest.fixture(scope="class")
    @classmethod
    def path(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        raise NotImplementedError

    @pytest.fixture
    def factory(self, path: Path) -> Callable[[Context], FramesCamera]:
        return partial(FramesCamera, FramesSettings(path=path))


class TestFramesOfARun(FilesContract):
    @pytest.fixture(scope="class")
    @classmethod
    def path(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_run(tmp_path_factory.mktemp("run"), [stack_of(3)] * 5)


class TestFramesOfAStack(FilesContract):
    @pytest.fixture(scope="class")
    @classmethod
    def path(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_tiff(tmp_path_factory.mktemp("stack") / "stack.tif", stack_of(12))


class TestFramesOfPngFiles(FilesContract):
    @pytest.fixture(scope="class")
    @classmethod
    def path(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_pngs(tmp_path_factory.mktemp("png"), stack_of(12))


del FilesContract  # it has no frames of its own


class Player:
    """A camera on a clock that costs no time."""

    def __init__(self, path: Path, **settings: Any) -> None:
        self.clock = FakeClock()
        given = FramesSettings.model_validate({"path": str(path), **settings})
        self.camera = FramesCamera(given, Context("imaging", clock=self.clock))

    def open(self) -> Player:
        self.camera.open()
        return self

    def take(self, exposure_s: float = 0.045) -> Frame:
        self.camera.arm(1, exposure_s, "software")
        self.camera.trigger()
        return self.camera.read(10.0)

    def firsts(self, n_frames: int) -> list[int]:
        """First count of each frame."""
        return [int(self.take().image[0, 0]) for _ in range(n_frames)]


def test_the_frames_of_a_run_come_shot_by_shot_or_only_the_first_of_each(tmp_path: Path) -> None:
    frames = stack_of(6)
    run = write_run(tmp_path, [frames[:3], frames[3:4], frames[4:]])
    assert Player(run).open().firsts(6) == [0, 1000, 2000, 3000, 4000, 5000]
    player = Player(run, images="first").open()
    assert player.firsts(3) == [0, 3000, 4000]
    with pytest.raises(DeviceError, match="all 3 frames"):
        player.take()


def test_a_frame_has_the_exposure_that_it_was_recorded_with(tmp_path: Path) -> None:
    player = Player(write_run(tmp_path, [stack_of(2)], exposure_s=0.02)).open()
    player.clock.sleep(5.0)
    frame = player.take(exposure_s=0.045)
    assert (frame.exposure_s, frame.t_start_s, frame.camera) == (0.02, 5.0, "imaging")
    assert player.clock.now() == pytest.approx(5.045)  # the session goes by the exposure that it asked for
    assert frame.image.dtype == np.uint16
    assert not frame.image.flags.writeable


def test_time_stamps_may_be_those_of_the_recording(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", [stack_of(2), stack_of(1)])
    player = Player(run, time_stamps="recorded").open()
    assert [player.take().t_start_s for _ in range(3)] == [0.0, 1.0, 100.0]
    unknown = Player(write_tiff(tmp_path / "x.tif", stack_of(1)), time_stamps="recorded").open()
    unknown.clock.sleep(3.0)
    frame = unknown.take(exposure_s=0.3)
    assert (frame.t_start_s, frame.exposure_s) == (3.0, 0.3)


def test_with_the_internal_trigger_each_reading_takes_a_frame(tmp_path: Path) -> None:
    player = Player(write_tiff(tmp_path / "x.tif", stack_of(3)), readout="5 ms").open()
    player.clock.sleep(1.0)
    player.camera.arm(3, 0.045, "internal")
    frames = [player.camera.read(1.0) for _ in range(2)]
    assert [int(frame.image[0, 0]) for frame in frames] == [0, 1000]
    assert [frame.t_start_s for frame in frames] == pytest.approx([1.0, 1.05])
    assert [frame.number for frame in frames] == [0, 1]
    assert player.clock.now() == pytest.approx(1.1)
    assert player.firsts(1) == [2000]  # the third was not taken from the file
    player.camera.arm(1, 0.045, "internal")
    with pytest.raises(DeviceError, match="all 3 frames"):
        player.camera.read(1.0)


def test_files_are_played_in_the_natural_order_of_their_names(tmp_path: Path) -> None:
    folder = write_pngs(tmp_path / "10 [old] frames", stack_of(12))
    assert Player(folder).open().firsts(12) == [1000 * i for i in range(12)]
    assert Player(folder / "frame1*.png").open().firsts(3) == [1000, 10000, 11000]
    assert Player(folder / "frame7.png").open().firsts(1) == [7000]
    assert Player(tmp_path / "*" / "frame7.png").open().firsts(1) == [7000]


def test_several_stacks_are_played_one_after_the_other(tmp_path: Path) -> None:
    frames = stack_of(5)
    write_tiff(tmp_path / "x9.tif", frames[:2])
    write_tiff(tmp_path / "x10.TIFF", frames[2:], compression="zlib")
    (tmp_path / "notes.txt").write_text("not a frame")
    (tmp_path / "._x1.tif").write_text("what some systems leave beside a file")
    assert Player(tmp_path).open().firsts(5) == [0, 1000, 2000, 3000, 4000]


@pytest.mark.parametrize(
    "options", [{"imagej": True}, {"bigtiff": True}, {"byteorder": ">"}, {"tile": (16, 16)}]
)
def test_stacks_of_many_kinds_give_the_same_counts(tmp_path: Path, options: dict[str, Any]) -> None:
    frames = stack_of(3, (20, 30))
    file = tmp_path / "x.tif"
    tifffile.imwrite(
        file, frames, **({} if "imagej" in options else {"photometric": "minisblack"}), **options
    )
    player = Player(file).open()
    assert all(np.array_equal(player.take().image, pixels) for pixels in frames)


@pytest.mark.parametrize("dtype", ["u1", "i1", ">u2", "i2", "i4", "u8", "i8"])
def test_arrays_and_pictures_of_any_integers_that_fit_give_the_same_counts(
    tmp_path: Path, dtype: str
) -> None:
    frames = np.random.default_rng(1).integers(0, 128, (4, 20, 30)).astype(dtype)
    np.save(tmp_path / "x.npy", np.asarray(frames, order="F"))
    np.savez(tmp_path / "x.npz", pictures=frames, time=np.arange(4))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.create_dataset("Andor/Pictures", data=frames, chunks=True, compression="gzip")
    tifffile.imwrite(tmp_path / "x.tif", frames, photometric="minisblack")
    paths = ["x.npy", "x.npz:pictures", "x.h5", "x.h5:Andor/Pictures", "*.h5:Andor/Pictures", "x.tif"]
    if dtype == "u1":
        for i, pixels in enumerate(frames):
            Image.fromarray(pixels).save(tmp_path / f"x{i}.png")
        paths.append("x*.png")
    for path in paths:
        player = Player(tmp_path / path).open()
        for pixels in frames:
            image = player.take().image
            assert (image.dtype, image.flags.owndata) == (np.uint16, True)
            np.testing.assert_array_equal(image, pixels, path)
        player.camera.close()


def test_a_folder_of_arrays_is_played_in_the_natural_order(tmp_path: Path) -> None:
    for i, pixels in enumerate(stack_of(11)):
        np.save(tmp_path / f"shot{i}.npy", pixels)
    assert Player(tmp_path).open().firsts(11) == [1000 * i for i in range(11)]


def test_after_the_last_frame_the_run_ends_or_begins_again(tmp_path: Path) -> None:
    file = write_tiff(tmp_path / "x.tif", stack_of(3))
    player = Player(file).open()
    player.firsts(3)
    for _ in range(2):
        with pytest.raises(DeviceError, match=r"^imaging: all 3 frames of .*x.tif .*at_end: repeat"):
            player.take()
    assert Player(file, at_end="repeat").open().firsts(7) == [0, 1000, 2000, 0, 1000, 2000, 0]


def test_a_camera_that_was_closed_begins_with_the_first_frame(tmp_path: Path) -> None:
    player = Player(write_tiff(tmp_path / "x.tif", stack_of(3))).open()
    assert player.firsts(2) == [0, 1000]
    player.camera.open()  # it is open: nothing happens
    assert player.firsts(1) == [2000]
    player.camera.close()
    assert player.open().firsts(3) == [0, 1000, 2000]


def test_the_size_of_the_frames_is_known_before_they_are_opened(tmp_path: Path) -> None:
    for path in (
        write_run(tmp_path / "run", [stack_of(2, (5, 7))]),
        write_tiff(tmp_path / "x.tif", stack_of(2, (5, 7))),
        write_pngs(tmp_path / "png", stack_of(2, (5, 7))),
    ):
        facts = Player(path, readout="5 ms").camera.facts
        assert (facts.frame_shape, facts.readout_s) == ((5, 7), 5e-3)
    player = Player(tmp_path / "later.tif")
    assert player.camera.facts.frame_shape is None
    with pytest.raises(ConfigError, match="no such file"):
        player.open()
