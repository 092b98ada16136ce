"""The points of a scan, each with the shots taken there."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.errors import RecordingError
from labseq.plain import dumps
from labseq.recording.folders import RUN_FILE
from labseq.recording.index import IndexRow
from labseq.recording.run_file import WRITTEN_UNITS
from labseq.units import written

if TYPE_CHECKING:
    from labseq.data.reader import Run
    from labseq.data.shot import Shot


@contextmanager
def reporting_damage(run_dir: Path) -> Generator[None]:
    """Report errors in the body as a damaged record of a scan.

    Raises:
        RecordingError: The body could not read the record.
    """
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError) as error:
        problem = f"has a damaged scan: {error!r}"
        raise RecordingError(run_dir / RUN_FILE, problem, "restore it from a backup") from error


class ChosenPoints:
    """The different points that an adaptive scan or a leader has chosen, in the order in which they came.

    Args:
        scan: The scan's record in run.json.

    Attributes:
        points: The values of each point, SI.
        written: The same values in the units of the sequence.
    """

    def __init__(self, scan: Mapping[str, Any]) -> None:
        self.points: list[list[Any]] = []
        self.written: list[list[str]] = []
        self._addresses = [str(address) for address in scan["addresses"]]
        self._units = [str(unit) for unit in scan[WRITTEN_UNITS]]
        self._numbers: dict[str, int] = {}

    def number(self, parameters: Mapping[str, Any]) -> int:
        """The number of a shot's point, counted from 0.

        Args:
            parameters: Address -> value, from the shot's line of the index.
        """
        values = [parameters[address] for address in self._addresses]
        # as text, because values may be lists, which cannot be keys
        number = self._numbers.setdefault(dumps(values), len(self.points))
        if number == len(self.points):
            self.points.append(values)
            self.written.append([_written(v, unit) for v, unit in zip(values, self._units, strict=True)])
        return number


def _written(value: Any, unit: str) -> str:
    """A value as a file would have it. Only a leader sets values other than numbers."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return written(value, unit) if is_number else value if isinstance(value, str) else dumps(value)


def completed(scan: Mapping[str, Any], rows: Iterable[IndexRow]) -> dict[str, Any]:
    """The record of an adaptive scan, completed with its points so that it reads like any other scan.

    Args:
        rows: The lines of the index, in any order. ``point_of_shot`` is -1 for a shot without a line.
    """
    points = ChosenPoints(scan)
    of_shot: dict[int, int] = {}
    # of several attempts at a shot, the last one counts
    for row in sorted(rows, key=lambda row: (row.shot, row.attempt)):
        of_shot[row.shot] = points.number(row.parameters)
    point_of_shot = [of_shot.get(shot, -1) for shot in range(max(of_shot, default=-1) + 1)]
    return {**scan, "points": points.points, "written": points.written, "point_of_shot": point_of_shot}


def restricted(scan: Mapping[str, Any], shots: Collection[int]) -> dict[str, Any]:
    """The record of a scan with only the points of some shots. The other shots get point -1."""
    of_shot: Sequence[int] = scan["point_of_shot"]
    kept = sorted({of_shot[shot] for shot in shots})
    number = {point: i for i, point in enumerate(kept)}
    points = [number[point] if shot in shots else -1 for shot, point in enumerate(of_shot)]
    return {
        **scan,
        "points": [scan["points"][point] for point in kept],
        "written": [scan["written"][point] for point in kept],
        "point_of_shot": points,
    }


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoint:
    """A point of a scan with its shots.

    Attributes:
        parameters: Scanned address -> value, SI.
        written: The same values in the units of the sequence, such as "60 ms".
        shots: The shots at this point that count, in order.
    """

    parameters: Mapping[str, Any]
    written: Mapping[str, str]
    shots: tuple[Shot, ...]


def planned_points(scan: Mapping[str, Any]) -> list[ScanPoint]:
    """All points in a scan's record, in its order, without their shots."""
    return [
        ScanPoint(
            dict(zip(scan["addresses"], values, strict=True)),
            dict(zip(scan["addresses"], written, strict=True)),
            (),
        )
        for values, written in zip(scan["points"], scan["written"], strict=True)
    ]


def scan_points(run: Run) -> list[ScanPoint]:
    """The points of a run's scan that have a shot, in the order of the scan. Empty without a scan.

    Raises:
        RecordingError: The scan's record in run.json is damaged.
    """
    scan: Mapping[str, Any] = run.scan
    if not scan:
        return []
    shots: dict[int, list[Shot]] = {}
    with reporting_damage(run.path):
        for shot in run.shots:
            shots.setdefault(int(scan["point_of_shot"][shot.index]), []).append(shot)
        points = planned_points(scan)
        return [replace(points[number], shots=tuple(shots[number])) for number in sorted(shots)]
