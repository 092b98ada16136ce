"""A whole lab of fake devices, for tests of steps and of the sequencer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.guard import StopFlag
from labseq.model import (
    Frame,
    LineSpec,
    Occupancy,
    Plan,
    RandomStream,
    SensorMode,
    ShotRecord,
    SiteGrid,
    TargetPattern,
    VisitedPoint,
    as_occupancy,
)
from labseq.model.policies import Timeouts
from labseq.roles import WHOLE_SENSOR, Clock, Context, Signal, Simulation
from labseq.sequencer.lab import Lab
from labseq.testing.fakes.devices import (
    Calls,
    Failure,
    FakeClock,
    Hang,
    RecordingCamera,
    RecordingDevice,
    RecordingHardware,
    RecordingLines,
    RecordingMobileTweezers,
    RecordingStaticTweezers,
)
from labseq.testing.fakes.records import OneByOnePlanner


class ScriptedDetector:
    """Returns the given occupancies, one after another, whatever the frame shows.

    Args:
        occupancies: The occupancies in order. The last one is repeated.

    Attributes:
        frames: The frames received.

    Example:
        >>> detector = ScriptedDetector([[[0, 1]], [[1, 1]]])
        >>> frame = Frame(np.zeros((4, 4), np.uint16), 0.045, 0.0)
        >>> [detector.detect(frame)[0].astype(int).tolist() for _ in range(3)]
        [[[0, 1]], [[1, 1]], [[1, 1]]]
    """

    def __init__(self, occupancies: Sequence[ArrayLike]) -> None:
        if not len(occupancies):
            raise ValueError("a scripted detector needs at least one occupancy")
        self._occupancies = [as_occupancy(occupancy) for occupancy in occupancies]
        self.frames: list[Frame] = []

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        """Give the next occupancy, with full confidence."""
        occupancy = self._occupancies[min(len(self.frames), len(self._occupancies) - 1)]
        self.frames.append(frame)
        return occupancy.copy(), np.ones(occupancy.shape, np.float32)


class ScriptedPlanner:
    """Returns the given plans, one after another. The last one is repeated.

    Args:
        plans: :class:`labseq.Plan`, or anything else that a faulty planner may return.

    Attributes:
        occupancies: The occupancies received.
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

    It counts the points visited, not its calls, so it can be called again.

    Args:
        points: Mappings from address to value, or anything else that a faulty scanner may return. Exceptions
            are raised.

    Attributes:
        shown: The visited points passed at each call.
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


class RecordingSimulation(Simulation):
    """A simulation without atoms that records the signals of devices and exposes black frames.

    Args:
        calls: The list for the calls.
        frame_shape: (height, width) of its frames.
    """

    def __init__(self, calls: Calls | None = None, frame_shape: tuple[int, int] = (512, 512)) -> None:
        self.calls = Calls() if calls is None else calls
        self._frame_shape = frame_shape
        self._wires: dict[str, Callable[[float, float], object]] = {}

    def open(self) -> None:
        """Record the call."""
        self.calls.note("simulation", "open")

    def close(self) -> None:
        """Record the call."""
        self.calls.note("simulation", "close")

    def begin_shot(self) -> None:
        """Record the call."""
        self.calls.note("simulation", "begin_shot")

    def load(self, t_start_s: float, duration_s: float) -> None:
        """Record the call."""
        self.calls.note("simulation", "load", t_start_s, duration_s)

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Record the call."""
        self.calls.note("simulation", "play", role, signal, t_start_s)

    def wire(self, role: str, on_pulse: Callable[[float, float], object]) -> None:
        """Keep a device's action at a pulse, for :meth:`pulse`."""
        self._wires[role] = on_pulse

    def pulse(self, role: str, t_s: float, width_s: float) -> None:
        """Pulse the line that triggers a role. No effect if no device is wired to it."""
        if role in self._wires:
            self._wires[role](t_s, width_s)

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the sensor."""
        return self._frame_shape

    def readout_fraction(self, mode: SensorMode) -> float:
        """1, because every frame takes the same time to read."""
        del mode
        return 1.0

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Do nothing."""

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """A black frame."""
        self.calls.note("simulation", "expose", t_start_s, exposure_s)
        return Frame(np.zeros(mode.frame_shape(self._frame_shape), np.uint16), exposure_s, t_start_s)

    def describe(self) -> Mapping[str, Any]:
        """A description that names the fake."""
        return {"model": "RecordingSimulation"}


T = TypeVar("T")

_FAKE_OF_ROLE: Final = {
    "camera": RecordingCamera,
    "static_tweezers": RecordingStaticTweezers,
    "mobile_tweezers": RecordingMobileTweezers,
    "lines": RecordingLines,
}


@dataclass(frozen=True, slots=True)
class FakeLab(Lab):
    """A lab of fakes, with access for tests.

    Attributes:
        calls: Every call of every fake device, in order.
        stop: The stop request that the clock and the guard check.
        hangs: "camera.read" -> the :class:`Hang`, for each call named in ``hang_on``.
    """

    calls: Calls
    stop: StopFlag
    hangs: Mapping[str, Hang]


