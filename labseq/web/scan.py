"""The scan of a run while its points fill: axes, quantities at each point, and fits."""

from __future__ import annotations

import itertools
import math
import time
from typing import Any, Final

from labseq.data.points import ScanPoint
from labseq.data.quantities import column_names, find_quantity, image_names, make_quantity, measures_of
from labseq.data.reader import open_run
from labseq.data.scanned import Scanned, scanned
from labseq.data.series import Series
from labseq.data.shot import Shot
from labseq.errors import LabseqError
from labseq.model.estimate import Estimated
from labseq.model.image_quantities import OF_IMAGES, parse_name
from labseq.recording.run_file import SCANNER, WRITTEN_UNITS
from labseq.web.fitting import LiveFit
from labseq.web.runs import OpenRun, text_of
from labseq.web.series import about_quantity, finite, mean_values

_MAX_POINTS: Final = 2000
"""Maximum number of points of a scan, and of visits to points."""
_SHARE: Final = 0.2
"""Maximum share of the time that is spent on computing the values of a scan."""


class ScanView:
    """The scan of a run, for a page that shows some quantities. Its methods are called under the run's lock.

    Args:
        quantity: Name of the only quantity to show. "" for the quantities of the run's page.

    Raises:
        ConfigError: The run has no such quantity.
        RecordingError: A file cannot be read.
    """

    def __init__(self, run: OpenRun, quantity: str = "") -> None:
        self._run = run
        self._own: Series | None = None
        if quantity and quantity not in run.shown:
            self._own = Series(find_quantity(_first_shots(run), quantity), run.folder)
        self._names = (quantity,) if quantity else run.shown
        empty = run.some(())
        self._fits = {
            one["value"]: LiveFit(make_quantity(one["value"], run.target), one, empty)
            for one in measures_of(empty)
            if one.get("fit") and one["value"] in self._names
        }
        self._choices: list[str] = []
        self._values: dict[str, Any] = {}
        self._next_s = -math.inf

    @property
    def is_busy(self) -> bool:
        """Whether it changes without new shots, because a fit is being computed or files are still unread."""
        is_reading = self._own is not None and self._own.n_unread > 0
        return is_reading or not all(fit.is_ready for fit in self._fits.values())

    def recent(self, read_s: float) -> dict[str, Any]:
        """The scan as it was a short time ago, so that most of the time is left for other work.

        Args:
            read_s: Time that may be spent on reading the files of shots, in seconds.
        """
        return self._values if time.monotonic() < self._next_s else self.values(read_s)

    def values(self, read_s: float) -> dict[str, Any]:
        """The scan as the files are now, JSON-ready. If it cannot be shown, "error" says why.

        Args:
            read_s: Time that may be spent on reading the files of shots, in seconds.
        """
        start_s = time.monotonic()
        try:
            self._values = self._compute(read_s)
        except (LabseqError, AttributeError, LookupError, TypeError, ValueError) as error:
            self._values = {"error": text_of(f"the scan cannot be shown: {error}", 400)}
        end_s = time.monotonic()
        self._next_s = end_s + (end_s - start_s) * (1 / _SHARE - 1)
        return self._values

    def _compute(self, read_s: float) -> dict[str, Any]:
        run, scan = self._run, self._run.record["scan"]
        shown = scanned(open_run(run.folder) if WRITTEN_UNITS in scan else run.outline())
        if self._own is not None:
            for row in run.history.rows(len(self._own)):
                self._own.add(row)
            self._own.read_results()
            self._own.read_files(run.shot, read_s)
        if not self._choices and len(run.history):
            self._choices = _choices(run)
        head = {
            "quantity": self._names[0],
            "choices": self._choices,
            "n_unread": 0 if self._own is None else self._own.n_unread,
        }
        if shown is None:
            axes = [{"address": text_of(one, 200), "words": [], "numbers": None} for one in scan["addresses"]]
            return {**head, "axes": axes, "quantities": [], "points": []}
        series = self._series()
        means = [one.over([self._lines(point.shots) for point in shown.points]) for one in series]
        values = {
            **head,
            "axes": [_axis(shown, i) for i in range(len(shown.axes))],
            "is_map": shown.is_map,
            "n_planned": None if WRITTEN_UNITS in scan else len(scan.get("points") or ()),
            "quantities": [self._quantity(*one, shown) for one in zip(series, means, strict=True)],
            "points": [
                _point(point, shown.places[i], [one[i] for one in means])
                for i, point in enumerate(shown.points[:_MAX_POINTS])
            ],
        }
        return values | _adaptive(run) if SCANNER in scan else values

    def _series(self) -> list[Series]:
        known = [one for one in self._run.history.columns().series if one.quantity.name in self._names]
        return [*known, *([] if self._own is None else [self._own])]

    def _lines(self, shots: tuple[Shot, ...]) -> list[int]:
        lines = (self._run.history.line_of(shot.index) for shot in shots)
        return [line for line in lines if line is not None]

    def _quantity(self, series: Series, means: list[Estimated], shown: Scanned) -> dict[str, Any]:
        about = about_quantity(series.quantity, [mean.value for mean in means])
        fit = self._fits.get(series.quantity.name)
        if fit is None:
            return {**about, "fits": []}
        return {**about, "fits": fit.result(shown, means)}


