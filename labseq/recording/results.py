"""Results of analyses: a file of JSON lines for each analysis, in the run's folder.

A line with "shot" is the result of a shot; of several lines for the same shot the last one counts. Any
other line describes the analysis of the results that follow it: plugin, version, settings. If "again" in
it is true, the lines before it no longer count.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, cast

from labseq.errors import RecordingError
from labseq.files import LineLog, NewLines, explained
from labseq.messages import format_plugin_error
from labseq.recording import folders

SHOT: Final = "shot"
ERROR: Final = "error"
AGAIN: Final = "again"
_SUFFIX: Final = ".jsonl"


def results_file(run_dir: Path, name: str) -> Path:
    """The file of an analysis."""
    return run_dir / folders.RESULTS_FOLDER / f"{folders.slug(name)}{_SUFFIX}"


class ResultsLog:
    """The file of an analysis, for writing: each line is on the disk before the next shot is analysed.

    Args:
        path: The file; its folder is made if it does not exist.
        about: Plugin, version and settings; if "again" is true in it, earlier results no longer count.

    Raises:
        RecordingError: The file cannot be written.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self.path = path
        with explained(path):
            path.parent.mkdir(exist_ok=True)
        self._log = LineLog(path)
        self._log.append(about, sync=True)

    @staticmethod
    def checked(result: object) -> Mapping[str, Any]:
        """Check that a result can be written.

        Raises:
            TypeError: It is not a mapping of names to values.
        """
        if not isinstance(result, Mapping):
            raise TypeError(f"the result is {type(result).__name__}; expected a mapping of names to values")
        values = cast("Mapping[Any, Any]", result)
        for name in values:
            if not isinstance(name, str) or name in (SHOT, ERROR):
                raise TypeError(
                    f"the result has the name {name!r}; expected a text other than '{SHOT}' and '{ERROR}'"
                )
        return values

    def write(self, shot: int, result: Mapping[str, Any]) -> None:
        """Write the result of a shot."""
        self._log.append({SHOT: shot, **result}, sync=True)

    def fail(self, shot: int, error: BaseException) -> None:
        """Write why a shot has no result."""
        self._log.append({SHOT: shot, ERROR: format_plugin_error(error)}, sync=True)


class Results:
    """The results in the file of an analysis, which may still be written to.

    Attributes:
        rows: Shot -> its row.
        about: Plugin, version and settings of the last one; {} if unknown.
    """

    def __init__(self, path: Path) -> None:
        self._lines = NewLines(path)
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
        The row of each shot, in order; and plugin, version and settings of the last one, {} if unknown.

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
    return read_results(path)[0]


def result_columns(run_dir: Path) -> dict[str, dict[int, Any]]:
    """The results of all analyses that are single values: "analysis.NAME.KEY" -> shot -> value.

    Raises:
        RecordingError: They cannot be read.
    """
    columns: dict[str, dict[int, Any]] = {}
    for path in sorted((run_dir / folders.RESULTS_FOLDER).glob(f"*{_SUFFIX}")):
        rows, about = read_results(path)
        for row in rows:
            for key, value in row.items():
                if key not in (SHOT, ERROR) and isinstance(value, bool | int | float | str):
                    # the name that the sequence gives; that of the file has no spaces or slashes
                    name = f"{folders.RESULT_PREFIX}{about.get('analysis', path.stem)}.{key}"
                    columns.setdefault(name, {})[row[SHOT]] = value
    return columns
