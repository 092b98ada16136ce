"""Passes a run's images to a planner or detector again, and compares the results with the recorded ones."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.assemble import Assembly, assemble_recorded
from labseq.assembly.lab import construct, parallelism_of
from labseq.assembly.occupancies import image_before
from labseq.assembly.options import Options
from labseq.assembly.planning import call_planner
from labseq.assembly.plugin_choice import ChosenPlugin, changed_settings, resolve
from labseq.assembly.point import Point
from labseq.assembly.recorded import calibrations_of, files_of, machine_of
from labseq.config.addresses import Override, split_overrides
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError, collecting
from labseq.guard import Guard
from labseq.messages import clean, format_plugin_error
from labseq.model import (
    CycleRecord,
    MotionSpec,
    Plan,
    PlanReport,
    RandomStream,
    SiteGrid,
    StageTiming,
    TargetPattern,
)
from labseq.model.estimate import mean
from labseq.motion import check_plan
from labseq.roles import Context, Detector, NeedsWarmUp, Planner
from labseq.settings import Choice


@dataclass(frozen=True, slots=True)
class ReplayedImage:
    """An image whose frame was recorded, and the result of a detector on this frame.

    Attributes:
        shot: Index of the shot, from 0.
        image: Index of the image in the shot, from 0.
        n_atoms: Number of atoms detected in the run.
        n_atoms_replayed: Number of atoms detected in the replay.
        n_appeared: Number of sites with an atom in the replay only.
        n_vanished: Number of sites with an atom in the run only.
        confidence: Mean confidence in the run.
        confidence_replayed: Mean confidence in the replay.
        n_atoms_true: True number of atoms after the shot's last image. None if unknown.
    """

    shot: int
    image: int
    n_atoms: int
    n_atoms_replayed: int
    n_appeared: int
    n_vanished: int
    confidence: float
    confidence_replayed: float
    n_atoms_true: int | None


@dataclass(slots=True, eq=False)
class ReplayedImages:
    """Results of a detector on the frames of a run.

    Attributes:
        images: Each image whose frame was recorded.
        appeared: Number of images with an atom in the replay only, int64 (n_rows, n_cols).
        vanished: Number of images with an atom in the run only, int64 (n_rows, n_cols).
        n_without_frame: Number of images whose frame was not recorded.
        failures: Index of a shot and of an image -> the detector's error.
    """

    images: list[ReplayedImage]
    appeared: NDArray[np.int64]
    vanished: NDArray[np.int64]
    n_without_frame: int = 0
    failures: dict[tuple[int, int], str] = field(default_factory=dict[tuple[int, int], str])

    @classmethod
    def none(cls, shape: tuple[int, int]) -> ReplayedImages:
        """Empty results to which shots are added."""
        return cls([], np.zeros(shape, np.int64), np.zeros(shape, np.int64))

    @property
    def n_differing(self) -> int:
        """Number of differing sites, summed over all images."""
        return int(self.appeared.sum() + self.vanished.sum())

    def add(self, shot: Shot, detector: Detector) -> None:
        """Apply a detector to the frames of a shot, and add the results.

        Raises:
            RecordingError: The shot cannot be read.
        """
        images, truth = shot.record().images, shot.readings.get("simulation.n_atoms_true")
        for i, image in enumerate(images):
            if image.frame is None:
                self.n_without_frame += 1
                continue
            try:
                occupancy, confidence, *_ = detector.detect(image.frame)
                replayed = np.asarray(occupancy, np.bool_).reshape(image.occupancy.shape)
                replayed_confidence = float(np.mean(confidence))
            except (Exception, SystemExit) as error:  # noqa: BLE001 - a plugin may raise anything
                self.failures[shot.index, i] = format_plugin_error(error)
                continue
            appeared, vanished = replayed & ~image.occupancy, image.occupancy & ~replayed
            self.appeared += appeared
            self.vanished += vanished
            is_last = i == len(images) - 1
            self.images.append(
                ReplayedImage(
                    shot=shot.index,
                    image=i,
                    n_atoms=int(np.count_nonzero(image.occupancy)),
                    n_atoms_replayed=int(np.count_nonzero(replayed)),
                    n_appeared=int(np.count_nonzero(appeared)),
                    n_vanished=int(np.count_nonzero(vanished)),
                    confidence=float(np.mean(image.confidence)),
                    confidence_replayed=replayed_confidence,
                    n_atoms_true=int(truth) if is_last and truth is not None else None,
                )
            )


@dataclass(frozen=True, slots=True)
class PlanCounts:
    """Number of moves, durations and filling of a plan.

    Attributes:
        n_batches: Number of batches.
        n_atom_moves: Number of atom moves.
        duration_s: From the start of the cycle to the end of its last batch.
        planning_s: Planning time, on this computer or, if recorded, on the run's computer. nan if unknown.
        filling: Filling of the target after the plan, if no atom is lost.
        meets_target: Whether the target is met after the plan, if no atom is lost.
    """

    n_batches: int
    n_atom_moves: int
    duration_s: float
    planning_s: float
    filling: float
    meets_target: bool

    @classmethod
    def of(cls, plan: Plan, report: PlanReport, target: TargetPattern, planning_s: float) -> PlanCounts:
        """The numbers of a checked plan."""
        filling = 1.0 - report.n_defects / target.n_atoms if target.n_atoms else 1.0
        return cls(
            plan.n_batches, plan.n_atom_moves, report.duration_s, planning_s, filling, report.meets_target
        )


@dataclass(frozen=True, slots=True)
class ReplayedPlan:
    """A recorded plan, and the plan of the replayed planner for the same image.

    Attributes:
        shot: Index of the shot, from 0.
        step: Index of the step in the shot.
        cycle: Index of the cycle in its step.
        recorded: The plan of the run.
        replayed: The plan of the replay. None if the planner failed, or its plan breaks a rule.
        same: Whether both plans are the same, move by move.
        failure: Why there is no plan of the replay, or "".
    """

    shot: int
    step: int
    cycle: int
    recorded: PlanCounts
    replayed: PlanCounts | None
    same: bool
    failure: str = ""


def mean_counts(plans: Sequence[PlanCounts]) -> dict[str, Any]:
    """Means over several plans, by the names of :class:`PlanCounts`. Unknown times are left out.

    Returns:
        The means, ``n_plans``, and ``n_met``, the number of plans that meet the target if no atom is lost.
    """
    names = ("n_batches", "n_atom_moves", "duration_s", "planning_s", "filling")
    values = {name: np.array([getattr(plan, name) for plan in plans], np.float64) for name in names}
    means = {name: mean(numbers[~np.isnan(numbers)]) for name, numbers in values.items()}
    return {"n_plans": len(plans), "n_met": sum(plan.meets_target for plan in plans), **means}


def _replay_plans(shot: Shot, planner: Planner, pipeline: _Pipeline, grid: SiteGrid) -> list[ReplayedPlan]:
    """Plan again for every image of a shot for which a plan was recorded.

    Raises:
        RecordingError: The shot cannot be read.
    """
    plans: list[ReplayedPlan] = []
    guard, name = Guard(), pipeline.choices["planner"].entry.name
    dop = parallelism_of(pipeline.choices["planner"], planner, pipeline.motion)
    for cycle in shot.cycles:
        image = image_before(cycle, shot.images)
        if image is None:
            continue
        recorded = PlanCounts.of(cycle.plan, cycle.report, shot.target, _planning_s(shot.timing, cycle))
        replayed, same, failure = None, False, ""
        try:
            start_s = perf_counter()
            # on the recorded occupancy, because a replayed detector does not change the planner's input
            plan = call_planner(planner, name, image.occupancy, shot.target, guard)
            planning_s = perf_counter() - start_s
            report = check_plan(plan, image.occupancy, shot.target, dop, grid, pipeline.motion, name)
            replayed, same = PlanCounts.of(plan, report, shot.target, planning_s), plan.is_same(cycle.plan)
        except LabseqError as error:
            failure = str(error)
        plans.append(ReplayedPlan(shot.index, cycle.step, cycle.cycle, recorded, replayed, same, failure))
    guard.end()
    return plans


def _planning_s(timing: Sequence[StageTiming], cycle: CycleRecord) -> float:
    """The planning time on the run's computer, in seconds. nan if not recorded."""
    place = ("plan", cycle.step, cycle.cycle)
    return next(
        (stage.host_s for stage in timing if (stage.stage, stage.step, stage.cycle) == place), math.nan
    )


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """The planner and detector to replay, from the command line.

    If neither is given, the run's own planner and detector are replayed.

    Attributes:
        planner: Another planner, with its default settings. None for the run's own.
        degree_of_parallelism: The planner's setting of that name.
        detector: Another detector, with its default settings. None for the run's own.
        overrides: ``"planner.key=value"`` and ``"profile.detector.key=value"`` strings.
        shots: The shots to replay, counted from 0, such as "3,5-9". None for all.
    """

    planner: str | None = None
    degree_of_parallelism: int | None = None
    detector: str | None = None
    overrides: Sequence[str] = ()
    shots: str | None = None

    def changes(self) -> dict[str, list[Override]]:
        """The changes to the run: "planner" and "detector" -> overrides. Unchanged roles are missing.

        Raises:
            ConfigError: An override changes something else.
        """
        changes: dict[str, list[Override]] = {"planner": [], "detector": []}
        for kind, name in (("planner", self.planner), ("detector", self.detector)):
            if name is not None:
                changes[kind] += [Override(kind, "{}", f"--{kind} {name}")]
                changes[kind] += [Override(f"{kind}.use", name, f"--{kind} {name}")]
        if (dop := self.degree_of_parallelism) is not None:
            changes["planner"].append(Override("planner.degree_of_parallelism", str(dop), f"--dop {dop}"))
        for_sequence, for_profile = split_overrides(self.overrides)
        for kind, options in (("planner", for_sequence), ("detector", for_profile)):
            for override in options:
                if not override.address.startswith(f"{kind}."):
                    problem = "a replay can only change the planner and the detector"
                    expected = "an address that begins with 'planner.' or 'profile.detector.'"
                    raise ConfigError(Problem(problem, override.source, expected=expected))
                changes[kind].append(override._replace(origin=override.source))
        return {kind: options for kind, options in changes.items() if options}


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """Results of replaying a run's images.

    Attributes:
        run: The run.
        is_own: True if the run's own planner and detector were replayed, so that all results must agree.
        used: "planner" or "detector" -> the replayed plugin. For a scan, at its first point.
        changed: "planner" or "detector" -> settings that differ from the defaults.
        n_shots: Number of shots that were read.
        plans: Each recorded plan, and the replayed plan for the same image.
        images: Results of the detector on the recorded frames.
        unreadable: Index of a shot -> why it could not be read.
    """

    run: Run
    is_own: bool
    used: dict[str, dict[str, Any]]
    changed: dict[str, dict[str, Any]]
    n_shots: int
    plans: tuple[ReplayedPlan, ...]
    images: ReplayedImages
    unreadable: dict[int, str]

    @property
    def is_reproduced(self) -> bool:
        """Whether all results agree with the recorded ones."""
        plans_same = all(plan.same for plan in self.plans)
        return plans_same and not self.images.n_differing and not self.images.failures and not self.unreadable