def _first_shots(run: OpenRun) -> Any:
    """The run with its first shots, in which to look up names of images and columns."""
    return run.some(run.history.columns().counted[:3].tolist())


def _choices(run: OpenRun) -> list[str]:
    """The quantities that the page offers: shown quantities, survival between images, columns, results."""
    first = _first_shots(run)
    return [*dict.fromkeys((*run.shown, *_survivals(first), *column_names(first)))]


def map_choices(run: OpenRun) -> list[str]:
    """The quantities with a value at each site: shown quantities, survival, loading, filling."""
    first = _first_shots(run)
    of_images = [name for name in run.shown if parse_name(name).kind in OF_IMAGES]
    filling = [] if run.target.is_none else [f"filling:{image}" for image in image_names(first)]
    return [*dict.fromkeys((*of_images, *_survivals(first), "loading", *filling))]


def _survivals(run: Any) -> list[str]:
    pairs = itertools.combinations(image_names(run), 2)
    return [f"survival:{before},{after}" for before, after in pairs]


def _axis(scan: Scanned, index: int) -> dict[str, Any]:
    axis = scan.axes[index]
    numbers = axis.numbers
    return {
        "address": text_of(axis.address, 200),
        "words": [text_of(word, 60) for word in axis.labels],
        "numbers": None if numbers is None else [finite(number) for number in numbers[0]],
        "unit": "" if numbers is None else numbers[1],
    }


def _point(point: ScanPoint, place: tuple[int, ...], means: list[Estimated]) -> dict[str, Any]:
    return {
        "place": list(place),
        "written": [text_of(word, 60) for word in point.written.values()],
        "n_shots": len(point.shots),
        "values": [mean_values(mean) for mean in means],
    }


def _adaptive(run: OpenRun) -> dict[str, Any]:
    """The quantity that the scanner optimises, its value at each visit to a point, and the best so far."""
    scan = run.record["scan"]
    visits = [
        {"point": event.get("point"), "value": event.get("value"), "written": _texts(event.get("written"))}
        for event in run.scan_events[-_MAX_POINTS:]
    ]
    last: Any = run.scan_events[-1].get("best") if run.scan_events else None
    best = None
    if isinstance(last, dict):
        best = {
            "point": last.get("point"),
            "value": last.get("value"),
            "written": _texts(last.get("written")),
        }
    return {
        "figure": text_of(scan.get("figure") or "", 120),
        "maximise": bool(scan.get("maximise", True)),
        "visits": visits,
        "best": best,
    }


def _texts(written: Any) -> dict[str, str]:
    return {text_of(k, 200): text_of(v, 60) for k, v in written.items()} if isinstance(written, dict) else {}
