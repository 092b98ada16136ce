"""Frames in files, which are runs of labseq, TIFF stacks, PNG files, arrays of numpy and HDF5."""

from __future__ import annotations

import difflib
import importlib
import logging
import re
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import ConfigError, Problem
from labseq.plugin.arrays import ARRAY_FILES, opened_array, split_name
from labseq.plugin.messages import install_hint
from labseq.plugin.runs import RecordingError, Run, open_run

PNG: Final[tuple[str, ...]] = (".png",)
TIFF: Final[tuple[str, ...]] = (".tif", ".tiff")
IN_FOLDERS: Final = (*PNG, *TIFF, ".npy")
EXPECTED: Final = (
    "a run's folder, a TIFF stack, a .npy file, a dataset such as file.h5:Andor/Pictures, "
    "or a folder of PNG, TIFF or .npy files"
)
COUNTS: Final = "counts from 0 to 65535, as the camera gave them"

_KINDS: Final = dict.fromkeys(PNG, "PNG") | dict.fromkeys(TIFF, "TIFF") | dict.fromkeys(ARRAY_FILES, "array")

PNG_KINDS: Final = {
    "1": "1 bit gray",
    "LA": "gray with transparency",
    "P": "palette colour",
    "RGB": "colour",
    "RGBA": "colour with transparency",
}
"""Pictures in PNG files that are not gray, by Pillow's mode."""

_LOG = logging.getLogger("tifffile")
_LOG.addHandler(logging.NullHandler())  # we report what it logs about damaged files


class BadFramesError(Exception):
    """Files that cannot be played. The camera turns it into an error of labseq.

    Attributes:
        problem: The file or folder with its fault, and perhaps what was expected and what to do.
    """

    def __init__(self, path: Path | str, what: str, expected: str = "", hint: str = "") -> None:
        self.problem = Problem(what, str(path), expected=expected, hint=hint)
        super().__init__(str(self.problem))


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A frame in a file.

    Attributes:
        image: uint16 (height, width), in camera counts (ADU), pixel (y, x).
        place: File and place in it, for messages.
        exposure_s: Exposure time, in seconds, None if the file does not contain it.
        t_start_s: Start of the exposure on the clock of its own session, in seconds, or None.
    """

    image: NDArray[np.uint16]
    place: str
    exposure_s: float | None = None
    t_start_s: float | None = None


@dataclass(frozen=True, slots=True)
class Source:
    """Files that were found and checked.

    Attributes:
        pictures: Starts to read all frames in order, one at a time. Closing the generator closes its file.
            Raises BadFramesError if a file is damaged or contains something else.
        about: Kind and number of files, as JSON-ready values.
    """

    pictures: Callable[[], Generator[Picture]]
    about: Mapping[str, Any]


def find_source(path: Path, images: Literal["all", "first"] = "all") -> Source:
    """Find the frames at a path, and check the header of each file.

    Args:
        path: A run's folder, a TIFF stack, a PNG, an array of numpy or HDF5, a folder of files, or a pattern.
        images: Which frames of a run.

    Raises:
        BadFramesError: There are no frames, or files of the wrong kind.
    """
    try:
        source = _find(path, images)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadFramesError(path, f"cannot be read: {reason}", hint="check path and rights") from error
    if images == "first" and source.about["source"] != "run":
        hint = "leave `images` out, or give a run's folder"
        raise BadFramesError(path, "is not a run, so that `images: first` has no meaning", hint=hint)
    return source


def _find(address: Path, images: Literal["all", "first"]) -> Source:
    path, name = split_name(address)
    if path.is_dir():
        return _in_folder(path, images)
    if path.is_file():
        return _of_kind(path, [path], name)
    if path.exists():
        raise BadFramesError(path, "is neither a file nor a folder", EXPECTED)
    if re.search(r"[*?\[]", str(path)):
        return _of_kind(path, _matching(path), name)
    names = [sibling.name for sibling in path.parent.iterdir()] if path.parent.is_dir() else []
    similar = difflib.get_close_matches(path.name, names, n=1)
    hint = f"did you mean '{similar[0]}'?" if similar else "check `path`, which is relative to the profile"
    raise BadFramesError(path, "no such file or folder", EXPECTED, hint)


def _in_folder(folder: Path, images: Literal["all", "first"]) -> Source:
    """A run, or the pictures in a folder. The folder of a run may contain pictures, too."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in IN_FOLDERS]
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    if files and not (folder / "run.json").is_file():
        return _of_kind(folder, files)
    try:
        return run_source(open_run(folder), images)
    except RecordingError as error:
        reason = str(error).removeprefix(f"{error.path}: ")
        if files or error.path != str(folder.resolve()):
            raise BadFramesError(Path(error.path), reason) from error
        raise BadFramesError(folder, f"holds no PNG, TIFF or .npy files, and {reason}") from error


