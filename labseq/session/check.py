"""`labseq check`, which computes timeline, duration, disk space and warnings without opening a device."""

from __future__ import annotations

import json
import math
import shlex
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, TypeAlias

import numpy as np

from labseq.assembly.assemble import Assembly
from labseq.assembly.lab import WARM_S
from labseq.assembly.plugin_choice import changed_settings
from labseq.assembly.point import Point
from labseq.assembly.wiring import unsuitable_exposures
from labseq.errors import ConfigError, LabseqError, LimitError, Loc, Problem, ProblemCollector, one_of
from labseq.files import free_bytes
from labseq.guard import Guard
from labseq.messages import visible
from labseq.model import COMPUTER, Frame, Plan, TimelineEntry
from labseq.model.lines import NO_PULSES, LineProgram, Pulses
from labseq.motion import tone_program
from labseq.roles import Detector, LeaderDialogue, Step, find_leader
from labseq.sequencer.images import with_waits
from labseq.sequencer.lab import Lab
from labseq.sequencer.lines import line_program, own_duration_s, trigger_line
from labseq.sequencer.run import plan_timeline
from labseq.session.prepared import PreparedRun
from labseq.session.rehearsal import Rehearsal, quantile, rehearse, windows_of
from labseq.units import format_quantity, size_text

N_LOADINGS: Final = 200
"""Maximum number of random loadings for which the planner is run."""
N_LOADINGS_ELSEWHERE: Final = 20
"""The same for later points of a scan. Windows are judged by at least a quarter of it."""
MAX_WAIT_S: Final = 2.0
"""Real time after which no further loading is tried at the first point, and at all others together, in s."""

Timeline: TypeAlias = Sequence[tuple[str, Sequence[TimelineEntry]]]
"""Name and bars of each step."""


class _Checks:
    """The checks of a run. Points with the same settings are checked once."""

    def __init__(self, run: PreparedRun, guard: Guard) -> None:
        self.run = run
        self.guard = guard
        self.problems = ProblemCollector()
        self.rehearsals: dict[tuple[object, ...], list[Rehearsal]] = {}
        self.detectors: list[Detector] = []
        self._labs: dict[tuple[int, int], Lab] = {}
        self._points: dict[tuple[int, ...], _PointCheck] = {}

    def of(self, point: Point) -> _PointCheck:
        """The checks of a point."""
        # by identity, because points share the objects that are the same at both
        key = (*point.lab_key, *(id(step) for _, step in point.steps))
        if key not in self._points:
            if point.lab_key not in self._labs:
                self._labs[point.lab_key] = self.run.build_lab(point)
            self._points[key] = _PointCheck(self, point, self._labs[point.lab_key])
        return self._points[key]

    def raise_problems(self) -> None:
        """Raise the problems, unless the check was stopped, because calls that end early report nothing."""
        self.run.stop_flag.check()
        try:
            self.problems.raise_any()
        except ConfigError as error:
            scanned = self.run.assembly.scanned
            raise error if scanned is None else scanned.scan.explained(error) from None


