"""`labseq check`: computes timeline, duration, disk space and warnings of a run, without opening a device."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import ConfigError, LabseqError, Problem
from labseq.guard import Guard
from labseq.model import TimelineEntry
from labseq.motion import check_plan
from labseq.roles import Step, find_leader, offers
from labseq.sequencer.lab import Lab
from labseq.sequencer.lines import spans_on
from labseq.sequencer.run import plan_timelines
from labseq.session.assembly import Assembly
from labseq.session.scan import Point
from labseq.units import format_quantity

if TYPE_CHECKING:
    from labseq.session.session import Session


def check_steps(assembly: Assembly, points: Iterable[Point], build: Callable[[Point], Lab]) -> None:
    """Have every step check its settings against the devices; nothing is opened.

    Args:
        assembly: The run.
        points: The points of its scan.
        build: Constructs the devices of a point.

    Raises:
        ConfigError: All settings that do not fit the devices, with their place.
    """
    if not any(offers(step, "check_devices") for _, step in assembly.steps):
        return
    labs: dict[int, Lab] = {}
    problems: dict[str, Problem] = {}
    guard = Guard()
    for point in points:
        lab = labs.get(id(point.hardware)) or labs.setdefault(id(point.hardware), build(point))
        devices = dict(lab.hardware())
        for spec, (name, step) in zip(assembly.sequence.shot, point.steps, strict=True):
            for setting, what in _wrong_settings(guard, lab.timeouts.call_s, name, step, devices).items():
                problem = assembly.document.problem((*spec.loc, setting) if setting else spec.loc, what)
                problems[str(problem)] = problem
    guard.end()
    if problems:
        raise ConfigError([*problems.values()])


def _wrong_settings(
    guard: Guard, timeout_s: float, name: str, step: Step, devices: Mapping[str, object]
) -> dict[str, str]:
    """Setting -> what is wrong with it, as a step says; "" for a step that fails to say it."""
    if not offers(step, "check_devices"):
        return {}
    try:
        found = guard.call(f"step '{name}'", timeout_s, step.check_devices, devices)
        return {str(setting): str(what) for setting, what in dict(found).items()}
    except LabseqError as failure:
        return {"": str(failure)}
    except (TypeError, ValueError):
        return {"": f"check_devices() of step '{name}' returned no mapping"}


def timeout_warnings(
    assembly: Assembly, timeline: Sequence[tuple[str, Sequence[TimelineEntry]]]
) -> list[Problem]:
    """Warnings about steps that may take longer than the timeout of their policy.

    Args:
        assembly: The run.
        timeline: Name of each step and its bars.
    """
    problems: list[Problem] = []
    for spec, policy, (_, bars) in zip(assembly.sequence.shot, assembly.policy.steps, timeline, strict=True):
        longest_s = sum(bar.duration_s for bar in bars)
        if longest_s > policy.timeout_s:
            longest = format_quantity(longest_s, "time")
            what = f"the step takes up to {longest}, longer than its timeout of "
            what += format_quantity(policy.timeout_s, "time")
            place = (*spec.policy_loc, "timeout")
            problems.append(assembly.document.problem(place, what, f"more than {longest}"))
    return problems


N_LOADINGS: Final = 200
"""Maximum number of random loadings for which the planner is run."""
MAX_WAIT_S: Final = 5.0
"""Time after which no further loading is tried, in seconds of real time."""
PAPERS_LOADING: Final = 0.75
"""Loading probability if the profile has no simulation that reports it."""
SHOT_OVERHEAD_BYTES: Final = 60_000
"""Approximate size of a shot file without frames, in bytes."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The planner's results for random loadings.

    Attributes:
        n_loadings: Number of loadings.
        n_filled: Number of loadings with enough atoms and a plan that fills the target.
        duration_s: float64 (n_loadings,), from the start of a cycle to the end of its last batch.
        first_batch_s: float64 (n_loadings,), the same for its first batch.
    """

    n_loadings: int
    n_filled: int
    duration_s: NDArray[np.float64]
    first_batch_s: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Timeline, duration, disk space and warnings of a run, before it starts.

    Attributes:
        timeline: Name of each step and its bars; for a scan, like all but ``run_s``, at its first point.
        n_shots: Shots of the run.
        n_points: Points of the scan that these shots are at; None without a scan.
        run_s: Minimum and maximum duration of the run, in seconds.
        warnings: Settings that are allowed but probably not intended, with their place in the files.
        rehearsal: The planner's results for random loadings; None without a rearrangement.
        shot_bytes: Size of a shot on disk at most; None if the camera does not report its frame shape.
        lines: Name of each line -> when it is on in the longest shot, as (start, end) in seconds.
    """

    timeline: Sequence[tuple[str, Sequence[TimelineEntry]]]
    n_shots: int
    n_points: int | None
    run_s: tuple[float, float]
    warnings: tuple[Problem, ...]
    rehearsal: Rehearsal | None
    shot_bytes: int | None
    lines: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict[str, Any])

    @property
    def bars(self) -> list[TimelineEntry]:
        """The bars of all steps."""
        return [bar for _, bars in self.timeline for bar in bars]

    @property
    def longest_shot_s(self) -> float:
        """Duration of a shot that uses every cycle and window."""
        return sum(bar.duration_s for bar in self.bars)

    @property
    def shortest_shot_s(self) -> float:
        """Duration of a shot that skips every optional cycle and window."""
        return sum(bar.min_duration_s for bar in self.bars)

    @property
    def n_images(self) -> int:
        """Maximum number of images of a shot."""
        return sum(bar.n_images for bar in self.bars)


