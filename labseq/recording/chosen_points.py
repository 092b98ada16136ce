"""The points of an adaptive scan: run.json cannot know them, the index does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

from labseq.recording.plain import dumps
from labseq.units import written

SCANNER: Final = "scanner"
"""Key of a scan's record that only an adaptive one has: the scanner and its settings."""


class ChosenPoints:
    """The points that were chosen, each once, in the order in which they were first taken.

    Args:
        scan: What run.json says of the scan.

    Attributes:
        points: The values of each point, SI.
        written: The same in the units of the sequence.
    """

    def __init__(self, scan: Mapping[str, Any]) -> None:
        self.points: list[list[Any]] = []
        self.written: list[list[str]] = []
        self._addresses = [str(address) for address in scan["addresses"]]
        self._units = [str(unit) for unit in scan["units"]]
        self._numbers: dict[str, int] = {}

    def number(self, parameters: Mapping[str, Any]) -> int:
        """The number of a shot's point, counted from 0.

        Args:
            parameters: Address -> value, as the shot's line of the index has it.
        """
        values = [parameters[address] for address in self._addresses]
        number = self._numbers.setdefault(dumps(values), len(self.points))
        if number == len(self.points):
            self.points.append(values)
            self.written.append([written(v, unit) for v, unit in zip(values, self._units, strict=True)])
        return number


def completed(scan: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What run.json says of an adaptive scan, with the points as those of any other scan.

    Args:
        scan: What run.json says.
        rows: The lines of the index, in any order; ``point_of_shot`` is -1 for a shot without one.
    """
    chosen = ChosenPoints(scan)
    of_shot: dict[int, int] = {}
    for row in sorted(rows, key=lambda row: (row["shot"], row["attempt"])):
        of_shot[row["shot"]] = chosen.number(row["parameters"])
    point_of_shot = [of_shot.get(shot, -1) for shot in range(max(of_shot, default=-1) + 1)]
    return {**scan, "points": chosen.points, "written": chosen.written, "point_of_shot": point_of_shot}