@dataclass(frozen=True, slots=True)
class _Pipeline:
    """The planner and detector for the images of a point of the scan, by role."""

    plugins: dict[str, Any]
    choices: dict[str, ChosenPlugin]
    motion: MotionSpec
    streams: tuple[RandomStream, ...]


class _Replayer:
    """Constructs planner and detector once for each set of settings."""

    def __init__(self, run: Run, assembly: Assembly, changes: dict[str, list[Override]]) -> None:
        self.grid = machine_of(run).grid
        self._seed, self._host, self._changes = run.seed, assembly.hardware.host, changes
        self._calibrations = calibrations_of(run)
        self._pipelines: dict[tuple[int, int], tuple[Point, _Pipeline]] = {}

    def at(self, point: Point) -> _Pipeline:
        if point.lab_key not in self._pipelines:
            self._pipelines[point.lab_key] = point, self._make(point)
        return self._pipelines[point.lab_key][1]

    def _make(self, point: Point) -> _Pipeline:
        recorded = {"planner": point.planner, "detector": point.hardware.chosen["detector"]}
        choices = {
            kind: self._changed(kind, recorded[kind])
            for kind in recorded
            if kind in (self._changes or recorded)
        }
        motion = point.hardware.profile.motion
        context = Context(grid=self.grid, motion=motion, calibrations=self._calibrations)
        plugins, streams = construct(choices, context, self._seed)
        for plugin in plugins.values():
            if isinstance(plugin, NeedsWarmUp):  # or the first planning time would include compiling
                plugin.warm()
        return _Pipeline(plugins, choices, motion, streams)

    def _changed(self, kind: str, recorded: ChosenPlugin) -> ChosenPlugin:
        """The run's own planner or detector, or its replacement."""
        options = self._changes.get(kind)
        if not options:
            return recorded
        assert recorded.document is not None
        with collecting() as problems:
            document = recorded.document.override_all(options, problems, may_add=(kind,))
        return resolve(self._host, document, kind, document.validate(Choice, (kind,)).placed(kind))


