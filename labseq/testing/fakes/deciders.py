"""Detectors, a planner and a scanner that say what a test tells them to; a simulation that only listens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.errors import DeviceError
from labseq.model import (
    Frame,
    Occupancy,
    Plan,
    SensorMode,
    TargetPattern,
    VisitedPoint,
    as_occupancy,
)
from labseq.roles import WHOLE_SENSOR, Signal
from labseq.testing.fakes.calls import Calls


class ScriptedDetector:
    """Sees the given occupancies, one after another, whatever is on the frame.

    Args:
        occupancies: What it sees, in order; the last one again and again.
        frame_shape: The only shape of frames that it takes; None takes any.

    Attributes:
        frames: The frames that it was given.

    Example:
        >>> detector = ScriptedDetector([[[0, 1]], [[1, 1]]])
        >>> frame = Frame(np.zeros((4, 4), np.uint16), 0.045, 0.0)
        >>> [detector.detect(frame)[0].astype(int).tolist() for _ in range(3)]
        [[[0, 1]], [[1, 1]], [[1, 1]]]
    """

    def __init__(self, occupancies: Sequence[ArrayLike], frame_shape: tuple[int, int] | None = None) -> None:
        if not len(occupancies):
            raise ValueError("a scripted detector needs at least one occupancy")
        self._occupancies = [as_occupancy(occupancy) for occupancy in occupancies]
        self._frame_shape = frame_shape
        self.frames: list[Frame] = []

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Give the next occupancy, with full confidence."""
        if self._frame_shape not in (None, frame.image.shape):
            text = f"the frame has shape {frame.image.shape}; expected {self._frame_shape}"
            raise DeviceError("detector", text)
        occupancy = self._occupancies[min(len(self.frames), len(self._occupancies) - 1)]
        self.frames.append(frame)
        return occupancy.copy(), np.ones(occupancy.shape, np.float32)


class FixedDetector(ScriptedDetector):
    """Sees the same occupancy on every frame."""

    def __init__(self, occupancy: ArrayLike, frame_shape: tuple[int, int] | None = None) -> None:
        super().__init__([occupancy], frame_shape)


class ScriptedPlanner:
    """Returns the given plans, one after another; the last one again and again.

    Args:
        plans: :class:`labseq.Plan`, or anything else that a bad planner may return.

    Attributes:
        occupancies: What it was asked to plan for.
    """

    def __init__(self, plans: Sequence[Any]) -> None:
        self._plans = list(plans) or [Plan.from_batches([])]
        self.occupancies: list[Occupancy] = []

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:  # noqa: ARG002 - Protocol
        """Give the next plan."""
        plan = self._plans[min(len(self.occupancies), len(self._plans) - 1)]
        self.occupancies.append(occupancy.copy())
        return plan


class ScriptedScanner:
    """Gives the given points, one after another, then None.

    It counts the points it is shown, not its calls; so it can be asked again.

    Args:
        points: Address -> value each, or anything else that a bad scanner may return; what is an
            exception is raised.

    Attributes:
        shown: What it was shown, at each call.
    """

    def __init__(self, points: Sequence[Any]) -> None:
        self._points = list(points)
        self.shown: list[tuple[VisitedPoint, ...]] = []

    def next_point(self, visited: Sequence[VisitedPoint]) -> Mapping[str, float] | None:
        """Give the next point."""
        self.shown.append(tuple(visited))
        point = self._points[len(visited)] if len(visited) < len(self._points) else None
        if isinstance(point, Exception):
            raise point
        return point


class RecordingSimulation:
    """A world without atoms that notes what devices do to it; it exposes black frames.

    Args:
        calls: Where calls are noted.
        frame_shape: (height, width) of its frames.
    """

    def __init__(self, calls: Calls | None = None, frame_shape: tuple[int, int] = (512, 512)) -> None:
        self.calls = Calls() if calls is None else calls
        self._frame_shape = frame_shape

    def open(self) -> None:
        """Note it."""
        self.calls.note("simulation", "open")

    def close(self) -> None:
        """Note it."""
        self.calls.note("simulation", "close")

    def begin_shot(self) -> None:
        """Note it."""
        self.calls.note("simulation", "begin_shot")

    def load(self, t_start_s: float, duration_s: float) -> None:
        """Note it."""
        self.calls.note("simulation", "load", t_start_s, duration_s)

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Note it."""
        self.calls.note("simulation", "play", role, signal, t_start_s)

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the sensor."""
        return self._frame_shape

    def readout_fraction(self, mode: SensorMode) -> float:
        """Every frame takes as long to read as any other."""
        del mode
        return 1.0

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Nothing to work out."""

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """A black frame."""
        self.calls.note("simulation", "expose", t_start_s, exposure_s)
        return Frame(np.zeros(mode.frame_shape(self._frame_shape), np.uint16), exposure_s, t_start_s)

    def describe(self) -> Mapping[str, Any]:
        """Say that it is a fake."""
        return {"model": "RecordingSimulation"}
