"""A frame out of a file, and what can be wrong with it."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Problem


class BadFramesError(Exception):
    """Files that cannot be played; the camera turns it into an error of labseq's.

    Attributes:
        path: The file or folder, or a place in a file.
        what: What is wrong with it.
        expected: What would have been right, or "".
        hint: What to do, or "".
    """

    def __init__(self, path: Path | str, what: str, expected: str = "", hint: str = "") -> None:
        self.path = path
        self.what = what
        self.expected = expected
        self.hint = hint
        super().__init__(str(Problem(what, str(path), expected=expected, hint=hint)))


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A frame as it lies in a file.

    Attributes:
        image: uint16 (height, width), in camera counts (ADU), pixel (y, x).
        place: File and place in it, for messages.
        exposure_s: Exposure time, in seconds; None if the file does not tell.
        t_start_s: Start of the exposure on the clock of its own session, in seconds; None likewise.
    """

    image: NDArray[np.uint16]
    place: str
    exposure_s: float | None = None
    t_start_s: float | None = None


def load(package: str, called: str, path: Path) -> Any:
    """Import a package that reads a kind of file.

    Args:
        package: Its name in Python.
        called: Its name.
        path: The file that it is needed for, for the message.

    Raises:
        BadFramesError: It is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        text = f"reading it needs {called}, which cannot be imported ({error})"
        raise BadFramesError(path, text, hint='install it with `pip install "labseq[frames]"`') from error


def check_size(path: Path, size: tuple[int, ...], first: Path, wanted: tuple[int, ...]) -> None:
    """Refuse a file with frames of another size than those of the first.

    Raises:
        BadFramesError: It is so.
    """
    if size != wanted:
        text = f"its frames have {told(size)} pixels, those of {first.name} {told(wanted)}"
        raise BadFramesError(path, text, "frames of one size", "play them one size at a time")


def told(size: tuple[int, ...]) -> str:
    """A size in words.

    Example:
        >>> told((512, 256))
        '512 x 256'
    """
    return " x ".join(map(str, size))
