"""Reads arrays that other programs saved: ``.npy``, ``.npz``, and datasets of HDF5 files."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib.format import open_memmap

from labseq.errors import ConfigError, Problem
from labseq.messages import clean, closest, error_text, listing, visible

ARRAY_FILES: Final[tuple[str, ...]] = (".npy", ".npz", ".h5", ".hdf5")
"""Endings of the files that can be read."""

_NAMED: Final = re.compile(r"(.+\.(?:npz|h5|hdf5)):([^#]*)", re.IGNORECASE)
_UNREADABLE: Final = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    MemoryError,
    OverflowError,
    RuntimeError,
    TypeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""Errors that numpy, zipfile and h5py raise for files that are damaged or of another kind."""


def split_name(path: str | Path) -> tuple[Path, str]:
    """Split the name of an array off the path of the file that holds it.

    Example:
        >>> path, name = split_name("old/series.h5:Andor/Pictures")
        >>> path.name, name
        ('series.h5', 'Andor/Pictures')
        >>> split_name("frames.npy")[1]
        ''
    """
    match = _NAMED.fullmatch(str(path))
    if match is None:
        return Path(path), ""
    return Path(match[1]), match[2].replace("\\", "/").strip("/")  # a Path on Windows turned the slashes


@contextmanager
def opened_array(path: Path, name: str = "") -> Generator[Any]:
    """Open an array of which only indexed parts are read, except from a ``.npz`` file, which is read whole.

    Args:
        path: A file with one of the endings :data:`ARRAY_FILES`.
        name: Name of the array in a ``.npz`` or HDF5 file, or "" for the only one.

    Yields:
        The array or dataset of numbers, with ``shape`` and ``dtype``.

    Raises:
        ConfigError: The file or array cannot be read, also in the body, or the name is missing or wrong.
    """
    try:
        with _OPENERS[path.suffix.lower()](path, name) as array:
            _check_numbers(array, _label(path, name))
            yield array
    except ConfigError:
        raise
    except _UNREADABLE as error:
        reason = error_text(error).partition(";")[0]
        what = f"it cannot be read: {reason}" if reason else "it is damaged"
        expected = f"an array of numbers, as {_WRITERS[path.suffix.lower()]} writes it"
        raise ConfigError(Problem(what, _label(path, name), expected=expected)) from error


def _check_numbers(array: Any, label: str) -> None:
    if array.dtype.kind not in "biuf":
        what = f"it holds an array of shape {array.shape} and type {array.dtype}"
        raise ConfigError(Problem(what, label, expected="numbers"))


@contextmanager
def _npy(path: Path, _name: str) -> Generator[Any]:
    yield open_memmap(path, mode="r")  # refuses pickled objects


@contextmanager
def _npz(path: Path, name: str) -> Generator[Any]:
    with path.open("rb") as file, np.lib.npyio.NpzFile(file) as archive:
        yield archive[_array_name(path, name, dict.fromkeys(archive.files, ""))]


@contextmanager
def _hdf5(path: Path, name: str) -> Generator[Any]:
    import h5py  # takes 0.1 s to import

    with h5py.File(path, "r", locking=False) as file:
        datasets: dict[str, str] = {}

        def add(name: str, node: Any) -> None:
            if isinstance(node, h5py.Dataset) and len(node.shape or ()) > 1:
                datasets[name] = f" {node.shape}"

        file.visititems(add)
        yield file[_array_name(path, name, datasets)]


_WRITERS: Final = {".npy": "numpy.save", ".npz": "numpy.savez", ".h5": "h5py", ".hdf5": "h5py"}
_OPENERS: Final = {".npy": _npy, ".npz": _npz, ".h5": _hdf5, ".hdf5": _hdf5}


def _array_name(path: Path, name: str, shapes: Mapping[str, str]) -> str:
    """The full name of the array that the user asked for.

    Args:
        path: The file.
        name: As given, or "" for the only one.
        shapes: Name -> shape, as the message shows it, of each array in the file.

    Raises:
        ConfigError: There is no such array, or there are several and none was named.
    """
    if name in shapes or (not name and len(shapes) == 1):
        return name or next(iter(shapes))
    expected = listing(clean(name) + shape for name, shape in shapes.items()) or "a file with arrays"
    if not name:
        what, meant = f"it holds {len(shapes)} arrays", next(iter(shapes), "")
        hint = f"name one: {path.name}:{clean(meant)}" if meant else ""
    else:
        what, meant = f"it holds no array '{clean(name)}'", closest(name, shapes)
        hint = f"did you mean '{clean(meant)}'?" if meant else ""
    raise ConfigError(Problem(what, visible(str(path)), expected=expected, hint=hint))


def _label(path: Path, name: str) -> str:
    return visible(f"{path}:{name}" if name else str(path))
