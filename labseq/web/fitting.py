"""Fits what a run measures while its points come, in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from labseq.data import Run
from labseq.data.fits import Fit
from labseq.data.quantities import Quantity
from labseq.data.scanned import fitter, request_of
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


@dataclass(frozen=True, slots=True)
class Points:
    """What is fitted.

    Attributes:
        x: The scanned values in the unit of the axis.
        unit: That unit.
        values: The mean at each.
    """

    x: tuple[float, ...]
    unit: str
    values: tuple[Estimated, ...]


class LiveFit:
    """A fit that is made again as the points change. Its methods are called under the lock of the run.

    Args:
        quantity: The quantity.
        measure: The entry of ``measure`` in the settings of the run.
        run: The run, with or without shots.

    Attributes:
        is_ready: Whether the last result was that of the newest points.
    """

    def __init__(self, quantity: Quantity, measure: Mapping[str, Any], run: Run) -> None:
        self._quantity = quantity
        self._measure = measure
        self._run = run
        self._points = self._fitted_points = ""
        self._started_s = 0.0
        self.is_ready = True
        self._thread: threading.Thread | None = None
        self._result: dict[str, Any] = {"error": "the first fit is being computed"}

    def result(self, points: Points | None) -> dict[str, Any]:
        """The newest fit that is ready, for JSON; a fit of other points than before is begun.

        Args:
            points: The points so far; None if the scan is not one of a single number.
        """
        if points is None:
            return {"error": "a fit needs a scan of one number"}
        now_s, text = time.monotonic(), repr(points)
        is_busy = self._thread is not None and self._thread.is_alive()
        if text != self._points and not is_busy and now_s - self._started_s >= _PERIOD_S:
            self._points, self._started_s = text, now_s
            # not of a pool: the end of the server does not wait for a model that hangs
            self._thread = threading.Thread(target=self._compute, args=(points, text), daemon=True)
            self._thread.start()
        self.is_ready = self._fitted_points == text
        if is_busy and now_s - self._started_s > _SLOW_S:
            return {
                "error": f"it has not ended after {_SLOW_S:.0f} s: fix a parameter, or choose another model"
            }
        return self._result

    def _compute(self, points: Points, text: str) -> None:
        try:
            self._result = self._fitted(points)
        except ConfigError as error:
            problem = replace(error.problems[0], source="", line=0)
            self._result = {"error": text_of(problem, 300)}
        except Exception as error:  # noqa: BLE001 - a model of a plugin
            self._result = {"error": text_of(format_error(error), 300)}
        self._fitted_points = text

    def _fitted(self, points: Points) -> dict[str, Any]:
        factor, request = factor_of(points.unit), request_of(self._measure)
        fit = fitter(self._run, self._quantity, points.unit, request)(points.x, points.values)
        curve = np.linspace(min(points.x), max(points.x), 201)
        residuals = zip(points.x, points.values, fit.at(factor * np.array(points.x)).tolist(), strict=True)
        return {
            "error": "",
            **_parameters(fit, self._measure.get("report")),
            "curve": [curve.tolist(), [finite(y) for y in fit.at(factor * curve).tolist()]],
            "residuals": [_residual(*one) for one in residuals],
        }


def _parameters(fit: Fit, report: str | None) -> dict[str, Any]:
    values = fit.as_json()
    texts = {name: str(value) for name, value in fit.parameters.items()}
    name = report if report in texts else next(iter(texts))
    return {
        "model": text_of(fit.model, 60),
        "report": {"name": name, "text": texts[name]},
        "parameters": {
            name: {key: finite(one) if isinstance(one, float) else one for key, one in about.items()}
            | {"text": texts[name]}
            for name, about in values["parameters"].items()
        },
        "reduced_chi_square": finite(values["reduced_chi_square"]),
        "n_points": values["points"],
    }


def _residual(x: float, value: Estimated, fitted: float) -> dict[str, Any]:
    interval = [None if end is None else end - fitted for end in interval_of(value)]
    return {"x": x, "value": finite(value.value - fitted), "interval": interval}


def points_to_fit(on_axis: tuple[list[float], str] | None, means: Sequence[Estimated]) -> Points | None:
    """The points of a scan along one axis; None if its values are not numbers."""
    return None if on_axis is None else Points(tuple(on_axis[0]), on_axis[1], tuple(means))