def _matching(path: Path) -> list[Path]:
    """The files that match a pattern. Brackets in the names of existing folders are not a pattern."""
    root, pattern = path.parent, path.name
    while not root.is_dir():
        root, pattern = root.parent, f"{root.name}/{pattern}"
    try:
        files = [file for file in root.glob(pattern) if file.is_file()]
    except (ValueError, NotImplementedError) as error:
        raise BadFramesError(
            path, f"is not a pattern: {str(error).lower()}", "one like frames/*.png"
        ) from error
    if not files:
        raise BadFramesError(path, f"no file in {root} matches", hint="check the pattern")
    return files


def _of_kind(path: Path, files: Sequence[Path], name: str = "") -> Source:
    """The frames of files of one kind. ``name`` selects an array."""
    files = sorted(files, key=natural)
    kinds = {file: _KINDS.get(file.suffix.lower()) for file in files}
    if other := next((file for file, kind in kinds.items() if kind is None), None):
        raise BadFramesError(other, "is neither a TIFF nor a PNG, nor a file of arrays", EXPECTED)
    counts = Counter(kinds.values())
    if len(counts) > 1:
        text = "contains " + " and ".join(f"{n} {kind}" for kind, n in counts.items()) + " files"
        raise BadFramesError(path, text, "files of one kind", f"give a pattern such as *{files[0].suffix}")
    match kinds[files[0]]:
        case "PNG":
            return png_source(files)
        case "TIFF":
            return tiff_source(files)
        case _:
            return array_source(files, name)


def natural(path: Path) -> tuple[list[str | int], str]:
    """Key that sorts numbers in names by their value.

    Example:
        >>> [p.name for p in sorted(map(Path, ["x10.png", "x9.png", "x1.png"]), key=natural)]
        ['x1.png', 'x9.png', 'x10.png']
    """
    words = re.split(r"(\d+)", str(path))  # every second one is a number
    return [int(word) if i % 2 else word for i, word in enumerate(words)], str(path)


