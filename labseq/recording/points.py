"""The points of a scan, with their shots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from labseq.errors import RecordingError
from labseq.recording.folders import RUN_FILE
from labseq.recording.reader import Run
from labseq.recording.shot import Shot


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoint:
    """A point of a scan and its shots.

    Attributes:
        parameters: Scanned address -> value, SI.
        written: The same as the sequence has it: "60 ms".
        shots: The shots there that count, in order.
    """

    parameters: Mapping[str, Any]
    written: Mapping[str, str]
    shots: tuple[Shot, ...]


def scan_points(run: Run) -> list[ScanPoint]:
    """The points of a run's scan that have a shot, in the scan's own order; none without a scan.

    Raises:
        RecordingError: What run.json says of the scan is damaged.
    """
    scan: Mapping[str, Any] = run.scan
    if not scan:
        return []
    shots: dict[int, list[Shot]] = {}
    try:
        for shot in run.shots:
            shots.setdefault(int(scan["point_of_shot"][shot.index]), []).append(shot)
        addresses = scan["addresses"]
        return [
            ScanPoint(
                dict(zip(addresses, scan["points"][point], strict=True)),
                dict(zip(addresses, scan["written"][point], strict=True)),
                tuple(shots[point]),
            )
            for point in sorted(shots)
        ]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        reason = f"has a damaged scan: {error!r}; take it from a backup"
        raise RecordingError(run.path / RUN_FILE, reason) from error
