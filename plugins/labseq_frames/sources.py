"""Where frames come from: which files, and in which order."""

from __future__ import annotations

import difflib
import re
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from labseq.plugin import RecordingError, Run, open_run
from labseq_frames.picture import BadFramesError, Picture
from labseq_frames.png import PngFiles
from labseq_frames.tiff import TiffFiles

_PNG: Final = (".png",)
_TIFF: Final = (".tif", ".tiff")
_WILD: Final = re.compile(r"[*?\[]")
_EXPECTED: Final = "a run's folder, a TIFF stack, or a folder of PNG or TIFF files"


class Source(Protocol):
    """Frames in files that were found and looked at."""

    def pictures(self) -> Generator[Picture]:
        """All frames in order, each read when it is asked for; closing the generator closes its file.

        Raises:
            BadFramesError: A file is damaged, or holds something else.
        """
        ...

    def describe(self) -> Mapping[str, Any]:
        """What it is: JSON-ready values."""
        ...


def find_source(path: Path, images: Literal["all", "first"] = "all") -> Source:
    """Find the frames that a path means, and look at the head of each file.

    Args:
        path: A run's folder, a TIFF stack, a PNG, a folder of either, or a pattern for files.
        images: Which frames of a run.

    Raises:
        BadFramesError: There is nothing to play, or something of the wrong kind.
    """
    try:
        source = _find(path, images)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadFramesError(path, f"cannot be read: {reason}", hint="check path and rights") from error
    if images == "first" and not isinstance(source, RecordedRun):
        hint = "leave `images` out, or give a run's folder"
        raise BadFramesError(path, "is no run, so that `images: first` has no meaning", hint=hint)
    return source


def _find(path: Path, images: Literal["all", "first"]) -> Source:
    if path.is_dir():
        return _in_folder(path, images)
    if path.is_file():
        return _of_kind(path, [path])
    if not path.exists() and _WILD.search(str(path)):
        return _of_kind(path, _matching(path))
    if path.exists():
        raise BadFramesError(path, "is neither a file nor a folder", _EXPECTED)
    names = [beside.name for beside in path.parent.iterdir()] if path.parent.is_dir() else []
    alike = difflib.get_close_matches(path.name, names, n=1)
    hint = f"did you mean '{alike[0]}'?" if alike else "check `path`; it is relative to the profile"
    raise BadFramesError(path, "no such file or folder", _EXPECTED, hint)


def _in_folder(folder: Path, images: Literal["all", "first"]) -> Source:
    """A run, or the pictures that lie in a folder; a run may have pictures beside it."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in (*_PNG, *_TIFF)]
    files = [file for file in files if file.is_file() and not file.name.startswith(".")]
    if files and not (folder / "run.json").is_file():
        return _of_kind(folder, files)
    try:
        return RecordedRun(open_run(folder), images)
    except RecordingError as error:
        reason = str(error).removeprefix(f"{error.path}: ")
        if files or error.path != str(folder.resolve()):
            raise BadFramesError(Path(error.path), reason) from error
        raise BadFramesError(folder, f"holds no PNG or TIFF files, and {reason}") from error


def _matching(path: Path) -> list[Path]:
    """The files that a pattern means; brackets in the names of existing folders are no pattern."""
    root, pattern = path.parent, path.name
    while not root.is_dir():
        root, pattern = root.parent, f"{root.name}/{pattern}"
    try:
        files = [file for file in root.glob(pattern) if file.is_file()]
    except (ValueError, NotImplementedError) as error:
        raise BadFramesError(path, f"is no pattern: {str(error).lower()}", "one like frames/*.png") from error
    if not files:
        raise BadFramesError(path, f"no file in {root} matches", hint="check the pattern")
    return files


def _of_kind(path: Path, files: Sequence[Path]) -> Source:
    files = sorted(files, key=natural)
    found = {kind: [f for f in files if f.suffix.lower() in kind] for kind in (_PNG, _TIFF)}
    others = [file for file in files if file.suffix.lower() not in (*_PNG, *_TIFF)]
    if others:
        raise BadFramesError(others[0], "is neither a TIFF nor a PNG", _EXPECTED)
    if found[_PNG] and found[_TIFF]:
        text = f"means {len(found[_PNG])} PNG and {len(found[_TIFF])} TIFF files"
        raise BadFramesError(path, text, "files of one kind", "give a pattern such as *.png")
    return PngFiles(found[_PNG]) if found[_PNG] else TiffFiles(found[_TIFF])


def natural(path: Path) -> tuple[list[str | int], str]:
    """Sorts names as a person does.

    Example:
        >>> [p.name for p in sorted(map(Path, ["x10.png", "x9.png", "x1.png"]), key=natural)]
        ['x1.png', 'x9.png', 'x10.png']
    """
    words = re.split(r"(\d+)", str(path))  # odd ones are numbers
    return [int(word) if i % 2 else word for i, word in enumerate(words)], str(path)


class RecordedRun:
    """The frames that a run of labseq kept.

    Args:
        run: The run.
        images: All frames, or the first image of each shot.

    Raises:
        BadFramesError: It is being written, or has kept no frames.
    """

    def __init__(self, run: Run, images: Literal["all", "first"]) -> None:
        self._run = run
        self._first_only = images == "first"
        if run.status == "running":
            raise BadFramesError(run.path, "the run is still being written", hint="wait until it has ended")
        if not run.shots:
            raise BadFramesError(run.path, "the run holds no complete shot", "one with frames")
        if run.record.get("record_frames") == "none":
            raise BadFramesError(
                run.path, "the run holds no frames", "one that was made with `record_frames: all`"
            )

    def pictures(self) -> Generator[Picture]:
        """Shot by shot; failed attempts are left out."""
        for shot in self._run.shots:
            try:
                images = shot.record().images
            except RecordingError as error:
                reason = str(error).removeprefix(f"{error.path}: ")
                raise BadFramesError(Path(error.path), reason) from error
            for i, image in enumerate(images[:1] if self._first_only else images):
                frame = image.frame
                if frame is not None:
                    yield Picture(frame.image, f"{shot.file}, image {i}", frame.exposure_s, frame.t_start_s)
                elif self._first_only:
                    text = "the first image of the shot was not kept"
                    hint = "record with `record_frames: all`, or set `images: all` to play what was kept"
                    raise BadFramesError(shot.file, text, hint=hint)

    def describe(self) -> Mapping[str, Any]:
        """Which run."""
        return {
            "source": "run",
            "run_id": str(self._run.record.get("run_id", "")),
            "n_shots": len(self._run.shots),
        }