def replay(run: Run, request: ReplayRequest, *, announce: Callable[[float], None] = lambda _: None) -> Replay:
    """Pass a run's images to a planner or detector, and compare the results with the recorded ones.

    Settings, calibrations and motion are the run's own, from its folder.

    Args:
        announce: Called before kernels are compiled, with the approximate compile time in seconds.

    Raises:
        ConfigError: The request has an error, or the run can no longer be assembled.
        PluginLoadError: A named plugin failed to load.
        RecordingError: run.json lacks the settings of the run.
    """
    from labseq.kernels.kernel import announcing

    changes, shots = request.changes(), shots_of(run, request.shots)
    assembly = assembly_of(run)
    point_of_shot = assembly.point_of_shot(run.seed)
    replayer = _Replayer(run, assembly, changes)
    plans: list[ReplayedPlan] = []
    images = ReplayedImages.none(replayer.grid.shape)
    unreadable: dict[int, str] = {}
    with announcing(announce):
        choices = replayer.at(assembly.first_point).choices
        for shot in shots:
            pipeline = replayer.at(_point_of(shot, assembly, point_of_shot))
            # a planner that draws random numbers gets the same ones as in the run
            for stream in pipeline.streams:
                stream.begin_shot(shot.index, shot.attempt)
            try:
                if "detector" in pipeline.plugins:
                    images.add(shot, pipeline.plugins["detector"])
                if "planner" in pipeline.plugins:
                    plans += _replay_plans(shot, pipeline.plugins["planner"], pipeline, replayer.grid)
            except RecordingError as error:
                unreadable[shot.index] = str(error)
    return Replay(
        run=run,
        is_own=not changes,
        used={kind: choice.dump() for kind, choice in choices.items()},
        changed={kind: changed_settings(choice.settings) for kind, choice in choices.items()},
        n_shots=len(shots) - len(unreadable),
        plans=tuple(plans),
        images=images,
        unreadable=unreadable,
    )


