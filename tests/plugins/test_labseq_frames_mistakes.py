"""Errors of files to be played, and their messages."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given, strategies as st
from labseq_frames.camera import FramesCamera, FramesSettings
from labseq_frames.files import natural
from PIL import Image

from labseq.plugin import ConfigError, Context, DeviceError
from labseq.plugin.messages import install_hint
from labseq.testing.fakes import FakeClock

from .test_labseq_frames import stack_of, write_run


def pixels(height: int = 4, width: int = 6, dtype: str = "u2") -> Any:
    return np.arange(height * width).reshape(height, width).astype(dtype)


def camera_of(path: Path, **settings: Any) -> FramesCamera:
    given = FramesSettings.model_validate({"path": str(path), **settings})
    return FramesCamera(given, Context("camera", clock=FakeClock()))


def play(camera: FramesCamera, n_frames: int) -> None:
    camera.open()
    for _ in range(n_frames):
        camera.arm(1, 0.01, "software")
        camera.trigger()
        camera.read(1.0)


def refusal(path: Path, **settings: Any) -> str:
    """The message of open()."""
    camera = camera_of(path, **settings)
    with pytest.raises(ConfigError):
        camera.open()
    with pytest.raises(ConfigError) as caught:  # one that failed leaves nothing behind
        camera.open()
    assert caught.value.exit_code == 2
    assert str(caught.value).startswith("camera: ")
    camera.safe_state()
    camera.close()
    return str(caught.value)


def failure(path: Path, n_good: int, **settings: Any) -> str:
    """The message of trigger() after some good frames, twice."""
    camera = camera_of(path, **settings)
    play(camera, n_good)
    messages: set[str] = set()
    for _ in range(2):
        camera.arm(1, 0.01, "software")
        with pytest.raises(DeviceError) as caught:
            camera.trigger()
        messages.add(str(caught.value))
    camera.close()
    (message,) = messages
    return message


def recorded(
    root: Path, record_frames: str = "all", n_shots: int = 2, n_images: int = 2, **options: Any
) -> Path:
    return write_run(root, [stack_of(n_images)] * n_shots, record_frames=record_frames, **options)


def test_a_path_that_does_not_exist_is_named_with_one_like_it(tmp_path: Path) -> None:
    (tmp_path / "stack.tif").touch()
    text = refusal(tmp_path / "stak.tif")
    assert "stak.tif: no such file or folder" in text
    assert text.endswith("did you mean 'stack.tif'?")
    assert "`path`" in refusal(tmp_path / "a" / "b")
    assert f"no file in {tmp_path} matches" in refusal(tmp_path / "*.png")
    assert "no file in" in refusal(tmp_path / "nowhere" / "*.png")
    assert "is not a pattern" in refusal(tmp_path / "**x" / "*.png") or sys.version_info >= (3, 13)


def test_folders_and_files_that_hold_no_frames_are_refused(tmp_path: Path) -> None:
    run = recorded(tmp_path)
    assert refusal(tmp_path).endswith(f"for example {run}")
    (folder := tmp_path / "x").mkdir()
    (folder / "notes.txt").touch()
    assert "holds no PNG, TIFF or .npy files" in refusal(folder)
    (folder / "x.sif").touch()
    assert "x.sif: is neither a TIFF nor a PNG, nor a file of arrays" in refusal(folder / "x.sif")
    (folder / "x.tif").write_text("version https://git-lfs.github.com/spec/v1")
    assert "x.tif: cannot be read as a TIFF" in refusal(folder / "x.tif")
    tifffile.imwrite(folder / "x.tif", pixels())
    assert "x.tif: is not a run" in refusal(folder / "x.tif", images="first")
    Image.fromarray(pixels()).save(folder / "x.png")
    assert "1 PNG and 1 TIFF files" in refusal(folder)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes in folders")
def test_what_is_no_ordinary_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.tif")
    assert "is neither a file nor a folder" in refusal(tmp_path / "x.tif")


@pytest.mark.parametrize(
    ("mode", "message"),
    [("RGB", "is colour;"), ("RGBA", "is colour with transparency;"), ("1", "is 1 bit gray;")],
)
def test_a_png_that_is_not_gray_is_refused(tmp_path: Path, mode: str, message: str) -> None:
    Image.new(mode, (6, 4)).save(tmp_path / "x.png")
    text = refusal(tmp_path)
    assert "x.png: " in text
    assert f"{message} expected 8 or 16 bit gray" in text


def test_a_damaged_png_is_named(tmp_path: Path) -> None:
    for i in range(3):
        Image.fromarray(np.random.default_rng(i).integers(0, 9999, (40, 40)).astype("u2")).save(
            tmp_path / f"x{i}.png"
        )
    whole = (tmp_path / "x1.png").read_bytes()
    (tmp_path / "x1.png").write_bytes(whole[: len(whole) // 2])
    assert "x1.png: is damaged: " in failure(tmp_path, 1)
    assert "x1.png: is damaged: " in failure(tmp_path, 1, at_end="repeat")
    (tmp_path / "x1.png").write_bytes(b"\x89PNG")
    assert "x1.png: is not a PNG" in refusal(tmp_path)
    (tmp_path / "x1.png").write_bytes(whole[:100])
    assert "x1.png: is damaged: " in refusal(tmp_path / "x1.png")


@pytest.mark.parametrize(("dtype", "shape"), [("f4", (4, 6)), ("u2", (4, 6, 3))])
def test_a_stack_of_other_numbers_is_refused(tmp_path: Path, dtype: str, shape: tuple[int, ...]) -> None:
    tifffile.imwrite(tmp_path / "x.tif", np.zeros(shape, dtype), photometric="rgb" if shape[2:] else None)
    came = f"{np.dtype(dtype).name}, {' x '.join(map(str, shape))}"
    assert f"page 0 is {came}; expected integers, height x width" in refusal(tmp_path / "x.tif")


def test_counts_that_do_not_fit_are_refused_and_never_cut_off(tmp_path: Path) -> None:
    frames = np.stack([pixels(dtype="i4")] * 3)
    for value, counts in ((-1, "from -1 to 23"), (65536, "from 0 to 65536")):
        frames[2, 0, 0] = value
        np.save(tmp_path / "x.npy", frames)
        tifffile.imwrite(tmp_path / "x.tif", frames, photometric="minisblack")
        for file, place in (("x.npy", "x.npy, frame 2"), ("x.tif", "x.tif, page 2")):
            text = failure(tmp_path / file, 2)
            assert f"{place}: the frame has counts {counts}; expected counts from 0 to 65535" in text


def test_arrays_that_hold_no_frames_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["Andor/Pictures"], file["Andor/Mean"] = np.stack([pixels()] * 3), pixels(dtype="f8")
        file["Andor/Time"], file["Andor/Name"] = np.arange(3.0), "iXon"
    np.save(tmp_path / "x.npy", np.array([None]), allow_pickle=True)
    np.save(tmp_path / "y.npy", np.zeros((2, 2, 2, 2), "u2"))
    np.save(tmp_path / "z.npy", np.zeros((0, 4, 6), "u2"))
    for address, words in (
        (
            "x.h5",
            "x.h5: it holds 2 arrays; expected one of Andor/Mean (4, 6), Andor/Pictures (3, 4, 6); name one",
        ),
        ("x.h5:Andor/Picture", "holds no array 'Andor/Picture'; expected"),
        ("x.h5:Andor/Picture", "did you mean 'Andor/Pictures'?"),
        ("x.h5:Andor/Mean", "holds float64, 4 x 6; expected integers, frames x height x width"),
        ("x.npy", "expected an array of numbers, as numpy.save writes it"),
        ("y.npy", "holds uint16, 2 x 2 x 2 x 2"),
        ("z.npy", "holds no frames"),
        ("w.h5:Andor/Pictures", "w.h5: no such file or folder"),
    ):
        assert words in refusal(tmp_path / address)


def test_files_of_another_size_are_found_before_anything_is_played(tmp_path: Path) -> None:
    for i, height in enumerate((4, 4, 5)):
        Image.fromarray(pixels(height)).save(tmp_path / f"x{i}.png")
        tifffile.imwrite(tmp_path / f"x{i}.tif", pixels(height))
    for kind in ("png", "tif"):
        text = f"x2.{kind}: its frames have 5 x 6 pixels, but x0.{kind} has 4 x 6"
        assert text in refusal(tmp_path / f"*.{kind}")


def test_what_is_wrong_with_a_later_page_is_reported_when_it_comes(tmp_path: Path) -> None:
    for file, later, message in (
        ("size.tif", pixels(5), "page 2: the frame has 5 x 6 pixels, the first one 4 x 6"),
        ("dtype.tif", pixels(dtype="f4"), "page 2 is float32, 4 x 6; expected integers"),
    ):
        with tifffile.TiffWriter(tmp_path / file) as stack:
            for page in (pixels(), pixels(), later):
                stack.write(page, contiguous=False)
        assert message in failure(tmp_path / file, 2)


def test_a_stack_that_is_cut_off_never_counts_as_a_shorter_one(tmp_path: Path) -> None:
    file = tmp_path / "x.tif"
    tifffile.imwrite(file, np.stack([pixels(20, 20)] * 6), photometric="minisblack")
    whole = file.read_bytes()
    for length in range(0, len(whole), 193):
        file.write_bytes(whole[:length])
        camera = camera_of(file)
        with pytest.raises((ConfigError, DeviceError), match=r"x\.tif: (is cut off|cannot be read|holds)"):
            play(camera, 6)
        camera.close()


def test_a_stack_that_hides_its_frames_behind_one_page_is_refused(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "x.tif") as stack:
        stack.write(np.stack([pixels()] * 3), photometric="minisblack", truncate=True)
    text = refusal(tmp_path / "x.tif")
    assert all(fact in text for fact in ("3 x 4 x 6", "a single page", "BigTIFF"))


def test_a_run_without_its_frames_is_refused(tmp_path: Path) -> None:
    for record_frames, n_shots, n_images, ends, message in (
        ("all", 2, 2, False, "still being written"),
        ("none", 2, 2, True, "`record_frames: all`"),
        ("all", 0, 2, True, "no complete shot"),
        ("all", 2, 0, True, "holds no frames"),
    ):
        assert message in refusal(recorded(tmp_path, record_frames, n_shots, n_images, ends=ends))
    run = recorded(tmp_path, record_frames="last")
    assert "the first image of the shot was not kept" in refusal(run, images="first")
    camera_of(run).open()


def test_a_shot_that_is_damaged_or_gone_is_named(tmp_path: Path) -> None:
    run = recorded(tmp_path)
    second = sorted((run / "shots").iterdir())[1]
    whole = second.read_bytes()
    second.write_bytes(whole[: len(whole) // 2])
    assert f"{second}: is damaged: " in failure(run, 2)
    second.unlink()
    assert f"{second}: is missing" in failure(run, 2)
    (run / "run.json").write_text("{}")
    assert f"{run / 'run.json'}: is damaged" in refusal(run)


@pytest.mark.parametrize(
    ("module", "write", "name"),
    [
        ("tifffile", lambda file: tifffile.imwrite(file, pixels()), "x.tif"),
        ("PIL.Image", lambda file: Image.fromarray(pixels()).save(file), "x.png"),
    ],
)
def test_a_package_that_is_missing_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, write: Callable[[Path], None], name: str
) -> None:
    write(tmp_path / name)
    monkeypatch.setitem(sys.modules, module, None)
    assert refusal(tmp_path / name).endswith(f"install it with {install_hint('frames')}")


@given(st.lists(st.tuples(st.text("ab", max_size=2), st.integers(0, 10**6)), unique=True))
def test_numbers_in_names_count_as_numbers(names: list[tuple[str, int]]) -> None:
    files = [Path(f"x{number}_{word}.png") for word, number in names]
    by_hand = [Path(f"x{number}_{word}.png") for number, word in sorted((n, w) for w, n in names)]
    assert sorted(files, key=natural) == by_hand
