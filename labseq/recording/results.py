"""Results of analyses: a file of JSON lines for each analysis, in the run's folder.

A line with "shot" is the result of a shot. The last of several lines for the same shot counts. Any other
line describes the analysis that gave the results after it: plugin, version, settings. If its "again" is
true, the lines before it no longer count. Large arrays are in an HDF5 file for each shot, in a folder next
to the lines, which name the dataset.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.files import LineLog, NewLines, explained, make_folder, write_file
from labseq.messages import clean, format_plugin_error
from labseq.plain import dumps, plain_text
from labseq.recording import folders
from labseq.units import size_text

SHOT: Final = "shot"
ERROR: Final = "error"
ARRAY: Final = "array"
"""Key of a line that replaces a large array, with the name of the dataset."""
AGAIN: Final = "again"
_SUFFIX: Final = ".jsonl"
MAX_TEXT: Final = 1_000_000
"""Maximum size of a line, in bytes."""


def results_file(run_dir: Path, name: str) -> Path:
    """The file of an analysis."""
    return run_dir / folders.RESULTS_FOLDER / f"{folders.slug(name)}{_SUFFIX}"


class ResultsLog:
    """The file of an analysis, for writing. Each line is on the disk before the next shot is analysed.

    Args:
        path: The file. Its folder is created if it does not exist.
        about: Plugin, version and settings. If its "again" is true, earlier results no longer count.

    Raises:
        RecordingError: The file cannot be written.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self.path = path
        with explained(path):
            make_folder(path.parent)
        self._log = LineLog(path)
        self._log.append(about, sync=True)

    @staticmethod
    def checked(result: object) -> dict[str, Any]:
        """Check that a result can be written.

        Returns:
            The result. Arrays are kept, and all other values are plain.

        Raises:
            TypeError: It is not a mapping of names to values, or a value is neither JSON nor an array.
        """
        if not isinstance(result, Mapping):
            raise TypeError(f"the result is {type(result).__name__}; expected a mapping of names to values")
        values = cast("Mapping[Any, Any]", result)
        for name in values:
            if not isinstance(name, str) or name in (SHOT, ERROR):
                raise TypeError(
                    f"the result has the name {name!r}; expected a text other than '{SHOT}' and '{ERROR}'"
                )
        row = {name: _checked(value, f"the result '{clean(name)}'") for name, value in values.items()}
        n_bytes = len(dumps({name: value for name, value in row.items() if not _is_large(value)}))
        if n_bytes > MAX_TEXT:
            what = f"the result has {size_text(n_bytes)} of text, more than the {size_text(MAX_TEXT)} allowed"
            raise TypeError(f"{what}; return numpy arrays, each under its own name")
        return row

    def write(self, shot: int, result: Mapping[str, Any]) -> None:
        """Write the result of a shot, its large arrays first.

        Raises:
            RecordingError: The result cannot be written.
        """
        large = {name: value for name, value in result.items() if _is_large(value)}
        names = {name: str(number) for number, name in enumerate(large)}
        if large:
            path = _arrays_file(self.path, shot)
            with explained(path):
                make_folder(path.parent)
            write_file(path, _encoded({names[name]: (name, array) for name, array in large.items()}))
        row = {
            name: {ARRAY: names[name], "shape": value.shape, "dtype": value.dtype.name}
            if name in large
            else value
            for name, value in result.items()
        }
        self._log.append({SHOT: shot, **row}, sync=True)

    def fail(self, shot: int, error: BaseException) -> None:
        """Write why a shot has no result."""
        self._log.append({SHOT: shot, ERROR: format_plugin_error(error)}, sync=True)


def _is_large(value: object) -> bool:
    # a line may have an array of up to this many numbers, a larger array is in its own file
    return isinstance(value, np.ndarray) and value.size > 1000


def _checked(value: Any, what: str) -> Any:
    """A value in the form in which it can be written: plain, or an array of numbers.

    Raises:
        TypeError: It is something else. The message names its place in the result.
    """
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        return value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value).items()
        return {str(key): _checked(item, f"{what}, '{clean(str(key))}'") for key, item in items}
    if isinstance(value, list | tuple):
        items = enumerate(cast("Sequence[Any]", value))
        return [_checked(item, f"{what}, number {number}") for number, item in items]
    kind = f"array of {value.dtype.name}" if isinstance(value, np.ndarray) else type(value).__name__
    expected = "expected numbers, texts, arrays of numbers, and lists and mappings of them"
    if "complex" in kind:
        expected = "expected real numbers, with real and imaginary part under two names"
    raise TypeError(f"{what} is of the type {kind}; {expected}")


