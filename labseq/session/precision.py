"""Ends a run before its last shot, when its fits are as precise as its sequence asks (``stop_when``).

The fits are made between two shots, so that the run ends at the same shot whenever it is repeated with its
seed. Fits of labseq's own models take milliseconds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from labseq.assembly.assemble import Assembly
from labseq.assembly.fits import find_model
from labseq.data.fit_models import FitModel
from labseq.data.fits import Fit
from labseq.data.points import planned_points
from labseq.data.precision import follows, read_limit
from labseq.data.quantities import make_quantity
from labseq.data.reader import open_run
from labseq.data.scanned import FitRequest, fits_along, on_axes, request_of
from labseq.data.series import Series
from labseq.errors import ConfigError, PluginLoadError, RecordingError
from labseq.guard import Guard, StopFlag
from labseq.messages import format_error
from labseq.recording.index import IndexRow

MAX_FIT_S: Final = 10.0
"""Maximum time for the fits of a quantity, in seconds."""


class _Aim(NamedTuple):
    """A quantity whose fits must reach certain errors, given as parameter -> error, as written."""

    series: Series
    request: FitRequest
    stop_when: Mapping[str, float | str]


class Precision:
    """Judges after each round of the points whether the fits are precise enough.

    Args:
        assembly: The run's files.
        run_dir: Its folder.
        rows: The shots of a resumed run that are on disk, in order.
        stop: The request to stop the run.
        warn: Receives the message that a model has failed, after which the run takes all its shots.
    """

    def __init__(
        self,
        assembly: Assembly,
        run_dir: Path,
        rows: Iterable[IndexRow],
        stop: StopFlag,
        warn: Callable[[str], None],
    ) -> None:
        self._run = open_run(run_dir)
        self._points = planned_points(self._run.scan)
        self._point_of_shot: list[int] = self._run.scan["point_of_shot"]
        self._lines = defaultdict[int, list[int]](list)
        self._n_shots, self._next = 0, float(len(self._points))
        self._guard, self._warn = Guard(stop), warn
        self._aims = [
            _aim(assembly, run_dir, number, measure)
            for number, measure in enumerate(assembly.resolved["measure"])
            if "stop_when" in measure
        ]
        for row in rows:
            self._add(row)
            self._takes_turn()  # so that a resumed run makes the fits that it would have made anyway

    def after(self, row: IndexRow) -> str:
        """Judge the fits after a shot that was taken.

        Returns:
            Why the run may end, or "".

        Raises:
            StopRequested: The run was asked to stop during the fit.
        """
        self._add(row)
        if not self._takes_turn():
            return ""
        results: list[str] = []
        for aim in self._aims:
            call = self._guard.run("fit", MAX_FIT_S, partial(self._results, aim))
            if call is None:
                self._give_up(f"the fit {aim.request.model} did not end within {MAX_FIT_S:.0f} s")
                return ""
            if (error := call.error) is not None:
                if isinstance(error.__cause__, PluginLoadError):
                    self._give_up(str(error.__cause__))
                elif not isinstance(error, ConfigError | RecordingError):
                    # the shots are good, whatever is wrong with the fit
                    self._give_up(format_error(error))
                return ""  # more shots may give a fit
            results += call.result
        return f"stop_when reached: {', '.join(results)}" if all(results) else ""

    def _takes_turn(self) -> bool:
        """Whether the fits are made now, after a whole round of the points. If so, sets the next time."""
        is_due = self._n_shots >= self._next and not self._n_shots % len(self._points)
        if is_due:
            # 5 % more shots until the next fit, which reduce an error by 2.5 %, so that a run of many shots
            # makes only some dozens of fits
            self._next = 1.05 * self._n_shots
        return is_due

    def _give_up(self, why: str) -> None:
        self._next = math.inf
        self._warn(f"'stop_when' is ignored, and the run takes all its shots: {why}")

    def _add(self, row: IndexRow) -> None:
        if not row.counts:
            return
        self._lines[self._point_of_shot[row.shot]].append(self._n_shots)
        self._n_shots += 1
        for aim in self._aims:
            aim.series.add(row)

    def _results(self, aim: _Aim) -> list[str]:
        """Each parameter with its error, for each fit. "" where it is not precise enough."""
        aim.series.read_results()
        means = aim.series.over([self._lines[i] for i in range(len(self._points))])
        scan = on_axes(self._run.scan, self._points)
        assert scan is not None  # the sequence was checked
        fits = fits_along(self._run, scan, aim.series.quantity, means, aim.request)
        return [_known(at.fit, name, written) for at in fits for name, written in aim.stop_when.items()]


def _aim(assembly: Assembly, run_dir: Path, number: int, measure: Mapping[str, Any]) -> _Aim:
    place = ("measure", number, "fit")
    model = find_model(assembly.document, place, measure["fit"], assembly.hardware.host)
    lab_model = None if isinstance(model, FitModel) else model
    quantity = make_quantity(measure["value"], assembly.target)
    return _Aim(Series(quantity, run_dir), request_of(measure, lab_model), measure["stop_when"])


def _known(fit: Fit | None, name: str, written: float | str) -> str:
    """A parameter with its error, if the points follow the model and the error is reached, else ""."""
    if fit is None or not follows(fit):
        return ""
    parameter = fit.parameters[name]
    limit = read_limit(written, parameter.text_unit)
    return f"{name} {parameter}" if limit.is_met_by(parameter) else ""