def fake_lab(
    occupancies: Sequence[ArrayLike] | None = None,
    *,
    grid: SiteGrid | None = None,
    fill: ArrayLike | None = None,
    devices: Iterable[str] = ("shutter",),
    fail_on: Mapping[str, Failure] | None = None,
    hang_on: Iterable[str] = (),
    simulated: bool = False,
    line_specs: Sequence[LineSpec] = (),
    clock: Clock | None = None,
    stop: StopFlag | None = None,
    **parts: Any,
) -> FakeLab:
    """Build a lab of fakes. The devices are not open yet.

    Args:
        occupancies: The detector's answers, image after image, the last one repeated.
            By default every site holds an atom.
        grid: The grid of sites. By default as large as the occupancies, or 4 x 4.
        fill: Sites that must hold an atom, of the grid's shape. By default all.
            The other sites are reservoir. For more, give ``target``.
        devices: Names of further devices. Each knows the commands "on" and "off".
        fail_on: Call -> the error that it raises, for example ``{"camera.read": DeviceError(...)}``.
        hang_on: Calls that hang, for example ``{"mobile_tweezers.wait"}``, see
            :attr:`FakeLab.hangs`.
        line_specs: The lines of a timing box. Without lines there is no box.
        simulated: Whether there is a :class:`RecordingSimulation`.
        clock: By default a :class:`FakeClock` that checks ``stop``.
        stop: The stop request. By default a new one.
        **parts: Fields of ``labseq.sequencer.lab.Lab`` that replace the fakes.

    Raises:
        ValueError: A call in ``fail_on`` or ``hang_on`` does not exist.

    Example:
        >>> lab = fake_lab([[[1, 0]], [[1, 1]]], fail_on={"camera.trigger": OSError("cable")})
        >>> lab.camera.open()
        >>> lab.calls.names(), lab.target.n_atoms
        (['camera.open'], 2)
    """
    seen = [as_occupancy(occupancy) for occupancy in occupancies or ()]
    n_rows, n_cols = seen[0].shape if seen else (4, 4)
    grid = grid or SiteGrid(n_rows, n_cols)
    mask = np.ones(grid.shape, np.bool_) if fill is None else as_occupancy(fill, grid.shape)
    stop = stop or StopFlag()
    clock = clock or FakeClock(stop)
    calls = Calls(clock)
    simulation = RecordingSimulation(calls) if simulated else None
    specs = tuple(line_specs)
    context = Context("", grid, clock=clock, simulation=simulation, lines=specs)
    hangs = {call: Hang() for call in hang_on}
    names = (*devices, "lines") if specs else tuple(devices)
    hardware = _make_hardware(context, calls, names, fail_on or {}, hangs)
    fields: dict[str, Any] = {
        **{role: hardware.pop(role) for role in _FAKE_OF_ROLE if role in hardware},
        "line_specs": specs,
        "devices": hardware,
        "grid": grid,
        "motion": context.motion,
        "target": TargetPattern(mask, np.zeros(grid.shape, np.bool_)),
        "clock": clock,
        "detector": ScriptedDetector(seen or [np.ones(grid.shape, np.bool_)]),
        "planner": OneByOnePlanner(),
        "planner_name": "one_by_one",
        "degree_of_parallelism": 1,
        "simulation": simulation,
        "random_streams": (RandomStream(0),),
        "timeouts": Timeouts(),
    }
    return FakeLab(**{**fields, **parts}, calls=calls, stop=stop, hangs=hangs)


def _make_hardware(
    context: Context,
    calls: Calls,
    names: Sequence[str],
    fail_on: Mapping[str, Failure],
    hang_on: Mapping[str, Hang],
) -> dict[str, RecordingHardware]:
    hardware: dict[str, RecordingHardware] = {}
    for name in ("camera", "static_tweezers", "mobile_tweezers", *names):
        fake = _FAKE_OF_ROLE.get(name, RecordingDevice)
        failures, hangs = _of_device(name, fail_on), _of_device(name, hang_on)
        hardware[name] = fake(replace(context, name=name), calls, fail_on=failures, hang_on=hangs)
    for call in (*fail_on, *hang_on):  # because a misspelt call would never fail
        device, _, method = call.rpartition(".")
        if not hasattr(hardware.get(device), method):
            raise ValueError(f"no fake has the call '{call}'; expected a call such as 'camera.read'")
    return hardware


def _of_device(name: str, by_call: Mapping[str, T]) -> dict[str, T]:
    prefix = f"{name}."
    return {call.removeprefix(prefix): what for call, what in by_call.items() if call.startswith(prefix)}


class ListSink:
    """Keeps the shots that a sequencer writes, in place of the recorder.

    Attributes:
        shots: The records, in the order they were written.
    """

    def __init__(self) -> None:
        self.shots: list[ShotRecord] = []

    def write_shot(self, shot: ShotRecord) -> None:
        """Keep the shot."""
        self.shots.append(shot)


class RecordingObserver:
    """Keeps the events of a run. Implements ``labseq.roles.RunObserver``.

    Attributes:
        events: (name, values) of each, in order.
    """

    def __init__(self) -> None:
        self.events: list[tuple[str, Mapping[str, Any]]] = []

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep the event."""
        self.events.append((name, values))

    @property
    def names(self) -> list[str]:
        """The events' names, in order."""
        return [name for name, _ in self.events]

    def of(self, name: str) -> list[Mapping[str, Any]]:
        """The values of the events of one name."""
        return [values for event, values in self.events if event == name]