class _PointCheck:
    """Checks the settings of a point with devices and steps, without an open device."""

    def __init__(self, checks: _Checks, point: Point, lab: Lab) -> None:
        self.checks = checks
        self.point = point
        self.lab = lab
        self.windows = windows_of(point.steps)
        # everything that the plans depend on, which leaves out the last windows
        self.rehearsal_key: tuple[object, ...] = (id(lab), *[*self.windows.values()][:-1])
        self.shot = checks.run.assembly.sequence.shot
        self._guard = checks.guard

    @property
    def rehearsed(self) -> dict[int, Rehearsal]:
        """Step number -> the planner's results for each rearrangement."""
        return dict(zip(self.windows, self.checks.rehearsals[self.rehearsal_key], strict=True))

    @property
    def longest_exposure_s(self) -> float:
        """The longest exposure of a shot, in seconds. 0 without images."""
        return max((bar.exposure_s for _, bars in self.timeline for bar in bars), default=0.0)

    @property
    def shot_s(self) -> tuple[float, float]:
        """Minimum and maximum duration of a shot, in seconds."""
        bars = [bar for _, of_step in self.timeline for bar in of_step]
        return sum(bar.min_duration_s for bar in bars), sum(bar.duration_s for bar in bars)

    def _add(self, loc: Loc, what: str, expected: str = "", hint: str = "") -> None:
        self.checks.problems.add(self.point.document.error(loc, what, expected, hint))

    def _add_to_profile(self, loc: Loc, what: str, expected: str = "", hint: str = "") -> None:
        self.checks.problems.add(self.point.hardware.document.error(loc, what, expected, hint))

    def ask_settings(self) -> None:
        """Have every device check its settings, for example for missing files."""
        for name, device in self.lab.hardware():
            chosen = self.point.hardware.chosen[name]
            problems = self._guard.call(name, WARM_S, device.check_settings)
            for setting, problem in problems.items():
                self._add_to_profile((*chosen.loc, setting), problem.what, problem.expected, problem.hint)

    def ask_steps(self) -> None:
        """Have every step check its settings against the devices."""
        for spec, (name, step) in zip(self.shot, self.point.steps, strict=True):
            for setting, problem in _wrong_settings(self._guard, self.lab, name, step).items():
                within = (int(key) if key.isdecimal() else key for key in setting.split(".") if setting)
                loc = (*spec.loc, *within)
                self._add(loc, problem.what, problem.expected, problem.hint)

    @cached_property
    def timeline(self) -> Timeline:
        """Name and bars of each step, except for steps that cannot lay out theirs."""
        named: list[tuple[str, list[TimelineEntry]]] = []
        for number, (name, step) in enumerate(self.point.steps):
            try:
                named.append((name, plan_timeline(self.lab, self._guard, number, name, step)))
            except LimitError as error:
                self._add(self.shot[number].loc, str(error))
        timelines = with_waits([bars for _, bars in named], self.lab.step_context)
        return [(name, bars) for (name, _), bars in zip(named, timelines, strict=True)]

    def ask_timeline(self) -> None:
        """Have every step lay out its timeline."""
        _ = self.timeline

    def ask_timing(self) -> None:
        """Refuse durations that the computer cannot keep."""
        for number, problem, is_refused in _badly_timed(self):
            if is_refused:
                loc = (*self.shot[number].loc, "duration")
                self._add(loc, problem.what, problem.expected, problem.hint)

    def ask_devices(self) -> None:
        """Have camera and lines check the demands of each step of a shot."""
        for spec, (_, bars) in zip(self.shot, self.timeline, strict=True):
            for bar in {
                (one.kind, one.duration_s, one.exposure_s, repr(one.pulses)): one for one in bars
            }.values():
                try:
                    if bar.exposure_s:
                        self.lab.step_context.camera.check_exposure(bar.exposure_s)
                    if bar.kind and bar.kind != "rearrange":  # its length follows from the plan
                        self._ask_lines(bar.kind, own_duration_s(self.lab.line_specs, bar), bar.pulses)
                except LabseqError as error:
                    self._add((*spec.loc, "exposure" if bar.exposure_s else "duration"), str(error))
        if self.longest_exposure_s:
            self._ask_line_trigger()
            self._ask_images()
            self._ask_timeouts()

    def _ask_images(self) -> None:
        """Check that the camera has a trigger, and that the detector accepts its frames."""
        lab, facts = self.lab, self.lab.step_context.camera
        if "software" not in facts.triggers and trigger_line(lab.line_specs, "camera") is None:
            what = (
                f"the camera has no software trigger, only {one_of(facts.triggers)}, and no line triggers it"
            )
            self._add_to_profile(("camera", "use"), what, "a line with `triggers: camera`")
        if facts.frame_shape is None or lab.detector in self.checks.detectors:
            return
        self.checks.detectors.append(lab.detector)
        image = np.random.default_rng(0).integers(100, 1000, facts.frame_shape, np.uint16)
        try:
            self._guard.call("detector", WARM_S, lab.detector.detect, Frame(image, 1.0, 0.0))
        except LabseqError as error:
            if error.__cause__ is None:  # it refuses the frame, while a failure may be due to the noise on it
                self._add_to_profile(("detector", "use"), str(error))

    def _ask_line_trigger(self) -> None:
        """Check that the exposures suit the line that triggers the camera."""
        context = self.lab.step_context
        if trigger_line(self.lab.line_specs, "camera") is None:
            return
        bars = [(self.shot[n].loc, bar) for n, (_, of_step) in enumerate(self.timeline) for bar in of_step]
        for loc, problem in unsuitable_exposures(context.camera, context.lines_facts, bars):
            add = self._add_to_profile if loc[0] == "camera" else self._add
            add(loc, problem.what, problem.expected, problem.hint)

    def _ask_lines(self, kind: str, duration_s: float, pulses: Pulses = NO_PULSES) -> None:
        lab = self.lab
        if lab.lines is not None:
            program = line_program(lab.line_specs, kind, duration_s, pulses)
            self._guard.call("lines", lab.timeouts.call_s, lab.lines.check_program, program)
            self._check_exclusive(program)

    def _check_exclusive(self, program: LineProgram) -> None:
        """Refuse pulses that turn on mutually exclusive lines of the profile at the same time."""
        lines = self.point.hardware.profile.lines
        for pair in () if lines is None else lines.mutually_exclusive:
            first, second = (program.on[:, program.lines.index(name)] for name in pair)
            if (first & second).any():
                what = f"'{pair[0]}' and '{pair[1]}' are on together, but the profile declares them"
                raise ConfigError(f"{what} mutually exclusive")

    def _ask_timeouts(self) -> None:
        """Check that a timeout in the profile is longer than the exposures."""
        loc, call_s = ("timeouts", "call"), self.lab.timeouts.call_s
        if self.point.hardware.document.get(loc) is not None and call_s < self.longest_exposure_s:
            call, exposure = (format_quantity(s, "time") for s in (call_s, self.longest_exposure_s))
            what = f"device calls time out after {call}, but an exposure takes {exposure}"
            self._add_to_profile(loc, what, f"more than {exposure}")

    def ask_tweezers(self, plans: Iterable[Plan]) -> None:
        """Turn plans into tones, and have the devices check them."""
        lab, loc = self.lab, ("mobile_tweezers", "use")
        for plan in plans:
            try:
                program = tone_program(plan, grid=lab.grid, motion=lab.motion)
                self._guard.call("mobile_tweezers", WARM_S, lab.mobile_tweezers.check_program, program)
                self._ask_lines("rearrange", program.total_duration_s)
            except LimitError as error:
                self._add_to_profile(error.setting or loc, f"moving atoms: {error}")
                return
            except LabseqError as error:
                self._add_to_profile(loc, str(error))
                return


