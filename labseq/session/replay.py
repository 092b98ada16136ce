"""A run's images once more: through another planner or detector, or the same ones."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from labseq.config import Choice, Override, split_overrides
from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.model import CalibrationEntry, MotionSpec, RandomStream, SiteGrid
from labseq.recording import Run, Shot
from labseq.recording.folders import PROFILE_FILE, SEQUENCE_FILE
from labseq.roles import Detector, NeverStopped, Planner, NeedsWarmUp
from labseq.sequencer import StopFlag
from labseq.session.adaptive_run import course_of, point_of
from labseq.session.assembly import Assembly, assemble
from labseq.session.choosing import ChosenPlugin, resolve
from labseq.session.constructing import construct
from labseq.session.labs import parallelism_of
from labseq.session.options import Options
from labseq.session.planning import changed_settings
from labseq.session.recorded import calibrations_of, stored_text, machine_of
from labseq.session.replay_images import ReplayedImages
from labseq.session.replay_plans import ReplayedPlan, replay_plans
from labseq.session.scan import Point
from labseq.session.setting_up import RecordedSetup

_RANGE: Final = re.compile(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?")


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """What is to be tried, in the words of the command line.

    If that is nothing, the run's own planner and detector are.

    Attributes:
        planner: Another planner, with its default settings; None for the run's own.
        degree_of_parallelism: The planner's setting of that name.
        detector: Another detector, with its default settings; None for the run's own.
        overrides: ``"planner.key=value"`` and ``"profile.detector.key=value"`` strings.
        shots: Which shots, counted from 1: "3,5-9"; None for all.
    """

    planner: str | None = None
    degree_of_parallelism: int | None = None
    detector: str | None = None
    overrides: Sequence[str] = ()
    shots: str | None = None

    def changes(self) -> dict[str, list[Override]]:
        """What differs from the run: "planner" and "detector" -> overrides; neither where it is the same.

        Raises:
            ConfigError: An override is of something else.
        """
        found: dict[str, list[Override]] = {"planner": [], "detector": []}
        for kind, name in (("planner", self.planner), ("detector", self.detector)):
            if name is not None:
                found[kind] += [Override(kind, "{}", f"--{kind} {name}")]
                found[kind] += [Override(f"{kind}.use", name, f"--{kind} {name}")]
        if (dop := self.degree_of_parallelism) is not None:
            found["planner"].append(Override("planner.degree_of_parallelism", str(dop), f"--dop {dop}"))
        for_sequence, for_profile = split_overrides(self.overrides)
        for kind, options in (("planner", for_sequence), ("detector", for_profile)):
            for one in options:
                if not one.address.startswith(f"{kind}."):
                    what = "a replay changes nothing but the planner and the detector"
                    expected = "an address that begins with 'planner.' or 'profile.detector.'"
                    raise ConfigError(Problem(what, one.source, expected=expected))
                found[kind].append(one._replace(origin=one.source))
        return {kind: options for kind, options in found.items() if options}


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """What came of a run's images.

    Attributes:
        run: The run.
        is_own: Whether its own planner and detector were tried: all must come out the same.
        used: "planner" or "detector" -> what was tried; of a scan, at its first point.
        changed: Those of its settings that are not the defaults.
        n_shots: Shots that were read.
        plans: Each recorded plan, and what the planner plans on the same image.
        images: What the detector sees on the frames that were kept.
        unreadable: Index of a shot -> why it was left out.
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
        """Whether everything came out as it was recorded."""
        plans_same = all(plan.same for plan in self.plans)
        return plans_same and not self.images.n_differing and not self.images.failures and not self.unreadable


@dataclass(slots=True)
class _Pipeline:
    """What images go through at a point of the scan."""

    planner: Planner | None
    planner_name: str
    degree_of_parallelism: int
    detector: Detector | None
    motion: MotionSpec
    chosen: dict[str, ChosenPlugin]
    streams: tuple[RandomStream, ...]