def check(session: Session) -> CheckReport:
    """Compute timeline, duration, disk space and warnings of a run; no device is opened.

    Args:
        session: An opened session; its sequence and profile have no errors.

    Raises:
        ConfigError: A step sends a command that its device does not know.
    """
    assembly = session.assembly
    check_steps(assembly, session.scan_run.each(), session.build_lab)
    lab = session.build_lab()
    timeline = session.timeline()
    windows = _windows(assembly.steps)
    if windows:
        session.warm(lab, devices=False)
    rehearsal, failure = _rehearse(lab) if windows else (None, "")
    warnings = [Problem(text) for text in assembly.warnings]
    document = assembly.document
    if failure:
        warnings.append(document.problem((*assembly.sequence.planner.loc, "use"), failure))
    if rehearsal is not None:
        warnings += _window_warnings(session, windows, rehearsal)
    warnings += _exposure_warnings(session, lab, timeline)
    warnings += _judgement_warnings(session, [number for number, _ in windows])
    warnings += _parallelism_warnings(session)
    warnings += _deadline_warnings(session, lab, timeline)
    warnings += timeout_warnings(assembly, timeline)
    for point in session.scan_run.representative_labs():
        session.build_lab(point)  # whether the constructors accept the settings
    warnings += [Problem(text) for text in assembly.hardware.host.notes]
    return CheckReport(
        timeline,
        assembly.sequence.shots,
        None if assembly.scanned is None else session.scan_run.n_points,
        _run_s(session, lab),
        tuple(warnings),
        rehearsal,
        _shot_bytes(session, lab, timeline),
        spans_on(lab.line_specs, (bar for _, bars in timeline for bar in bars)),
    )


def _run_s(session: Session, lab: Lab) -> tuple[float, float]:
    """Minimum and maximum duration of the run, with each shot at its scan point, or at any corner of it."""
    guard = Guard()
    min_duration_s, most_s = list[float](), list[float]()
    for point, n in session.scan_run.counted():
        context = replace(lab.step_context, motion=point.hardware.profile.motion)
        bars = [bar for bars in plan_timelines(lab, guard, point.steps, context) for bar in bars]
        min_duration_s.append(n * sum(bar.min_duration_s for bar in bars))
        most_s.append(n * sum(bar.duration_s for bar in bars))
    guard.end()
    return (
        (min(min_duration_s), max(most_s))
        if session.scan_run.is_adaptive
        else (sum(min_duration_s), sum(most_s))
    )


def _windows(steps: Sequence[tuple[str, Step]]) -> list[tuple[int, tuple[float, ...]]]:
    """Step number and window per cycle of each rearrangement step."""
    windows = ((number, getattr(step, "windows_s", ())) for number, (_, step) in enumerate(steps))
    return [(number, windows_s) for number, windows_s in windows if windows_s]


def _rehearse(lab: Lab) -> tuple[Rehearsal | None, str]:
    """Plan for random loadings; returns the results, or the planner's failure as text."""
    loading = None
    if lab.simulation is not None and offers(lab.simulation, "loading_probability"):
        loading = lab.simulation.loading_probability
    if loading is None:
        loading = PAPERS_LOADING
    rng, guard = np.random.default_rng(0), Guard()
    durations, firsts, n_filled = list[float](), list[float](), 0
    deadline = time.monotonic() + MAX_WAIT_S
    try:
        while len(durations) < N_LOADINGS and time.monotonic() < deadline:
            occupancy = rng.random(lab.grid.shape) < loading
            plan = guard.call("planner", lab.timeouts.plan_s, lab.planner.plan, occupancy.copy(), lab.target)
            report = check_plan(
                plan, occupancy, lab.target, lab.degree_of_parallelism, lab.grid, lab.motion, lab.planner_name
            )
            n_filled += report.meets_target
            durations.append(report.duration_s)
            firsts.append(float(report.batch_end_s[0]) if len(report.batch_end_s) else 0.0)
    except LabseqError as error:
        return None, f"on a random loading of {loading:.0%} of the sites: {error}"
    finally:
        guard.end()
    return Rehearsal(len(durations), n_filled, np.array(durations), np.array(firsts)), ""