def _arrays_file(path: Path, shot: int) -> Path:
    """The file with the large arrays of a shot's result."""
    return path.with_suffix("") / f"shot_{shot:06d}.h5"


def _encoded(arrays: Mapping[str, tuple[str, NDArray[Any]]]) -> memoryview:
    """An HDF5 file of arrays: dataset -> its name in the result, and the array."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for dataset, (name, array) in arrays.items():
            file.create_dataset(dataset, data=array).attrs["name"] = plain_text(name)
    return buffer.getbuffer()


@dataclass(frozen=True, slots=True)
class StoredArray:
    """A large array of a result, which ``numpy.asarray`` reads from its file.

    Attributes:
        path: The HDF5 file.
        dataset: Its dataset there.
        shape: Its shape.
        dtype: Its type.
    """

    path: Path
    dataset: str
    shape: tuple[int, ...]
    dtype: str

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Read the array.

        Raises:
            RecordingError: Its file is missing or damaged.
        """
        import h5py

        try:
            with h5py.File(self.path, "r", locking=False) as file:
                array: NDArray[Any] = np.asarray(file[self.dataset])
        except (OSError, KeyError) as error:
            hint = "'labseq analyse --again' computes the results again"
            raise RecordingError(self.path, f"has no readable array '{self.dataset}'", hint) from error
        return array if dtype is None else array.astype(dtype)


class Results:
    """The results in the file of an analysis, which may still be written to.

    Attributes:
        rows: Shot -> its row.
        about: Plugin, version and settings of the last analysis. {} if unknown.
    """

    def __init__(self, path: Path) -> None:
        # longest line in bytes that is skipped, because earlier versions wrote large arrays as lines
        self._lines = NewLines(path, 1 << 28)
        self.rows: dict[int, dict[str, Any]] = {}
        self.about: dict[str, Any] = {}

    def read(self) -> None:
        """Read the lines that were added since the last call.

        Raises:
            RecordingError: The file exists but cannot be read.
        """
        for row in self._lines.read():
            if type(row.get(SHOT)) is int:
                self.rows[row[SHOT]] = row
            else:
                self.about = row
                if row.get(AGAIN):
                    self.rows.clear()


def read_results(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Read the file of an analysis, even if it is incomplete or damaged.

    Returns:
        The row of each shot in order, and plugin, version and settings of the last analysis, {} if unknown.

    Raises:
        RecordingError: The file exists but cannot be read.
    """
    results = Results(path)
    results.read()
    return [results.rows[shot] for shot in sorted(results.rows)], results.about


def shots_with_result(rows: Iterable[Mapping[str, Any]]) -> set[int]:
    """The shots that have a result."""
    return {row[SHOT] for row in rows if ERROR not in row}


def rows_of(run_dir: Path, name: str) -> list[dict[str, Any]]:
    """The row of each shot that was analysed.

    Raises:
        RecordingError: There are no results of that name, or they cannot be read.
    """
    path = results_file(run_dir, name)
    if not path.is_file():
        names = sorted(file.stem for file in path.parent.glob(f"*{_SUFFIX}"))
        others = f"only of {', '.join(names)}" if names else "nor of any other"
        hint = f"make them with 'labseq analyse {run_dir} --use {name}'"
        raise RecordingError(path, f"there are no results of the analysis '{name}', {others}", hint)
    rows = read_results(path)[0]
    return [{name: _stored(path, row[SHOT], value) for name, value in row.items()} for row in rows]


def _stored(path: Path, shot: int, value: Any) -> Any:
    """A value of a row. For an array in its own file, the object that reads it."""
    match value:
        case {"array": str(dataset), "shape": [*shape], "dtype": str(dtype)}:
            return StoredArray(_arrays_file(path, shot), dataset, tuple(shape), dtype)
        case _:
            return value


def result_columns(run_dir: Path) -> dict[str, dict[int, Any]]:
    """The results of all analyses that are single values: "analysis.NAME.KEY" -> shot -> value.

    Raises:
        RecordingError: The results cannot be read.
    """
    columns: dict[str, dict[int, Any]] = {}
    for path in sorted((run_dir / folders.RESULTS_FOLDER).glob(f"*{_SUFFIX}")):
        rows, about = read_results(path)
        for row in rows:
            for key, value in row.items():
                if key not in (SHOT, ERROR) and isinstance(value, bool | int | float | str):
                    # the name in the sequence, because the file's name has no spaces or slashes
                    name = f"{folders.RESULT_PREFIX}{about.get('analysis', path.stem)}.{key}"
                    columns.setdefault(name, {})[row[SHOT]] = value
    return columns
