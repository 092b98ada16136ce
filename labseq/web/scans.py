"""The scan of a run for the pages: figures of merit at each point, and the best so far."""

from __future__ import annotations

import math
from typing import Any, Final

from labseq.analysis.scanned import Scanned, scanned
from labseq.errors import LabseqError
from labseq.model.estimate import Rate, mean
from labseq.recording import open_run
from labseq.recording.points import SCANNER, ScanPoint
from labseq.web.history import finite, interval_of
from labseq.web.runs import OpenRun, text_of

_MAX_POINTS: Final = 2000


def scan_values(run: OpenRun) -> dict[str, Any]:
    """The scan of a run, JSON-ready; "error" if it cannot be shown."""
    scan = run.record["scan"]
    try:
        found = scanned(open_run(run.folder) if SCANNER in scan else run.outline())
    except (LabseqError, KeyError, IndexError, TypeError, ValueError) as error:
        return {"error": text_of(f"the scan cannot be shown: {error}", 400)}
    if found is None:
        addresses = [text_of(one, 200) for one in scan.get("addresses") or ()]
        return {"axes": [{"address": one, "words": [], "numbers": None} for one in addresses], "points": []}
    values = {
        "axes": [_axis(found, i) for i in range(len(found.axes))],
        "is_map": found.is_map,
        "n_planned": None if SCANNER in scan else len(scan.get("points") or ()),
        "points": [
            _point(point, place)
            for point, place in list(zip(found.points, found.places, strict=True))[:_MAX_POINTS]
        ],
    }
    return values | _adaptive(run) if SCANNER in scan else values


def _axis(found: Scanned, index: int) -> dict[str, Any]:
    axis = found.axes[index]
    numbers = axis.numbers
    return {
        "address": text_of(axis.address, 200),
        "words": [text_of(word, 60) for word in axis.words],
        "numbers": None if numbers is None else [finite(number) for number in numbers[0]],
        "unit": "" if numbers is None else numbers[1],
    }


def _point(point: ScanPoint, place: tuple[int, ...]) -> dict[str, Any]:
    judged = [shot for shot in point.shots if not math.isnan(shot.filling_fraction)]
    filling = mean([shot.filling_fraction for shot in judged])
    rate = Rate(sum(shot.success for shot in judged), len(judged))
    return {
        "place": list(place),
        "written": [text_of(word, 60) for word in point.written.values()],
        "n_shots": len(point.shots),
        "filling": finite(filling.value),
        "filling_interval": interval_of(filling),
        "defect_free": finite(rate.value),
        "defect_free_interval": interval_of(rate) if rate.n_trials else [None, None],
    }


def _adaptive(run: OpenRun) -> dict[str, Any]:
    """What the scanner optimises, its value at each visit of a point, and the best so far."""
    scan = run.record["scan"]
    visits = [
        {"point": event.get("point"), "value": event.get("value"), "written": _words(event.get("written"))}
        for event in run.scan_events[-_MAX_POINTS:]
    ]
    last: Any = run.scan_events[-1].get("best") if run.scan_events else None
    best = None
    if isinstance(last, dict):
        best = {
            "point": last.get("point"),
            "value": last.get("value"),
            "written": _words(last.get("written")),
        }
    return {
        "figure": text_of(scan.get("figure") or "", 120),
        "maximise": bool(scan.get("maximise", True)),
        "visits": visits,
        "best": best,
    }


def _words(written: Any) -> dict[str, str]:
    return {text_of(k, 200): text_of(v, 60) for k, v in written.items()} if isinstance(written, dict) else {}