def _badly_timed(point_check: _PointCheck) -> Iterator[tuple[int, Problem, bool]]:
    """Index, problem and refusal of each step whose fixed length the computer cannot keep exactly."""
    timelines = [bars for _, bars in point_check.timeline]
    least = format_quantity(COMPUTER.accuracy_s, "time")
    for number, bars in enumerate(timelines):
        duration_s = sum(bar.duration_s for bar in bars)
        last = bars[-1] if bars else None
        if last is None or not 0 < last.duration_s == last.min_duration_s or last.timed_by != COMPUTER:
            continue
        after = next((bar for later in timelines[number + 1 :] for bar in later[:1]), last)
        late_s = COMPUTER.accuracy_s + after.latency_s
        duration, late = (format_quantity(t, "time") for t in (duration_s, late_s))
        if duration_s < COMPUTER.accuracy_s:
            what = (
                f"{duration} is too short for software timing, which is typically 0.4 ms and sometimes "
                "several ms late"
            )
            by = point_check.lab.step_context.release_by
            hint = "to free the atoms, use the step `release`"
            hint += f", which '{by.name}' times" if by else ""
            hint += ", and to pulse a light, a line that is on only in `wait`"
            yield number, Problem(what, expected=f"at least {least}", hint=hint), True
        elif late_s > 0.1 * duration_s:  # less needs no warning
            what = f"the computer cannot time {duration} exactly, so it may last about {late} longer"
            if after.latency_s:
                what += f", because '{after.label}' begins late at the outputs of '{after.timed_by.name}'"
            yield number, Problem(what), False


