"""Checked settings for shots with values of another control system, ready when `go` comes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from labseq.assembly.led import LedPoints
from labseq.assembly.point import Point
from labseq.assembly.points import rebuild_lab
from labseq.guard import Guard
from labseq.sequencer.lab import Lab
from labseq.sequencer.shot import ShotSettings
from labseq.session.check import check_settings
from labseq.session.prepared import PreparedRun

_N_KEPT: Final = 64
"""Number of settings and planners that are kept, because a scan comes back to the same values."""


class LedShots:
    """Makes the settings of a shot from the values that another control system has sent.

    It reuses the run's objects that the values do not change. It may be called from any thread.

    Args:
        run: The run.
        points: Makes the points, and knows which settings may be set.
        lab: The devices, with the planner of the files.
        others: The parameters of every shot, address -> value.
    """

    def __init__(self, run: PreparedRun, points: LedPoints, lab: Lab, others: Mapping[str, Any]) -> None:
        self._run = run
        self._points = points
        self._others = others
        self._lock = threading.Lock()
        self._base = points.at(0)
        self._guard = Guard(run.stop_flag)
        # waking a thread for each question takes longer than the answers, and atoms wait
        self._guard.direct = frozenset({"step", "lines", *(f"step '{name}'" for name, _ in self._base.steps)})
        self._settings = OrderedDict[frozenset[tuple[str, str]], ShotSettings]()
        self._labs = OrderedDict[int, tuple[Point, Lab]]()
        self._labs[id(self._base.planner)] = self._base, lab

    def __call__(self, values: Mapping[str, str]) -> ShotSettings:
        """The settings of a shot with these values.

        Raises:
            ConfigError: An address may not be set, or a plugin or device refuses a value.
        """
        with self._lock:
            return _kept(self._settings, frozenset(values.items()), lambda: self._make(values))

    def _make(self, values: Mapping[str, str]) -> ShotSettings:
        point = self._points.with_texts(values)
        _, lab = _kept(self._labs, id(point.planner), lambda: (point, self._rebuilt(point)))
        lab = replace(lab, target=point.target or lab.target)
        timelines = check_settings(self._run, self._guard, point, lab)
        self._run.choose(lab, point.steps)  # a planner that chooses recalls its earlier choice
        return ShotSettings(lab, point.steps, timelines, {**self._others, **point.parameters})

    def _rebuilt(self, point: Point) -> Lab:
        """The lab with another planner, whose kernels are compiled."""
        base, lab = self._labs[id(self._base.planner)]
        rebuilt, _ = rebuild_lab(lab, base, point, self._run.seed)
        self._run.warm(rebuilt, devices=False)
        return rebuilt


def _kept(kept: OrderedDict[Any, Any], key: object, make: Callable[[], Any]) -> Any:
    """The object for a key, made if needed. If there are many, the oldest but the first is forgotten."""
    if key not in kept:
        kept[key] = make()
        if len(kept) > _N_KEPT:
            del kept[[*kept][1]]
    return kept[key]