def _window_warnings(
    session: Session, windows: Sequence[tuple[int, Sequence[float]]], rehearsal: Rehearsal
) -> list[Problem]:
    document, sequence = session.assembly.document, session.assembly.sequence
    problems: list[Problem] = []
    for number, window_s in windows:
        loc = (*sequence.shot[number].loc, "window")
        first, shortest = window_s[0], min(window_s)
        n_fit = int(np.count_nonzero(rehearsal.duration_s <= first + 1e-9))
        enough = format_quantity(float(np.quantile(rehearsal.duration_s, 0.95)), "time")
        if 2 * n_fit < rehearsal.n_loadings:
            what = f"the first cycle's window of {format_quantity(first, 'time')} is too short for most plans"
            share = f"{n_fit} of {rehearsal.n_loadings} fit"
            problems.append(
                document.problem(loc, f"{what} ({share})", f"about {enough}, which 19 of 20 fit into")
            )
        elif shortest < np.median(rehearsal.first_batch_s):
            what = f"a window of {format_quantity(shortest, 'time')} is over before the first batch is"
            problems.append(document.problem(loc, what, "more than the overheads of a cycle and a batch"))
    if rehearsal.n_filled < 0.9 * rehearsal.n_loadings:
        what = f"only {rehearsal.n_filled} of {rehearsal.n_loadings} loadings allow to fill the target"
        problems.append(document.problem(sequence.target.loc, what, "a smaller target, or better loading"))
    return problems


def _exposure_warnings(
    session: Session, lab: Lab, timeline: Sequence[tuple[str, Sequence[TimelineEntry]]]
) -> list[Problem]:
    limit_s = lab.step_context.camera.max_exposure_s
    document, sequence = session.assembly.document, session.assembly.sequence
    problems: list[Problem] = []
    for spec, (_, bars) in zip(sequence.shot, timeline, strict=True):
        longest_s = max((bar.exposure_s for bar in bars), default=0.0)
        if longest_s > limit_s:
            what = f"an exposure of {format_quantity(longest_s, 'time')} is more than the camera can do"
            expected = f"at most {format_quantity(limit_s, 'time')}"
            problems.append(document.problem((*spec.loc, "exposure"), what, expected))
    return problems


def _judgement_warnings(session: Session, rearrangements: Sequence[int]) -> list[Problem]:
    """Warn if no ``image`` step judges the shots; a fixed number of cycles is judged by its own images."""
    assembly = session.assembly
    images = [n for n, (_, step) in enumerate(assembly.steps) if step.takes_image and n not in rearrangements]
    if not rearrangements or max(images, default=-1) > rearrangements[-1]:
        return []
    if getattr(assembly.steps[rearrangements[-1]][1], "judges_shot", False):
        return []
    loc = assembly.sequence.shot[rearrangements[-1]].loc
    what = "no image follows the last rearrangement, so the shots are not judged"
    return [assembly.document.problem(loc, what, "an 'image' step at the end of the shot", key=True)]


def _parallelism_warnings(session: Session) -> list[Problem]:
    assembly = session.assembly
    asked = getattr(assembly.planner.settings, "degree_of_parallelism", None)
    limit = assembly.hardware.profile.motion.max_tweezers
    if not isinstance(asked, int) or asked <= limit:
        return []
    loc = (*assembly.sequence.planner.loc, "degree_of_parallelism")
    what = f"degree_of_parallelism is {asked}, but the profile allows {limit} mobile tweezers at once"
    return [assembly.document.problem(loc, what, f"at most {limit}")]


def _deadline_warnings(
    session: Session, lab: Lab, timeline: Sequence[tuple[str, Sequence[TimelineEntry]]]
) -> list[Problem]:
    """The steps after a wait for a signal, up to the next wait or the end, must fit into its deadline."""
    problems: list[Problem] = []
    steps = [step for _, step in session.assembly.steps]
    waits = [bool(getattr(step, "signal", "")) for step in steps]
    for number, step in enumerate(steps):
        if not waits[number]:
            continue
        try:
            name, leader = find_leader(dict(lab.hardware()), step.device)
        except ConfigError:  # no wait for a signal: another step's own attribute
            continue
        until = next((n for n in range(number + 1, len(steps)) if waits[n]), None)
        longest_s = sum(bar.duration_s for _, bars in timeline[number + 1 : until] for bar in bars)
        if longest_s > leader.deadline_s:
            longest = format_quantity(longest_s, "time")
            what = f"what follows takes up to {longest}, but '{name}' must be answered within "
            what += format_quantity(leader.deadline_s, "time")
            loc = (*session.assembly.sequence.shot[number].loc, "for")
            hint = "raise 'deadline' in the profile, or the other system is informed that the shot failed"
            problems.append(session.assembly.document.problem(loc, what, hint=hint))
    return problems


def _shot_bytes(
    session: Session, lab: Lab, timeline: Sequence[tuple[str, Sequence[TimelineEntry]]]
) -> int | None:
    shape = lab.step_context.camera.frame_shape
    n_images = sum(bar.n_images for _, bars in timeline for bar in bars)
    kept = {"all": n_images, "last": min(1, n_images), "none": 0}[session.assembly.sequence.record_frames]
    if shape is None and kept:
        return None
    return SHOT_OVERHEAD_BYTES + kept * 2 * math.prod(shape or (0,))