def _wrong_settings(guard: Guard, lab: Lab, name: str, step: Step) -> dict[str, Problem]:
    """Setting -> its problem, according to a step. "" is the setting if the step's check fails."""
    devices, timeout_s = dict(lab.hardware()), lab.timeouts.call_s
    try:
        answer = guard.call(f"step '{name}'", timeout_s, step.check_devices, devices, lab.step_context)
        problems = {str(setting): what for setting, what in dict(answer).items()}
        return {key: p if isinstance(p, Problem) else Problem(str(p)) for key, p in problems.items()}
    except LabseqError as failure:
        return {"": Problem(str(failure))}
    except (TypeError, ValueError):
        return {"": Problem(f"check_devices() of step '{name}' did not return a mapping")}


def _timing_warnings(point_check: _PointCheck) -> Iterator[tuple[int, Problem]]:
    """Warnings about durations that the computer keeps only roughly."""
    for number, problem, is_refused in _badly_timed(point_check):
        if not is_refused:
            place = (*point_check.shot[number].loc, "duration")
            yield number, point_check.point.document.problem(place, problem.what)


def _timeout_warnings(point_check: _PointCheck) -> Iterator[tuple[int, Problem]]:
    """Warnings about steps that may take longer than the timeout of their policy."""
    assembly = point_check.checks.run.assembly
    each = zip(assembly.sequence.shot, assembly.policy.steps, point_check.timeline, strict=True)
    for number, (spec, policy, (_, bars)) in enumerate(each):
        longest_s = sum(bar.duration_s for bar in bars)
        if longest_s > policy.limit_s:
            longest = format_quantity(longest_s, "time")
            what = f"the step takes up to {longest}, longer than its timeout of "
            what += format_quantity(policy.limit_s, "time")
            place = (*spec.policy_loc, "timeout")
            yield number, point_check.point.document.problem(place, what, f"more than {longest}")


@dataclass(frozen=True, slots=True)
class CheckReport:
    """Timeline, duration, disk space and warnings of a run, before it starts.

    Attributes:
        timeline: Name and bars of each step. In a scan, all but ``run_s`` refer to the first point.
        n_shots: Shots of the run.
        n_points: Number of scan points that these shots visit. None without a scan.
        run_s: Minimum and maximum duration of the run, in seconds.
        warnings: Settings that are allowed but probably not intended, with their place in the files.
        rehearsal: The planner's results for random loadings. None without a rearrangement.
        shot_bytes: Maximum size of a shot on disk. None if the camera does not report its frame shape.
        free_bytes: Free space on the disk of the data folder.
        lab: Devices and planner at the first point, none of them open.
        planner_choice: The planner's choice for the target, then the alternatives.
    """

    timeline: Timeline
    n_shots: int
    n_points: int | None
    run_s: tuple[float, float]
    warnings: tuple[Problem, ...]
    rehearsal: Rehearsal | None
    shot_bytes: int | None
    free_bytes: int
    lab: Lab
    planner_choice: Sequence[str] = ()

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


