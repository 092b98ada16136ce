"""Fits measured quantities while points arrive, in a separate thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from labseq.data.fits import Parameter
from labseq.data.numbers import readable
from labseq.data.quantities import Quantity
from labseq.data.reader import Run
from labseq.data.scanned import FitAt, Scanned, fits_along, request_of
from labseq.errors import ConfigError
from labseq.messages import format_error
from labseq.model.estimate import Estimated
from labseq.units import factor_of
from labseq.web.runs import text_of
from labseq.web.series import finite, interval_of

_PERIOD_S: Final = 0.5
"""Minimum time between the starts of two fits of a quantity, in seconds."""
_SLOW_S: Final = 20.0
"""Time after which the page says that a fit has not ended, in seconds."""


class LiveFit:
    """A fit that is repeated as the points change. Its methods are called under the lock of the run.

    Args:
        measure: The entry of ``measure`` in the settings of the run.
        run: The run, with or without shots.

    Attributes:
        is_ready: Whether the last result belongs to the newest points.
    """

    def __init__(self, quantity: Quantity, measure: Mapping[str, Any], run: Run) -> None:
        self._quantity = quantity
        self._measure = measure
        self._run = run
        self._points = self._fitted_points = ""
        self._started_s = 0.0
        self.is_ready = True
        self._thread: threading.Thread | None = None
        self._result = [_no_fit("the first fit is being computed")]

    def result(self, scan: Scanned, means: Sequence[Estimated]) -> list[dict[str, Any]]:
        """The newest finished fits, for JSON. If the points have changed, a new fit is started.

        Args:
            means: The quantity at each point.

        Returns:
            A fit along the first axis at each combination ``at`` of values of the other axes, or the
            reason why there is none.
        """
        if scan.on_axis(0) is None:
            return [_no_fit("a fit needs a scan of one number")]
        now_s, text = time.monotonic(), repr([scan.axes, scan.places, means])
        is_busy = self._thread is not None and self._thread.is_alive()
        if text != self._points and not is_busy and now_s - self._started_s >= _PERIOD_S:
            self._points, self._started_s = text, now_s
            # not from a pool, because the end of the server must not wait for a model that hangs
            self._thread = threading.Thread(target=self._compute, args=(scan, means, text), daemon=True)
            self._thread.start()
        self.is_ready = self._fitted_points == text
        if is_busy and now_s - self._started_s > _SLOW_S:
            what = f"it has not ended after {_SLOW_S:.0f} s; fix a parameter, or choose another model"
            return [_no_fit(what)]
        return self._result

    def _compute(self, scan: Scanned, means: Sequence[Estimated], text: str) -> None:
        try:
            fits = fits_along(self._run, scan, self._quantity, means, request_of(self._measure))
            self._result = self._described(fits, scan, means)
        except ConfigError as error:
            self._result = [_no_fit(replace(error.problems[0], source="", line=0))]
        except Exception as error:  # noqa: BLE001 - a model of a plugin
            self._result = [_no_fit(format_error(error))]
        self._fitted_points = text

    def _described(
        self, fits: Sequence[FitAt], scan: Scanned, means: Sequence[Estimated]
    ) -> list[dict[str, Any]]:
        report: str = self._measure.get("report") or ""
        made = [at.fit for at in fits if at.fit is not None]
        name = report if report in made[0].parameters else next(iter(made[0].parameters))
        values = [fit.parameters[name] for fit in made]
        shown = readable(max(abs(one.value) for one in values), values[0].text_unit)
        return [_fit(at, scan, means, name, shown) for at in fits]


def _no_fit(reason: object, at: Sequence[str] = ()) -> dict[str, Any]:
    return {"at": [*at], "error": text_of(reason, 300)}


def _fit(
    at: FitAt, scan: Scanned, means: Sequence[Estimated], name: str, shown: tuple[str, float]
) -> dict[str, Any]:
    """A fit for JSON.

    Args:
        name: The parameter to report.
        shown: The unit in which its values at all ``at`` are easy to read, and its factor to SI.
    """
    words = [text_of(word, 60) for word in at.written.values()]
    numbers, unit = scan.on_axis(0) or ([], "")
    if at.fit is None:
        return _no_fit(at.problem, words)
    factor, x = factor_of(unit), np.array([numbers[i] for i in at.points])
    curve = np.linspace(x.min(), x.max(), 201)
    fitted = at.fit.at(factor * x).tolist()
    return {
        "at": words,
        "error": "",
        "model": text_of(at.fit.model, 60),
        "report": {"name": name, "text": str(at.fit.parameters[name]), "unit": shown[0], "factor": shown[1]},
        "parameters": {key: _parameter(one) for key, one in at.fit.parameters.items()},
        "reduced_chi_square": finite(at.fit.reduced_chi_square),
        "n_points": len(at.fit.x),
        "curve": [curve.tolist(), [finite(y) for y in at.fit.at(factor * curve).tolist()]],
        "residuals": [
            _residual(*one) for one in zip(x.tolist(), [means[i] for i in at.points], fitted, strict=True)
        ],
    }


def _parameter(parameter: Parameter) -> dict[str, Any]:
    value, error = finite(parameter.value), finite(parameter.error)
    return {"value": value, "error": error, "unit": parameter.unit, "text": str(parameter)}


def _residual(x: float, value: Estimated, fitted: float) -> dict[str, Any]:
    interval = [None if end is None else end - fitted for end in interval_of(value)]
    return {"x": x, "value": finite(value.value - fitted), "interval": interval}
