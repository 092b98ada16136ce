"""`labseq check`: prints the timeline, limits, warnings and all errors that `session.check` has found."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from labseq.assembly.assemble import Assembly
from labseq.assembly.options import DryRun
from labseq.assembly.search import Search
from labseq.calibration.compare import quality_text
from labseq.calibration_store import age_s
from labseq.config.scan import Axis
from labseq.config.sequence import CheckSettings
from labseq.console.errors import warning_lines
from labseq.console.events import LogLines
from labseq.console.output import say
from labseq.console.report import Facts, aligned, reporting
from labseq.console.text import age_text, clock_time, encodes, plural, settings_text
from labseq.errors import Problem
from labseq.messages import clean, visible
from labseq.model import CalibrationEntry, LossSpec, TimelineEntry
from labseq.model.policies import StepPolicy
from labseq.sequencer.line_spans import spans_on
from labseq.session.advice import better_planner
from labseq.session.check import CheckReport, check
from labseq.session.rehearsal import Rehearsal
from labseq.session.session import Session
from labseq.units import format_quantity, size_text

BAR_WIDTH: Final = 30

Timeline = Sequence[tuple[str, Sequence[TimelineEntry]]]


def timeline_table(timeline: Timeline, block: str, width: int = BAR_WIDTH) -> list[str]:
    """A row per bar of the timeline, with step, start, length and bar. No bars if the width is 0."""
    total_s = sum(bar.duration_s for _, bars in timeline for bar in bars)
    rows = [("step", "", "start", "at most", "timed by", "")]
    start_s = 0.0
    for number, (name, bars) in enumerate(timeline):
        for i, bar in enumerate(bars):
            label = bar.label if bar.label != name else ""
            length = format_quantity(bar.duration_s, "time")
            drawn = _bar(start_s, bar.duration_s, total_s, block, width)
            step = f"{number} {name}" if i == 0 else ""
            by = bar.timed_by
            accuracy = f" to {format_quantity(by.accuracy_s, 'time')}" if by.accuracy_s else ""
            by = by.name + accuracy if bar.duration_s else ""
            rows.append((step, label, format_quantity(start_s, "time"), length, by, drawn))
            start_s += bar.duration_s
    return aligned(rows, right=(2, 3))


def _bar(start_s: float, duration_s: float, total_s: float, block: str, width: int) -> str:
    if not total_s or not width:
        return ""
    first, last = (round(width * t / total_s) for t in (start_s, start_s + duration_s))
    first = min(first, width - 1)
    return " " * first + block * max(1, last - first)


def lines_table(
    lines: Mapping[str, Sequence[tuple[float, float]]], total_s: float, block: str, width: int = BAR_WIDTH
) -> list[str]:
    """A row per line, with the time that it is on and a bar. ``lines`` has (start, end) in s."""
    if not lines:
        return []
    rows = [("line", "", "times on", "at most", "")]
    for name, spans in lines.items():
        on_s = sum(end_s - start_s for start_s, end_s in spans)
        drawn = [" "] * width
        for start_s, end_s in spans:
            for place, mark in enumerate(_bar(start_s, end_s - start_s, total_s, block, width)):
                drawn[place] = mark if mark != " " else drawn[place]
        rows.append((name, "", str(len(spans)), format_quantity(on_s, "time"), "".join(drawn).rstrip()))
    return aligned(rows, right=(2, 3))


_THEN = {"repeat_shot": "repeats the shot", "skip_point": "skips its point", "stop": "stops the run"}


def policy_texts(assembly: Assembly) -> list[str]:
    """A line per policy that differs from the default, of the run, a step or a check."""
    policy, spec = assembly.policy, assembly.sequence
    texts = [text for text in [_differing(policy.otherwise, StepPolicy(over_budget="record"))] if text]
    if policy.when_exhausted == "skip_point":
        texts.append("if all attempts at a shot fail, its point is skipped")
    for number, (step, step_policy) in enumerate(zip(spec.shot, policy.steps, strict=True)):
        if text := _differing(step_policy, policy.otherwise):
            texts.append(f"step {number} ({step.name or step.kind}): {text}")
    return texts + [_check(check) for check in spec.policy.checks]


def _differing(policy: StepPolicy, otherwise: StepPolicy) -> str:
    """How a policy differs from another; "" if it does not."""
    parts: list[str] = []
    if policy.timeout_s is not None:
        parts.append(f"{format_quantity(policy.timeout_s, 'time')} at most")
    if policy.retries:
        parts.append("retried once" if policy.retries == 1 else f"retried {policy.retries} times")
    if policy.on_failure and policy.on_failure != otherwise.on_failure:
        parts.append(f"a failure {_THEN[policy.on_failure]}")
    if policy.over_budget and policy.over_budget != otherwise.over_budget:
        then = {"record": "is only recorded", "warn": "is a warning"} | _THEN
        parts.append(f"a stage over its budget {then[policy.over_budget]}")
    return ", ".join(parts)


def _check(check: CheckSettings) -> str:
    limits = [
        f"{word} {limit:g}"
        for word, limit in (("at least", check.at_least), ("at most", check.at_most))
        if limit is not None
    ]
    of = "each shot" if check.shots == 1 else f"the mean of {check.shots} shots"
    then = {"warn": "a warning"} | _THEN
    return f"{check.value} of {of} {' and '.join(limits)}; otherwise {then[check.then]}"


@dataclass(frozen=True, slots=True)
class TimelineStep:
    """A step of a shot, counted from 0, and its bars."""

    step: int
    name: str
    bars: Sequence[TimelineEntry]


@dataclass(frozen=True, slots=True)
class FirstCycle:
    """How long the moves of the first cycle take over random loadings, in seconds."""

    median: float
    p95: float
    n_loadings: int

    @classmethod
    def of(cls, rehearsal: Rehearsal) -> FirstCycle:
        """The quantiles of a rehearsal."""
        return cls(rehearsal.quantile_s(0.5), rehearsal.quantile_s(0.95), rehearsal.n_loadings)


@dataclass(frozen=True, slots=True)
class UsedCalibration:
    """A calibration that the run uses."""

    kind: str
    id: str
    taken_utc: str
    age_s: float | None


@dataclass(frozen=True, slots=True)
class CheckedSequence:
    """What a sequence does, for a scan at its first point.

    Attributes:
        about: Name and text of the sequence, profile, planner, ...
        limits: Name and text of each limit, such as windows, attempts, policies and timeouts.
        shot_s: Shortest and longest duration of a shot.
        run_s: Shortest and longest duration of the run.
        lines: Name of each line -> when it is on in the longest shot, as (start, end) in seconds.
        idle_outputs: Name of each device with an output while nothing plays -> that output.
    """

    about: Facts
    timeline: Sequence[TimelineStep]
    shots: int
    shot_s: tuple[float, float]
    points: int | None
    points_are_chosen: bool
    run_s: tuple[float, float]
    lines: Mapping[str, Sequence[tuple[float, float]]]
    idle_outputs: Mapping[str, str]
    n_images: int
    shot_bytes: int | None
    run_bytes: int | None
    free_bytes: int
    first_cycle_s: FirstCycle | None
    calibrations: Sequence[UsedCalibration]
    limits: Facts
    warnings: Sequence[Problem]
    problems: Sequence[Problem] = ()

    @classmethod
    def of(cls, assembly: Assembly, checked: CheckReport, better: str = "") -> CheckedSequence:
        """The report of a checked sequence."""
        return cls(
            about=[*_subject(assembly, checked.planner_choice), *_expected(assembly, checked, better)],
            timeline=[TimelineStep(i, name, bars) for i, (name, bars) in enumerate(checked.timeline)],
            shots=checked.n_shots,
            shot_s=(checked.shortest_shot_s, checked.longest_shot_s),
            points=checked.n_points,
            points_are_chosen=assembly.search is not None,
            run_s=checked.run_s,
            lines=spans_on(checked.lab.line_specs, checked.bars),
            idle_outputs={
                name: text for name, device in checked.lab.hardware() if (text := device.idle_output)
            },
            n_images=checked.n_images,
            shot_bytes=checked.shot_bytes,
            run_bytes=None if checked.shot_bytes is None else checked.n_shots * checked.shot_bytes,
            free_bytes=checked.free_bytes,
            first_cycle_s=None if checked.rehearsal is None else FirstCycle.of(checked.rehearsal),
            calibrations=[
                UsedCalibration(entry.kind, entry.id, entry.taken_utc, age_s(entry))
                for entry in assembly.hardware.calibrations.values()
            ],
            limits=_limits(assembly),
            warnings=checked.warnings,
        )

    def as_text(self) -> list[str]:
        """Parts of the run, timelines of steps and lines, durations and limits."""
        block = "█" if encodes(sys.stdout.encoding, "█") else "#"
        timeline = [(step.name, step.bars) for step in self.timeline]
        text_width = 2 + max(map(len, timeline_table(timeline, block, 0)))
        room = shutil.get_terminal_size((text_width + BAR_WIDTH, 24)).columns - text_width
        width = max(0, min(BAR_WIDTH, room))
        outputs = [("output", "when nothing plays"), *self.idle_outputs.items()] if self.idle_outputs else []
        parts = (
            aligned(self.about),
            timeline_table(timeline, block, width),
            lines_table(self.lines, self.shot_s[1], block, width),
            aligned(outputs),
            aligned(self._totals()),
            aligned(self.limits),
        )
        return [line for lines in parts if lines for line in ("", *lines)][1:]

    def _totals(self) -> list[tuple[str, str]]:
        shortest, longest = (format_quantity(t, "time") for t in self.shot_s)
        run = " to ".join(map(clock_time, self.run_s))
        points = "" if self.points is None else f"{plural(self.points, 'point')}, "
        points = f"at most {points}" if self.points_are_chosen else points
        size = "of unknown size" if self.shot_bytes is None else f"{size_text(self.shot_bytes)} each"
        disk = "unknown" if self.run_bytes is None else f"{size_text(self.run_bytes)} at most"
        space = f"{disk} on disk, {size_text(self.free_bytes)} free"
        totals = [
            ("shot", f"{shortest} to {longest}, {plural(self.n_images, 'image')} at most, {size}"),
            ("run", f"{points}{plural(self.shots, 'shot')}, {run}, {space}"),
        ]
        if self.first_cycle_s is not None:
            median, p95 = (
                format_quantity(t, "time") for t in (self.first_cycle_s.median, self.first_cycle_s.p95)
            )
            over = f"over {self.first_cycle_s.n_loadings} random loadings"
            totals.append(("first cycle", f"median {median}, 95th percentile {p95}, {over}"))
        return totals


def check_sequence(
    sequence: Path, profile: str | None, overrides: Sequence[str], dry_run: DryRun, *, as_json: bool
) -> None:
    """Check a sequence, and print its timeline, limits and errors. No device is opened."""
    with reporting(as_json=as_json) as show:
        session = Session.open(
            sequence, profile=profile, overrides=overrides, dry_run=dry_run, observer=LogLines(sys.stderr)
        )
        checked = check(session)
        show(CheckedSequence.of(session.assembly, checked, better_planner(session, checked.lab)))
    if not as_json:
        for warning in checked.warnings:
            say(*warning_lines(warning), stream=sys.stderr)


def _subject(assembly: Assembly, planner_choice: Sequence[str]) -> Facts:
    target, spec = assembly.target, assembly.sequence
    grid, document = assembly.hardware.grid, assembly.hardware.document
    listed = settings_text({k: v for k, v in assembly.planner.dump().items() if k != "use"})
    settings = None if target.is_none else assembly.planner.settings
    algorithm = "" if settings is None else settings.algorithm_text()
    sites = f"{plural(target.n_atoms, 'atom')}, {plural(int(target.clear.sum()), 'site')} to be empty"
    simulated = ", dry run" if assembly.hardware.dry_run != "off" else ", simulated" * assembly.virtual_time
    return [
        ("sequence", f"{spec.name} ({assembly.document.path})"),
        ("profile", f"{assembly.hardware.profile.name} ({document.path}){simulated}"),
        (
            "grid",
            f"{grid.n_rows} x {grid.n_cols}, {grid.lattice}, {format_quantity(grid.spacing_m, 'length')}",
        ),
        *([] if target.is_none else [("target", f"{target.name}, {sites}")]),
        ("planner", assembly.planner.entry.name + (f" ({listed})" if listed else "")),
        *([("algorithm", clean(algorithm))] if algorithm else []),
        *(("or" if n else "chosen", visible(text)) for n, text in enumerate(planner_choice)),
        *(("calibration", _calibration(entry)) for entry in assembly.hardware.calibrations.values()),
        *(("scan", text) for text in _scanned(assembly)),
        *(("measures", _measure(one)) for one in assembly.resolved["measure"]),
    ]


def _expected(assembly: Assembly, checked: CheckReport, better: str) -> Facts:
    """A planner that is expected to do better, and expectations that use the paper's values."""
    if not better and not checked.planner_choice:
        return []
    given = assembly.hardware.document.get(("mobile_tweezers", "losses")) or {}
    guessed = [
        name.removesuffix("_s")
        for name in LossSpec.__dataclass_fields__
        if name.removesuffix("_s") not in given
    ]
    losses = f"{', '.join(guessed)}: as in the paper, because the profile does not give them"
    return [*([("better", better)] if better else []), *([("losses", losses)] if guessed else [])]