def check(run: PreparedRun, *, runs: bool = False) -> CheckReport:
    """Compute timeline, duration, disk space and warnings of a run, without opening a device.

    Args:
        run: The run, whose sequence and profile have no errors.
        runs: Whether a run follows. Then the kernels of devices are compiled as well as the planner's.

    Raises:
        ConfigError: A device or plugin would refuse the first shot at some point of the run.
    """
    assembly, guard = run.assembly, Guard(run.stop_flag)
    checks = _Checks(run, guard)
    try:
        first = checks.of(assembly.first_point)
        numbers: dict[_PointCheck, set[int]] = {first: {0}}
        for number, point in run.points.known(run.history).items():
            numbers.setdefault(checks.of(point), set()).add(number)
        # in the order of the points, not of the shots
        numbers = dict(sorted(numbers.items(), key=lambda item: min(item[1])))
        asks = (
            _PointCheck.ask_settings,
            _PointCheck.ask_steps,
            _PointCheck.ask_timeline,
            _PointCheck.ask_timing,
            _PointCheck.ask_devices,
        )
        for ask in asks:
            for point_check in numbers:
                ask(point_check)
            checks.raise_problems()
        _rehearse_all(checks, numbers, runs)
        run_s = _run_s(checks)
        checks.raise_problems()
        warnings = _warnings(checks, numbers)
    finally:
        guard.end()
    rehearsals, bars = first.rehearsed, [bar for _, of_step in first.timeline for bar in of_step]
    warnings += _judgement_warnings(assembly, [*rehearsals])
    shot_bytes, free = _shot_bytes(assembly, first.lab, bars), free_bytes(run.root)
    warnings += _disk_warnings(run, shot_bytes or 0, free)
    notes = [Problem(text) for text in (*assembly.warnings, *assembly.hardware.host.notes)]
    return CheckReport(
        first.timeline,
        assembly.sequence.shots,
        None if assembly.scanned is None else len({*run.history.point_of_shot}),
        run_s,
        (*notes, *warnings, *_light_warnings(assembly, first.lab)),
        next(iter(rehearsals.values()), None),
        shot_bytes,
        free,
        first.lab,
        run.choose(first.lab, first.point.steps),
    )


def check_settings(run: PreparedRun, guard: Guard, point: Point, lab: Lab) -> list[list[TimelineEntry]]:
    """Check the settings of a shot with the steps and devices of a running run. Returns the timelines.

    Raises:
        ConfigError: A step, the camera or the lines would refuse them.
    """
    checks = _Checks(run, guard)
    checks.detectors.append(lab.detector)
    point_check = _PointCheck(checks, point, lab)
    for ask in (_PointCheck.ask_steps, _PointCheck.ask_timeline, _PointCheck.ask_timing):
        ask(point_check)
    point_check.ask_devices()
    checks.raise_problems()
    return [[*bars] for _, bars in point_check.timeline]


def _run_s(checks: _Checks) -> tuple[float, float]:
    """Minimum and maximum duration of the run, with each shot at its scan point, or at any corner of it."""
    run = checks.run
    points, point_of_shot = run.points.known(run.history), run.history.point_of_shot
    shot_s = {number: checks.of(point).shot_s for number, point in points.items()}
    if run.assembly.search is not None:
        n_shots = len(point_of_shot)
        least_s, most_s = zip(*shot_s.values(), strict=True)
        return n_shots * min(least_s), n_shots * max(most_s)
    of_shots = [(n, *shot_s[number]) for number, n in Counter(point_of_shot).items()]
    return sum(n * least_s for n, least_s, _ in of_shots), sum(n * most_s for n, _, most_s in of_shots)