def load(package: str, name: str, path: Path) -> Any:
    """Import a package that reads files of a kind, such as ``path``.

    Raises:
        BadFramesError: It is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        text = f"reading it needs {name}, which cannot be imported ({error})"
        raise BadFramesError(path, text, hint=f"install it with {install_hint('frames')}") from error


def format_shape(shape: tuple[int, ...]) -> str:
    """A shape as text.

    Example:
        >>> format_shape((512, 256))
        '512 x 256'
    """
    return " x ".join(map(str, shape))


def _check_shape(file: Path, shape: tuple[int, ...], first: Path, expected: tuple[int, ...]) -> None:
    if shape != expected:
        text = f"its frames have {format_shape(shape)} pixels, but {first.name} has {format_shape(expected)}"
        raise BadFramesError(file, text, "frames of one size", "play frames of one size at a time")


def _counts(pixels: NDArray[Any], place: str) -> NDArray[np.uint16]:
    """The counts of a frame of integers, without scaling or clipping.

    Raises:
        BadFramesError: They do not fit into 16 bits.
    """
    if not np.can_cast(pixels.dtype, np.uint16):
        low, high = int(pixels.min(initial=0)), int(pixels.max(initial=0))
        if low < 0 or high > 65535:
            what = f"the frame has counts from {low} to {high}"
            raise BadFramesError(place, what, COUNTS, "save frames from which nothing is subtracted")
    return np.array(pixels, np.uint16, order="C")  # a copy, as the pixels of a .npy file are on the disk


# runs


def run_source(run: Run, images: Literal["all", "first"]) -> Source:
    """The frames that a run of labseq recorded.

    Args:
        run: The run.
        images: All frames, or the first image of each shot.

    Raises:
        BadFramesError: The run is still being written, or recorded no frames.
    """
    if run.status == "running":
        raise BadFramesError(run.path, "the run is still being written", hint="wait until it has ended")
    if not run.shots:
        raise BadFramesError(run.path, "the run holds no complete shot", "a run with frames")
    if run.record.get("record_frames") == "none":
        text = "a run that was made with `record_frames: all`"
        raise BadFramesError(run.path, "the run holds no frames", text)
    about = {"source": "run", "run_id": str(run.record.get("run_id", "")), "n_shots": len(run.shots)}
    return Source(lambda: _run_pictures(run, first_only=images == "first"), about)


def _run_pictures(run: Run, *, first_only: bool) -> Generator[Picture]:
    """The frames shot by shot, without failed attempts."""
    for shot in run.shots:
        try:
            images = shot.record().images
        except RecordingError as error:
            raise BadFramesError(Path(error.path), str(error).removeprefix(f"{error.path}: ")) from error
        for i, image in enumerate(images[:1] if first_only else images):
            frame = image.frame
            if frame is not None:
                yield Picture(frame.image, f"{shot.file}, image {i}", frame.exposure_s, frame.t_start_s)
            elif first_only:
                hint = "record with `record_frames: all`, or set `images: all` to play the other frames"
                raise BadFramesError(shot.file, "the first image of the shot was not kept", hint=hint)


# PNG files


def png_source(files: Sequence[Path]) -> Source:
    """One frame from each PNG file, 8 or 16 bit gray, read with Pillow.

    Args:
        files: In order, at least one.

    Raises:
        BadFramesError: A file is not a PNG, not gray, or of another size.
    """
    pillow = load("PIL.Image", "Pillow", files[0])
    expected = _png_shape(pillow, files[0])
    for file in files[1:]:
        _check_shape(file, _png_shape(pillow, file), files[0], expected)
    return Source(lambda: _png_pictures(pillow, files), {"source": "PNG", "n_files": len(files)})


def _png_pictures(pillow: Any, files: Sequence[Path]) -> Generator[Picture]:
    for file in files:
        with _opened_png(pillow, file) as opened:
            pixels = np.asarray(opened)
        yield Picture(_counts(pixels, str(file)), str(file))


def _png_shape(pillow: Any, file: Path) -> tuple[int, int]:
    """(height, width), from the header."""
    with _opened_png(pillow, file) as opened:
        mode, (width, height) = opened.mode, opened.size
    if mode not in ("L", "I;16", "I"):  # older versions of Pillow call 16 bit "I"
        text = f"the picture is {PNG_KINDS.get(mode, mode)}"
        hint = "save the camera's own counts, not a viewer's picture"
        raise BadFramesError(file, text, "8 or 16 bit gray", hint)
    return height, width


@contextmanager
def _opened_png(pillow: Any, file: Path) -> Generator[Any]:
    """An open picture. Only the header is read until the pixels are asked for."""
    try:
        with pillow.open(file, formats=["PNG"]) as opened:
            yield opened
    except pillow.UnidentifiedImageError as error:
        hint = "restore it from a backup, or leave it out"
        raise BadFramesError(file, "is not a PNG", hint=hint) from error
    except Exception as error:  # damaged data make it raise SyntaxError, OSError, ValueError, zlib.error ...
        raise BadFramesError(file, f"is damaged: {error}", hint="restore it from a backup") from error


# TIFF stacks


def tiff_source(files: Sequence[Path]) -> Source:
    """One frame from each page of each TIFF file, integers, read with tifffile one page at a time.

    Args:
        files: In order, at least one.

    Raises:
        BadFramesError: tifffile is missing, a file is not a TIFF, is cut off, or its first page does not hold
            integers, is not gray, or of another size.
    """
    tifffile = load("tifffile", "tifffile", files[0])
    n_pages = 0
    expected: tuple[int, ...] | None = None
    for file in files:
        with _opened_tiff(tifffile, file) as stack:
            shape = _tiff_shape(file, 0, stack.pages[0])
            expected = expected or shape
            _check_shape(file, shape, files[0], expected)
            n_pages += _count_pages(file, stack)
    about = {"source": "TIFF", "n_files": len(files), "n_frames": n_pages}
    return Source(lambda: _tiff_pictures(tifffile, files), about)


def _tiff_pictures(tifffile: Any, files: Sequence[Path]) -> Generator[Picture]:
    for file in files:
        with _opened_tiff(tifffile, file) as stack:
            for number, page in enumerate(stack.pages):
                _tiff_shape(file, number, page)
                place = f"{file}, page {number}"
                yield Picture(_counts(page.asarray(), place), place)


@contextmanager
def _opened_tiff(tifffile: Any, file: Path) -> Generator[Any]:
    try:
        with tifffile.TiffFile(file) as stack:
            yield stack
    except BadFramesError:
        raise
    except Exception as error:  # damaged data make it raise ValueError, zlib.error, struct.error ...
        raise BadFramesError(
            file, f"cannot be read as a TIFF: {error}", hint="restore it from a backup"
        ) from error


def _tiff_shape(file: Path, number: int, page: Any) -> tuple[int, int]:
    if page.dtype is None or page.dtype.kind not in "iu" or len(page.shape) != 2:
        text = f"page {number} is {page.dtype}, {format_shape(page.shape)}"
        hint = "save the camera's own counts, gray"
        raise BadFramesError(file, text, "integers, height x width", hint)
    return page.shape


def _count_pages(file: Path, stack: Any) -> int:
    """Number of pages. Refuses a file in which some are missing, which tifffile only logs."""
    messages: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: messages.append(record.getMessage())
    _LOG.addHandler(handler)
    try:
        n_pages = len(stack.pages)
    finally:
        _LOG.removeHandler(handler)
    if messages:
        text = f"is cut off or damaged after page {n_pages - 1} ({messages[0]})"
        raise BadFramesError(file, text, hint="restore it from a backup")
    if n_pages == 1 and stack.series[0].size > stack.pages[0].size:
        shape = format_shape(stack.series[0].shape)
        text = f"holds {shape} counts behind a single page, as large ImageJ stacks do"
        raise BadFramesError(file, text, "a page for each frame", "save it as BigTIFF, or in several files")
    return n_pages


# arrays of numpy and HDF5


def array_source(files: Sequence[Path], name: str = "") -> Source:
    """Frames in arrays of shape (n, height, width), or (height, width) for one.

    A frame at a time is read, except of .npz files, which cannot be read in parts.

    Args:
        files: In order, at least one.
        name: Which array of a .npz or HDF5 file, "" for the only one.

    Raises:
        BadFramesError: A file cannot be read, or its array holds no integers, or frames of another size.
    """
    n_frames = 0
    first: tuple[int, ...] = ()
    for file in files:
        with _opened_frames(file, name) as frames:
            first = first or frames.shape[-2:]
            _check_shape(file, frames.shape[-2:], files[0], first)
            n_frames += _n_frames(frames)
    about = {"source": "array", "n_files": len(files), "n_frames": n_frames}
    return Source(lambda: _array_pictures(files, name), about | ({"array": name} if name else {}))


def _array_pictures(files: Sequence[Path], name: str) -> Generator[Picture]:
    for file in files:
        with _opened_frames(file, name) as frames:
            for i in range(_n_frames(frames)):
                place = f"{file}, frame {i}"
                yield Picture(_counts(frames[i if frames.ndim == 3 else ...], place), place)


def _n_frames(frames: Any) -> int:
    return frames.shape[0] if frames.ndim == 3 else 1


@contextmanager
def _opened_frames(file: Path, name: str) -> Generator[Any]:
    try:
        with opened_array(file, name) as frames:
            if frames.dtype.kind not in "iu" or frames.ndim not in (2, 3):
                text = f"it holds {frames.dtype}, {format_shape(frames.shape)}"
                hint = "save the camera's own counts"
                raise BadFramesError(file, text, "integers, frames x height x width", hint)
            yield frames
    except ConfigError as error:
        (problem,) = error.problems
        raise BadFramesError(problem.source, problem.what, problem.expected, problem.hint) from error