def _measure(measure: Mapping[str, Any]) -> str:
    """A quantity that the run measures, and its fit."""
    if "fit" not in measure:
        return clean(measure["value"])
    result = f", result {measure['report']}" if "report" in measure else ""
    stops = (f"{clean(name)} {clean(str(error))}" for name, error in measure.get("stop_when", {}).items())
    stop = f", ends when known to {', '.join(stops)}" if "stop_when" in measure else ""
    return f"{clean(measure['value'])}, fit {measure['fit']}{result}{stop}"


def _calibration(entry: CalibrationEntry) -> str:
    quality = quality_text(entry.kind, entry.quality)
    return f"{entry.kind} {entry.id}, {age_text(age_s(entry), ' old')}, {quality}"


def _scanned(assembly: Assembly) -> list[str]:
    """A line for each group of the scan, the slowest first."""
    if assembly.scanned is None:
        return []
    scan = assembly.scanned.scan
    if assembly.search is not None:
        return _chosen(assembly.search)
    lines: list[str] = []
    for group in scan.groups:
        axes = (f"{axis.address} {_ends(axis)}" for axis in group)
        lines.append(f"{plural(len(group[0].values), 'value')} of {' together with '.join(axes)}")
    repeats = f", {plural(scan.repeats, 'shot')} of each" if scan.repeats > 1 else ""
    return [
        *lines,
        f"{plural(scan.n_points, 'point')}{repeats}, {scan.order} (this report is for the first one)",
    ]