def _warnings(checks: _Checks, numbers: Mapping[_PointCheck, Collection[int]]) -> list[Problem]:
    """Settings that are allowed but probably not intended, each once, with its points of the scan."""
    warnings: dict[Any, tuple[Problem, list[int]]] = {}
    is_adaptive, n_points = checks.run.assembly.search is not None, sum(map(len, numbers.values()))
    judges = _window_warnings, _parallelism_warnings, _deadline_warnings, _timeout_warnings
    for judge in (*judges, _timing_warnings, _device_warnings, _instance_warnings):
        for point_check, of_check in numbers.items():
            if 0 not in of_check and is_adaptive and judge is _window_warnings:
                continue  # the search is meant to explore the corners
            for key, problem in judge(point_check):
                warnings.setdefault((judge, key), (problem, []))[1].extend(of_check)
    texts: list[Problem] = []
    for problem, points in warnings.values():
        if len(points) < n_points and not is_adaptive:
            others = f", and {len(points) - 1} others" if len(points) > 1 else ""
            at = f"at point {min(points)} of the scan{others}"
            problem = replace(problem, hint=f"{problem.hint}; {at}" if problem.hint else at)
        texts.append(problem)
    return texts


def _rehearse_all(checks: _Checks, points: Iterable[_PointCheck], runs: bool) -> None:
    """Rehearse the moves at every point that differs from earlier points."""
    run = checks.run
    distinct: dict[tuple[object, ...], _PointCheck] = {}
    for point_check in points:
        distinct.setdefault(point_check.rehearsal_key, point_check)
    # the first point may take MAX_WAIT_S, and all others together as long again
    wait_s, asked = MAX_WAIT_S / max(1, len(distinct) - 1), set[int]()
    for n, (key, point_check) in enumerate(distinct.items()):
        checks.rehearsals[key] = []
        if not point_check.windows:
            continue
        # points may share a lab, whose kernels and devices are asked once
        is_new = id(point_check.lab) not in asked
        if is_new:
            run.warm(point_check.lab, devices=runs and n == 0)
            run.choose(point_check.lab, point_check.point.steps)
        deadline = time.monotonic() + (wait_s if n else MAX_WAIT_S)
        n_loadings, windows = N_LOADINGS_ELSEWHERE if n else N_LOADINGS, [*point_check.windows.values()]
        rehearsals, plans, failure = rehearse(checks.guard, point_check.lab, windows, n_loadings, deadline)
        checks.rehearsals[key] = rehearsals
        if is_new:
            point_check.ask_tweezers(plans if n == 0 else plans[:1])
            asked.add(id(point_check.lab))
        if failure is not None:
            hint = failure.hint and f"{failure.hint} {_plan_options(run.assembly, point_check.point)}"
            loc = (*run.assembly.sequence.planner.loc, "use")
            checks.problems.add(point_check.point.document.error(loc, failure.what, hint=hint))


def _plan_options(assembly: Assembly, point: Point) -> str:
    """Options with which `labseq plan` plans as a run does at a point."""
    settings = changed_settings(point.planner.settings)
    options = ["--target", str(assembly.document.path), "--planner", point.planner.entry.name]
    options += ["--profile", str(assembly.hardware.document.path)]
    for key, value in settings.items():
        options += ["--set", f"{key}={json.dumps(value)}"]
    return shlex.join(options)


