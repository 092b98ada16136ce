"""TIFF stacks, uint16, by tifffile; one page is in memory at a time."""

from __future__ import annotations

import logging
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from labseq_frames.picture import BadFramesError, Picture, check_size, load, told

_LOG = logging.getLogger("tifffile")
_LOG.addHandler(logging.NullHandler())  # what it says of damaged files is told by us, or is of no account


class TiffFiles:
    """One frame from each page of each file.

    Args:
        files: In order; at least one.

    Raises:
        BadFramesError: tifffile is missing; a file is no TIFF, is cut off, or begins with
            a page that is not uint16, not gray, or of another size.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = files
        self._tifffile = load("tifffile", "tifffile", files[0])
        self._n_pages = 0
        wanted: tuple[int, ...] | None = None
        for file in files:
            with self._opened(file) as stack:
                size = _size_of(file, 0, stack.pages[0])
                wanted = wanted or size
                check_size(file, size, files[0], wanted)
                self._n_pages += _count(file, stack)

    def pictures(self) -> Generator[Picture]:
        """Page by page."""
        for file in self._files:
            with self._opened(file) as stack:
                for number, page in enumerate(stack.pages):
                    _size_of(file, number, page)
                    pixels = page.asarray()
                    yield Picture(np.ascontiguousarray(pixels, np.uint16), f"{file}, page {number}")

    def describe(self) -> Mapping[str, Any]:
        """How many there are."""
        return {"source": "TIFF", "n_files": len(self._files), "n_frames": self._n_pages}

    @contextmanager
    def _opened(self, file: Path) -> Generator[Any]:
        """Within the block a stack is open, and what tifffile raises is told of it."""
        try:
            with self._tifffile.TiffFile(file) as stack:
                yield stack
        except BadFramesError:
            raise
        except Exception as error:  # damaged data make it raise ValueError, zlib.error, struct.error ...
            text = f"cannot be read as a TIFF: {error}"
            raise BadFramesError(file, text, hint="take it from a backup") from error


def _size_of(file: Path, number: int, page: Any) -> tuple[int, int]:
    if page.dtype != np.uint16 or len(page.shape) != 2:
        text = f"page {number} is {page.dtype}, {told(page.shape)}"
        raise BadFramesError(file, text, "uint16, height x width", "save the camera's own counts, gray")
    return page.shape


class _Complaints(logging.Handler):
    """Keeps what tifffile only logs: that a file ends before its pages do."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


def _count(file: Path, stack: Any) -> int:
    """Number of pages; refuses a file in which some are missing."""
    complaints = _Complaints()
    _LOG.addHandler(complaints)
    try:
        n_pages = len(stack.pages)
    finally:
        _LOG.removeHandler(complaints)
    if complaints.texts:
        text = f"is cut off or damaged behind page {n_pages - 1} ({complaints.texts[0]})"
        raise BadFramesError(file, text, hint="take it from a backup")
    if n_pages == 1 and stack.series[0].size > stack.pages[0].size:
        text = f"holds {told(stack.series[0].shape)} counts behind a single page, as large ImageJ stacks do"
        raise BadFramesError(file, text, "a page for each frame", "save it as BigTIFF, or in several files")
    return n_pages