def _point_of(shot: Shot, assembly: Assembly, point_of_shot: Sequence[int]) -> Point:
    """The settings with which a recorded shot was taken."""
    if assembly.search is None:
        return assembly.at(point_of_shot[shot.index])
    return assembly.search.at(assembly.search.values_in(shot.row.parameters))


def assembly_of(run: Run) -> Assembly:
    """Assemble a run from its recorded files and options, without hardware and calibrations.

    Raises:
        ConfigError: The run can no longer be assembled.
        RecordingError: The run's recorded files are missing.
    """
    options = replace(Options.of(run.changes), dry_run="fast")
    return assemble_recorded(files_of(run)._replace(calibrations={}), options)


def shots_of(run: Run, text: str | None) -> list[Shot]:
    """The shots of a selection such as "3,5-9", counted from 0.

    Raises:
        ConfigError: The text is not such a selection, or a shot does not exist.
    """
    if text is None:
        return list(run.shots)
    by_index = {shot.index: shot for shot in run.shots}
    return [by_index[index] for index in sorted({*_indices(text, by_index)})]


def _indices(text: str, existing: Collection[int]) -> Iterator[int]:
    source = clean(f"--shots {text}")
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", part)
        if match is None:
            raise ConfigError(
                Problem(f"'{clean(part)}' is not a shot", source, expected="numbers such as 3,5-9")
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(Problem(f"{first}-{last} goes backwards", source, expected=f"{last}-{first}"))
        for index in range(first, last + 1):
            if index not in existing:
                expected = f"{min(existing)} to {max(existing)}" if existing else "none: the run has no shots"
                raise ConfigError(Problem(f"there is no shot {index}", source, expected=expected))
            yield index