def _chosen(search: Search) -> list[str]:
    """A line for each range of an adaptive scan, and one for the scanner."""
    scan, choice = search.scan, search.scan.choice
    lines: list[str] = []
    for axis in scan.ranges:
        steps = f" in {plural(axis.n_steps, 'step')}" if axis.n_steps else ""
        lines.append(f"{axis.address} from {_ends(axis)}{steps}")
    repeats = f", {plural(scan.repeats, 'shot')} of each" if scan.repeats > 1 else ""
    what = f"points chosen during the run by {choice.use}, at most {scan.n_points}{repeats}"
    aim = f"{'lowest' if choice.maximise is None else 'highest'} {clean(choice.quantity)}"
    return [*lines, f"{what}, for the {aim} (this report is for the values in the files)"]


def _ends(axis: Axis) -> str:
    first, last = (clean(str(axis.values[i].raw or axis.values[i].plain())) for i in (0, -1))
    return f"{first} to {last}" if len(axis.values) > 1 else first


def _limits(assembly: Assembly) -> Facts:
    profile, spec = assembly.hardware.profile, assembly.sequence
    motion, timeouts = profile.motion, profile.timeouts
    tones = f"{motion.max_row_tones} x {motion.max_column_tones} tones"
    dop = assembly.planner.dump().get("degree_of_parallelism")
    uses = f"; the planner uses {min(dop, motion.max_tweezers)}" if dop else ""
    hardware = assembly.hardware.chosen.items()
    real = [role for role, plugin in hardware if plugin.entry.role.is_hardware and not plugin.virtual_time]
    waits = (
        ("device call", timeouts.call_s),
        ("safe state", timeouts.safe_state_s),
        ("plan", timeouts.plan_s),
    )
    return [
        *(("window", text) for text in _windows(assembly.resolved)),
        ("mobile tweezers", f"{motion.max_tweezers} on at once, {tones}{uses}"),
        *(
            [("not opened", f"{', '.join(real)}: limits that only the hardware knows are not checked")]
            if real
            else []
        ),
        ("attempts", f"at most {spec.attempts} per shot"),
        *(("policy", text) for text in policy_texts(assembly)),
        ("timeouts", ", ".join(f"{what} {format_quantity(value, 'time')}" for what, value in waits)),
    ]


def _windows(resolved: Mapping[str, Any]) -> list[str]:
    """The window of each cycle, for every rearrangement in the shot."""
    texts: list[str] = []
    for step in resolved["shot"]:
        settings = step.get("rearrange")
        if settings is None:
            continue
        window = settings["window"]
        values = cast("list[float]", window if isinstance(window, list) else [window])
        times = ", ".join(format_quantity(value, "time") for value in values)
        each = "for the moves of each cycle" if len(values) == 1 else "for the moves of the cycles"
        is_early = settings["window_mode"] == "early"
        image = "follows the last batch" if is_early else "waits for the end of the window"
        texts.append(f"{times} {each}, {plural(settings['cycles'], 'cycle')} at most, and the image {image}")
    return texts
