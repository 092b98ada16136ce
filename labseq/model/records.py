"""Records of runs, shots, images and cycles, and the planned timeline of a shot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from labseq.model.lines import Pulses, Span

if TYPE_CHECKING:
    from labseq.model.camera import Frame
    from labseq.model.grid import Occupancy, TargetPattern
    from labseq.model.plan import Plan, PlanReport

ShotStatus = Literal["complete", "interrupted", "failed"]
RunStatus = Literal["running", "complete", "stopped", "failed"]

OVERSHOOT_S: Final = 1e-3
"""Longest time by which a wait on a real clock may be late, in seconds."""

STEP: Final = "step_"
"""Prefix of the stage of a whole step: "step_2_rearrange"."""


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """The names of steps. Names that occur more than once also get the index of the step.

    Example:
        >>> unique_names(["load", "image", "rearrange", "image"])
        ('load', 'step_1_image', 'rearrange', 'step_3_image')
    """
    step_names: list[str] = []
    for i, name in enumerate(names):
        unique = f"{STEP}{i}_{name}" if names.count(name) > 1 else name
        while unique in step_names or (unique != name and unique in names):
            unique += "_"
        step_names.append(unique)
    return tuple(step_names)


@dataclass(frozen=True, slots=True)
class TimedBy:
    """The clock of a step, and its accuracy.

    Attributes:
        name: "computer", or the role of the hardware, such as "lines" or "camera".
        accuracy_s: Resolution of the hardware, or how late the computer may be, in seconds. 0 if unknown.
    """

    name: str
    accuracy_s: float = 0.0


COMPUTER: Final = TimedBy("computer", OVERSHOOT_S)
"""The computer's own clock. Steps on it are typically 0.4 ms late after one another (measured)."""


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Duration of one stage, and its budget.

    Attributes:
        stage: "load", "expose", "detect", "plan", "check", "prepare", "play", ...
        step: Index of the step in the shot.
        cycle: Index of the rearrangement cycle. -1 outside of a cycle.
        t_start_s: Start on the session's clock, from the start of the shot.
        duration_s: Duration on the session's clock. In a dry run this is the
            modelled time.
        host_s: Duration on this computer's clock. Never decisive in a dry run.
        budget_s: Its budget. nan if it has none.
    """

    stage: str
    step: int
    cycle: int
    t_start_s: float
    duration_s: float
    host_s: float
    budget_s: float = float("nan")

    @property
    def over_budget(self) -> bool:
        """Whether the stage took longer than its budget.

        A millisecond more is allowed. On a real clock each wait ends a little late, so a load or a fixed
        window would otherwise always count as exceeded.
        """
        return self.duration_s > self.budget_s + OVERSHOOT_S


@dataclass(frozen=True, slots=True)
class StepTiming:
    """Planned and achieved duration of a step.

    Attributes:
        step: Index of the step in the shot.
        name: Its name.
        timed_by: Its clock, which is "computer" or the role of the hardware.
        t_start_s: Start on the session's clock, from the start of the shot.
        planned_s: Its planned duration. The maximum if it may end earlier.
        achieved_s: Its duration as the hardware reports it, otherwise on the session's clock.
        host_s: Duration on this computer's clock, with all calls.
    """

    step: int
    name: str
    timed_by: str
    t_start_s: float
    planned_s: float
    achieved_s: float
    host_s: float


@dataclass(frozen=True, slots=True)
class LineEdge:
    """A change of one line, as the timing box played it.

    Attributes:
        step: Index of the step in the shot.
        line: Name of the line.
        on: Whether it is on from then on.
        t_s: Time from the start of the program of its step, a multiple of the box's resolution.
        t_start_s: Start of this program on the session's clock, from the start of the shot.
    """

    step: int
    line: str
    on: bool
    t_s: float
    t_start_s: float


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """One image with the detected atoms.

    Attributes:
        frame: The frame, or None if frames are not kept.
        occupancy: bool (n_rows, n_cols), as the detector saw it.
        confidence: float32 (n_rows, n_cols), the detector's confidence per site.
        step: Index of the step in the shot.
        cycle: Index of the rearrangement cycle that it ended. -1 for the image of an ``image`` step.
        t_start_s: Start of the exposure, from the start of the shot.
        exposure_s: Exposure time, in seconds.
        name: Name of the image, unique in the shot and the same in every shot.
        signal: float64 (n_rows, n_cols), the values that the detector compared with its thresholds. None if
            it does not report them.
    """

    frame: Frame | None
    occupancy: NDArray[np.bool_]
    confidence: NDArray[np.float32]
    step: int
    cycle: int
    t_start_s: float
    exposure_s: float
    name: str = "image"
    signal: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CycleRecord:
    """One cycle of plan, check, move.

    Attributes:
        step: Index of the step in the shot.
        cycle: Index of the cycle within its step.
        plan: The whole plan.
        report: The result of the check.
        n_batches_played: Number of batches that fitted into the window and were played.
        window_s: The window of this cycle, in seconds.
        t_start_s: Start of the cycle, from the start of the shot.
        moves_s: Modelled duration of the played batches, overheads included.
        late_s: How long after the window the moves ended. 0 if they ended in time.
    """

    step: int
    cycle: int
    plan: Plan
    report: PlanReport
    n_batches_played: int
    window_s: float
    t_start_s: float
    moves_s: float
    late_s: float = 0.0

    @property
    def n_atom_moves_played(self) -> int:
        """Atom moves in the batches that were played."""
        return int(self.plan.batch_offsets[self.n_batches_played])


def follow_atoms(before: Occupancy, cycles: Iterable[CycleRecord]) -> tuple[Occupancy, Occupancy]:
    """Where the atoms are after cycles if none is lost.

    Args:
        before: bool (n_rows, n_cols), the image that the first cycle was planned on.
        cycles: The cycles, in order.

    Returns:
        The sites of moved atoms and of atoms that stayed, bool (n_rows, n_cols), without ejected atoms.
    """
    atoms, moved = before.copy(), np.zeros_like(before)
    for cycle in cycles:
        plan = cycle.plan
        for first, last in pairwise(plan.batch_offsets[: cycle.n_batches_played + 1].tolist()):
            moves = plan.moves[first:last]
            start, end = tuple(moves[:, :2].T), moves[:, 2:]
            carried = atoms[start]
            atoms[start] = moved[start] = False
            inside = carried & ((end >= 0) & (end < before.shape)).all(axis=1)
            atoms[tuple(end[inside].T)] = moved[tuple(end[inside].T)] = True
    return moved, atoms & ~moved


@dataclass(slots=True, eq=False)
class ShotRecord:
    """Everything recorded about one attempt at a shot. Filled while the attempt runs.

    To record something new, add an attribute here and its row in :mod:`labseq.recording.schema`.

    Attributes:
        shot_index: Index of the shot in the run, from 0.
        attempt: Index of the attempt, from 0.
        seed: The run's seed.
        t_start_utc: Wall time of its start, ISO 8601, UTC.
        t_end_utc: Wall time of its end.
        status: "complete", "interrupted" (operator) or "failed".
        error: Why it did not complete, or "".
        images: In the order they were taken.
        cycles: In the order they were made.
        timing: In the order the stages ended.
        steps: Planned and achieved durations of the steps that have ended.
        edges: In the order they were played. Within a program, line by line.
        seen_defect_free_cycle: Index of the first cycle whose image met the target. -1 if none.
        success: Whether the last ``image`` step met the target.
        filling_fraction: Filling of the target on the last ``image`` step. nan without such a step, or if a
            rearrangement follows it.
        n_missing_atoms: Number of atoms by which the loading fell short of the target.
        readings: Values read from devices during the shot.
        parameters: Settings that differ from the files in this shot: address -> value, SI.
        target: Its target. None for the target of the run.
        calibrations: Kind -> id of the calibration in use.
        atom_events: A simulation's reports about the atoms: name -> structured array.
        thresholds: float64 (n_rows, n_cols). A site has an atom if the signal of an image exceeds its
            threshold. None if the detector does not report thresholds.
        sites_px: float64 (n_rows, n_cols, 2), (y, x) of the sites on the frames, in pixels. None if unknown.
        signal_unit: Unit of signals and thresholds, such as "counts". "" if unknown.
    """

    shot_index: int
    attempt: int
    seed: int
    t_start_utc: str
    t_end_utc: str = ""
    status: ShotStatus = "failed"
    error: str = ""
    images: list[ImageRecord] = field(default_factory=list[ImageRecord])
    cycles: list[CycleRecord] = field(default_factory=list[CycleRecord])
    timing: list[StageTiming] = field(default_factory=list[StageTiming])
    steps: list[StepTiming] = field(default_factory=list[StepTiming])
    edges: list[LineEdge] = field(default_factory=list[LineEdge])
    seen_defect_free_cycle: int = -1
    success: bool = False
    filling_fraction: float = float("nan")
    n_missing_atoms: int = 0
    readings: dict[str, Any] = field(default_factory=dict[str, Any])
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])
    target: TargetPattern | None = None
    calibrations: Mapping[str, str] = field(default_factory=dict[str, str])
    atom_events: dict[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    thresholds: NDArray[np.float64] | None = None
    sites_px: NDArray[np.float64] | None = None
    signal_unit: str = ""

    @property
    def n_images(self) -> int:
        """Number of images."""
        return len(self.images)

    @property
    def n_cycles(self) -> int:
        """Number of rearrangement cycles."""
        return len(self.cycles)

    @property
    def n_batches(self) -> int:
        """Number of batches that were played."""
        return sum(cycle.n_batches_played for cycle in self.cycles)

    @property
    def n_atom_moves(self) -> int:
        """Number of atom moves that were played."""
        return sum(cycle.n_atom_moves_played for cycle in self.cycles)


@dataclass(frozen=True, slots=True, eq=False)
class RunRecord:
    """Properties of a run that are fixed when it starts.

    Attributes:
        name: The sequence's name.
        n_shots: Number of requested shots.
        seed: The run's seed.
        simulated: Whether all hardware is simulated.
        t_start_utc: Wall time, ISO 8601, UTC.
        target: The target of the run.
        sequence_text: Exact bytes of the sequence file, decoded.
        profile_text: Exact bytes of the profile, decoded.
        sequence_path: Where the sequence came from.
        profile_path: Where the profile came from.
        resolved: Every setting after defaults and overrides, SI, JSON-ready.
        overrides: Changes by ``--set`` and other options: address -> "value" (SI), "unit", and "written" (as
            typed).
        units: Address -> SI unit of each setting that was set or scanned and has a unit.
        devices: ``describe()`` of each device: role -> values.
        plugins: Each plugin in use, by :class:`labseq.session.sources.RunCode`.
        provenance: Code and package versions, host, user.
        record_frames: Which frames are kept: "all", "last" or "none".
        grid_spacing_m: Spacing of the sites, in metres.
        lattice: Lattice of the grid.
        scan: The scan, with "addresses", "points", "point_of_shot", ... Empty without a scan.
        calibrations: Kind -> id of the calibration in use.
        steps: Unique names of the steps, in order.
        resumed: How it was resumed after it had ended early, in order. Each has ``t_utc``, ``first_shot``,
            how the run had ended (``before``), accepted ``changes`` (each ``what``, ``was`` and ``now``) and
            ``provenance``.
    """

    name: str
    n_shots: int
    seed: int
    simulated: bool
    t_start_utc: str
    target: TargetPattern
    sequence_text: str
    profile_text: str
    sequence_path: str
    profile_path: str
    resolved: Mapping[str, Any]
    overrides: Mapping[str, Any]
    devices: Mapping[str, Mapping[str, Any]]
    plugins: tuple[Mapping[str, Any], ...]
    provenance: Mapping[str, Any]
    record_frames: Literal["all", "last", "none"]
    grid_spacing_m: float
    lattice: str
    scan: Mapping[str, Any] = field(default_factory=dict[str, Any])
    calibrations: Mapping[str, str] = field(default_factory=dict[str, str])
    steps: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    resumed: tuple[Mapping[str, Any], ...] = ()


@dataclass(frozen=True, slots=True)
class TimelineEntry:
    """One bar of a shot's timeline.

    Attributes:
        label: Its name, for example "image" or "cycle 3: move".
        duration_s: Its maximum duration, in seconds.
        min_duration_s: Its minimum duration. 0 if it may be left out.
        n_images: Maximum number of its images.
        exposure_s: Exposure of each image, in seconds.
        kind: Kind of step for the profile's lines, such as "image". "" if no lines go with it.
        timed_by: Its clock.
        latency_s: Time from the end of the part before it to its start at the outputs, in seconds.
        pulses: The times at which it turns lines on itself.
    """

    label: str
    duration_s: float
    min_duration_s: float
    n_images: int = 0
    exposure_s: float = 0.0
    kind: str = ""
    timed_by: TimedBy = COMPUTER
    latency_s: float = 0.0
    pulses: Pulses = field(default_factory=dict[str, Sequence[Span]])
