"""Shots with values that another control system sends: their settings, checked, ready when `go` comes."""

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
"""Settings and planners that are kept; a scan comes back to the same ones."""


class LedShots:
    """Makes the settings of a shot from the values that another control system has sent.

    The objects that the values do not change are those of the run, so that only what differs is built. It may
    be called from any thread.

    Args:
        run: The run.
        points: What may be set.
        lab: The devices, with the planner of the files.
        others: The parameters of every shot: address -> value.
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
        self._run.choose(lab, point.steps)  # a planner that chooses recalls what it has chosen before
        return ShotSettings(lab, point.steps, timelines, {**self._others, **point.parameters})

    def _rebuilt(self, point: Point) -> Lab:
        """The lab with another planner, whose kernels are compiled."""
        base, lab = self._labs[id(self._base.planner)]
        rebuilt, _ = rebuild_lab(lab, base, point, self._run.seed)
        self._run.warm(rebuilt, devices=False)
        return rebuilt


def _kept(kept: OrderedDict[Any, Any], key: object, make: Callable[[], Any]) -> Any:
    """What was made for a key, or is made now; the oldest but the first is forgotten when there are many."""
    if key not in kept:
        kept[key] = make()
        if len(kept) > _N_KEPT:
            del kept[[*kept][1]]
    return kept[key]