def _window_warnings(point_check: _PointCheck) -> Iterator[tuple[int, Problem]]:
    document, shot = point_check.point.document, point_check.shot
    windows, rehearsals = point_check.windows, point_check.rehearsed
    # a slow planner made too few plans in this time to judge a window
    if (
        min((rehearsal.n_loadings for rehearsal in rehearsals.values()), default=0)
        < N_LOADINGS_ELSEWHERE // 4
    ):
        return
    for number, rehearsal in rehearsals.items():
        loc = (*shot[number].loc, "window")
        first, shortest = windows[number][0], min(windows[number])
        n_fit = int(np.count_nonzero(rehearsal.duration_s <= first + 1e-9))
        enough = format_quantity(rehearsal.quantile_s(0.95), "time")
        if 2 * n_fit < rehearsal.n_loadings:
            what = f"the first cycle's window of {format_quantity(first, 'time')} is too short for most plans"
            what += f" ({n_fit} of {rehearsal.n_loadings} fit)"
            yield number, document.problem(loc, what, f"about {enough}, enough for 95 % of the plans")
        elif shortest < quantile(rehearsal.first_batch_s, 0.5):
            what = f"a window of {format_quantity(shortest, 'time')} ends before the first batch does"
            yield number, document.problem(loc, what, "more than the overheads of a cycle and a batch")
    loaded = next(iter(rehearsals.values()))
    if loaded.n_enough < 0.9 * loaded.n_loadings:
        what = f"only {loaded.n_enough} of {loaded.n_loadings} loadings have enough atoms for the target"
        yield -1, document.problem(("target",), what, "a smaller target, or better loading")
    if loaded.n_filled < 0.9 * loaded.n_enough:
        name = point_check.point.planner.entry.name
        what = f"the planner '{name}' fills the target for only {loaded.n_filled} of the {loaded.n_enough} "
        what += "loadings that have enough atoms"
        loc = (*point_check.checks.run.assembly.sequence.planner.loc, "use")
        yield -2, document.problem(loc, what, "a planner that leaves fewer defects")


def _light_warnings(assembly: Assembly, lab: Lab) -> Iterator[Problem]:
    """Warn of imaging light that nothing switches, and of undeclared light that might harm the camera."""
    if any(step.takes_image for _, step in assembly.steps) and not _may_be_lit(assembly, lab):
        what = "nothing in this profile switches the imaging light"
        hint = "add a line for it under `lines`, with `on: [image]` (docs/how-to/lines.md)"
        yield assembly.hardware.document.problem(("camera", "use"), what, hint=hint)
    if lab.step_context.camera.em_gain > 1:
        yield from _undeclared_light(assembly, lab.step_context.camera.em_gain)


def _may_be_lit(assembly: Assembly, lab: Lab) -> bool:
    """Whether a line or a step may switch the imaging light. A simulated camera needs none."""
    if not assembly.hardware.chosen["camera"].identities("camera"):
        return True
    if any(step.device_setting or step.signal for _, step in assembly.steps):
        return True
    if any(isinstance(device, LeaderDialogue) and device.asks_for_light for _, device in lab.hardware()):
        return True
    return any("image" in spec.on and not spec.triggers for spec in lab.line_specs)


def _undeclared_light(assembly: Assembly, gain: float) -> Iterator[Problem]:
    """Lines that may switch a light outside of exposures, without a statement on whether it is blinding."""
    document, lines = assembly.hardware.document, assembly.hardware.profile.lines
    for name, channel in {} if lines is None else lines.channels.items():
        is_light = not (channel.triggers or channel.turns_off or "image" in channel.on)
        is_declared = document.get(("lines", "channels", name, "blinding")) is not None
        if is_light and channel.on and not is_declared:
            kinds = ", ".join(f"`{kind}`" for kind in channel.on)
            what = f"'{name}' is on during {kinds}, and the camera has an EM gain of {gain:g}"
            expected = "`blinding: true` if its light could reach the camera, else `blinding: false`"
            yield document.problem(("lines", "channels", name), what, expected)


def _judgement_warnings(assembly: Assembly, rearrangements: Sequence[int]) -> list[Problem]:
    """Warn if no ``image`` step judges the shots. A fixed number of cycles is judged by its own images."""
    images = [n for n, (_, step) in enumerate(assembly.steps) if step.takes_image and n not in rearrangements]
    if not rearrangements or max(images, default=-1) > rearrangements[-1]:
        return []
    if assembly.steps[rearrangements[-1]][1].judges_shot:
        return []
    loc = assembly.sequence.shot[rearrangements[-1]].loc
    what = "no image follows the last rearrangement, so the shots are not judged"
    return [assembly.document.problem(loc, what, "an 'image' step at the end of the shot", key=True)]