@dataclass(slots=True)
class _Replayer:
    """Makes what images go through, once for each kind of point."""

    run: Run
    assembly: Assembly
    grid: SiteGrid
    calibrations: dict[str, CalibrationEntry]
    changes: dict[str, list[Override]]
    _crews: dict[tuple[int, int], _Pipeline] = field(default_factory=dict[tuple[int, int], _Pipeline])
    _points: list[Point] = field(default_factory=list[Point])  # alive, so that no id is given twice

    def at(self, point: Point) -> _Pipeline:
        key = id(point.planner), id(point.bench)
        if key not in self._crews:
            self._points.append(point)
            self._crews[key] = self._make(point)
        return self._crews[key]

    def _make(self, point: Point) -> _Pipeline:
        own = {"planner": point.planner, "detector": point.bench.chosen["detector"]}
        names = self.changes or own
        chosen = {kind: self._changed(kind, one) for kind, one in own.items() if kind in names}
        motion = point.bench.profile.motion
        made, streams = construct(
            chosen, self.grid, motion, NeverStopped(), self.run.seed, calibrations=self.calibrations
        )
        for one in made.values():
            if isinstance(one, NeedsWarmUp):
                one.warm()
        planner = made.get("planner")
        return _Pipeline(
            planner=planner,
            planner_name=chosen["planner"].entry.name if planner is not None else "",
            degree_of_parallelism=parallelism_of(chosen["planner"], planner, motion)
            if planner is not None
            else 0,
            detector=made.get("detector"),
            motion=motion,
            chosen=chosen,
            streams=streams,
        )

    def _changed(self, kind: str, own: ChosenPlugin) -> ChosenPlugin:
        """The run's own planner or detector, or what is tried in place of it."""
        options = self.changes.get(kind)
        if not options:
            return own
        assert own.document is not None
        document = own.document.override_all(options, may_add=(kind,))
        choice = document.validate(Choice, (kind,)).placed(kind)
        return resolve(self.assembly.bench.host, document, kind, choice)


def replay(run: Run, request: ReplayRequest, *, announce: Callable[[str], None] = lambda _: None) -> Replay:
    """Let a run's images go through a planner or detector, and compare with what was done.

    Settings, calibrations and motion are the run's own, from its folder.

    Args:
        run: The run, finished or not.
        request: What is to be tried.
        announce: Called with the name of a module before its kernels are compiled.

    Raises:
        ConfigError: Something in the request is wrong, or the run cannot be put together today.
        PluginLoadError: A plugin that is named failed to load.
        RecordingError: The run does not say what it was taken with.
    """
    from labseq.kernels.compile import announcing

    changes, wanted = request.changes(), shots_of(run, request.shots)
    assembly = assembly_of(run)
    course = course_of(assembly, run.seed, StopFlag())
    replayer = _Replayer(run, assembly, machine_of(run).grid, calibrations_of(run), changes)
    plans: list[ReplayedPlan] = []
    images = ReplayedImages.none(replayer.grid.shape)
    unreadable: dict[int, str] = {}
    with announcing(announce):
        chosen = replayer.at(assembly.begun).chosen
        for shot in wanted:
            crew = replayer.at(point_of(assembly, shot, course))
            for stream in crew.streams:
                stream.begin_shot(shot.index, shot.attempt)
            try:
                if crew.detector is not None:
                    images.add(shot, crew.detector)
                if crew.planner is not None:
                    name, dop = crew.planner_name, crew.degree_of_parallelism
                    plans += replay_plans(shot, crew.planner, name, dop, replayer.grid, crew.motion)
            except RecordingError as error:
                unreadable[shot.index] = str(error)
    return Replay(
        run=run,
        is_own=not changes,
        used={kind: one.dump() for kind, one in chosen.items()},
        changed={kind: changed_settings(one.settings) for kind, one in chosen.items()},
        n_shots=len(wanted) - len(unreadable),
        plans=tuple(plans),
        images=images,
        unreadable=unreadable,
    )


def assembly_of(run: Run) -> Assembly:
    """A run put together of its own texts and options, without its hardware and its calibrations.

    Raises:
        ConfigError: That cannot be done today.
        RecordingError: Its texts are gone.
    """
    record = run.record
    options = Options.of(record["overrides"])
    return assemble(
        Path(record["sequence_path"]),
        profile=Path(record["profile_path"]),
        overrides=options.overrides,
        given=options.own(),
        dry_run="fast",
        kept=stored_text(run.path / SEQUENCE_FILE, record["sequence_sha256"]),
        again=RecordedSetup(stored_text(run.path / PROFILE_FILE, record["profile_sha256"]), {}),
    )


def shots_of(run: Run, text: str | None) -> list[Shot]:
    """The shots that are meant by "3,5-9", counted from 1.

    Raises:
        ConfigError: It is no such text, or one of them is not there.
    """
    if text is None:
        return list(run.shots)
    by_number = {shot.index + 1: shot for shot in run.shots}
    return [by_number[number] for number in sorted({*_numbers(text, by_number)})]


def _numbers(text: str, known: Collection[int]) -> Iterator[int]:
    source = clean(f"--shots {text}")
    for part in text.split(","):
        match = _RANGE.fullmatch(part)
        if match is None:
            raise ConfigError(
                Problem(f"'{clean(part)}' is no shot", source, expected="numbers such as 3,5-9")
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ConfigError(Problem(f"{first}-{last} goes backwards", source, expected=f"{last}-{first}"))
        for number in range(first, last + 1):
            if number not in known:
                there_are = f"1 to {max(known)}" if known else "none: the run has no shots"
                raise ConfigError(Problem(f"there is no shot {number}", source, expected=there_are))
            yield number