def _parallelism_warnings(point_check: _PointCheck) -> Iterator[tuple[int, Problem]]:
    point = point_check.point
    asked = getattr(point.planner.settings, "degree_of_parallelism", None)
    limit = point.hardware.profile.motion.max_tweezers
    if point_check.windows and isinstance(asked, int) and asked > limit:  # else nothing is planned
        loc = (*point_check.checks.run.assembly.sequence.planner.loc, "degree_of_parallelism")
        what = f"degree_of_parallelism is {asked}, but the profile allows {limit} mobile tweezers at once"
        yield 0, point.document.problem(loc, f"{what}; at most {limit} are used")


def _deadline_warnings(point_check: _PointCheck) -> Iterator[tuple[int, Problem]]:
    """Warn if steps between a wait for a signal and the next wait or the end exceed its deadline."""
    timeline, lab, point = point_check.timeline, point_check.lab, point_check.point
    waits = [bool(step.signal) for _, step in point.steps]
    for number, (_, step) in enumerate(point.steps):
        if not waits[number]:
            continue
        try:
            name, leader = find_leader(dict(lab.hardware()), step.device)
        except ConfigError:  # not a wait for a signal, but another step's own attribute
            continue
        until = next((n for n in range(number + 1, len(waits)) if waits[n]), None)
        bars = [bar for _, of_step in timeline[number + 1 : until] for bar in of_step]
        longest_s = sum(bar.duration_s for bar in bars if bar.timed_by.name != "leader")
        if longest_s > leader.deadline_s:
            longest = format_quantity(longest_s, "time")
            what = f"the following steps take up to {longest}, but '{name}' must be answered within "
            what += format_quantity(leader.deadline_s, "time")
            loc = (*point_check.shot[number].loc, "for")
            hint = "raise 'deadline' in the profile, else the other system is told that the shot failed"
            yield number, point.document.problem(loc, what, hint=hint)


def _instance_warnings(point_check: _PointCheck) -> Iterator[tuple[str, Problem]]:
    """Warnings of the simulation and of the mobile tweezers themselves."""
    lab = point_check.lab
    for name, instance in (("simulation", lab.simulation), ("mobile_tweezers", lab.mobile_tweezers)):
        if instance is not None:
            for text in point_check.checks.guard.call(name, WARM_S, instance.warnings):
                yield text, Problem(text)


def _device_warnings(point_check: _PointCheck) -> Iterator[tuple[int, Problem]]:
    """Warnings of the devices' own settings."""
    number = 0
    for chosen in point_check.point.hardware.chosen.values():
        if chosen.settings is None or chosen.document is None:
            continue
        for loc, what, expected in chosen.settings.warnings():
            yield number, chosen.document.problem((*chosen.loc, *loc), what, expected)
            number += 1


def _shot_bytes(assembly: Assembly, lab: Lab, bars: Sequence[TimelineEntry]) -> int | None:
    shape = lab.step_context.camera.frame_shape
    n_images = sum(bar.n_images for bar in bars)
    kept = {"all": n_images, "last": min(1, n_images), "none": 0}[assembly.sequence.record_frames]
    if shape is None and kept:
        return None
    # bytes of each site on an image, for occupancy, confidence and signal
    per_image = 13 * lab.grid.n_rows * lab.grid.n_cols
    # approximate size of a shot file without images, in bytes
    return 60_000 + n_images * per_image + kept * 2 * math.prod(shape or (0,))


def _disk_warnings(run: PreparedRun, shot_bytes: int, free_bytes: int) -> Iterator[Problem]:
    """Warn if the remaining shots may need more disk space than is free."""
    if (n_bytes := len(run.history.to_take) * shot_bytes) > free_bytes:
        what = f"the run may need {size_text(n_bytes)}, but the disk has only {size_text(free_bytes)} free"
        hint = "free some, choose another folder with --output, or keep fewer frames with record_frames"
        yield Problem(what, visible(str(run.root)), hint=f"{hint} (a run that fills the disk can be resumed)")
