"""`labseq check`: prints what `session.check` has found: timeline, limits, warnings, and all errors."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, cast

from labseq.assembly.assemble import Assembly
from labseq.assembly.plugin_choice import DryRun
from labseq.assembly.search import Search
from labseq.calibration.compare import age_s, quality_text
from labseq.config.scan import Axis
from labseq.config.sequence import CheckSettings
from labseq.console.errors import json_errors, warning_lines
from labseq.console.events import LogLines
from labseq.console.output import as_line, say, stdout_to_stderr
from labseq.console.text import age_text, clock_time, columns, encodes, plural, settings_text, size_text
from labseq.messages import clean
from labseq.model import TimelineEntry
from labseq.recording import data_root
from labseq.sequencer.policies import StepPolicy
from labseq.session.check import CheckReport, Rehearsal, check
from labseq.session.session import Session
from labseq.units import format_quantity

BAR_WIDTH: Final = 30

Timeline = Sequence[tuple[str, Sequence[TimelineEntry]]]


def timeline_table(timeline: Timeline, block: str, width: int = BAR_WIDTH) -> list[str]:
    """A row per bar of the timeline: step, start, length, and the bar itself; no bars if the width is 0."""
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
    return columns(rows, right=(2, 3))


def _bar(start_s: float, duration_s: float, total_s: float, block: str, width: int) -> str:
    if not total_s or not width:
        return ""
    first, last = (round(width * t / total_s) for t in (start_s, start_s + duration_s))
    first = min(first, width - 1)
    return " " * first + block * max(1, last - first)


def lines_table(
    lines: Mapping[str, Sequence[tuple[float, float]]], total_s: float, block: str, width: int = BAR_WIDTH
) -> list[str]:
    """A row per line: the time that it is on, and a bar that shows when; ``lines`` has (start, end) in s."""
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
    return columns(rows, right=(2, 3))


_THEN = {"repeat_shot": "repeats the shot", "skip_point": "skips its point", "stop": "stops the run"}


def policy_texts(assembly: Assembly) -> list[str]:
    """The policies that differ from the defaults: a line for the run, each step and each check."""
    policy, spec = assembly.policy, assembly.sequence
    texts = [text for text in [_differing(policy.otherwise, StepPolicy())] if text]
    if policy.when_exhausted == "skip_point":
        texts.append("if all attempts at a shot fail, its point is skipped")
    for number, (step, own) in enumerate(zip(spec.shot, policy.steps, strict=True)):
        if text := _differing(own, policy.otherwise):
            texts.append(f"step {number} ({step.name or step.kind}): {text}")
    return texts + [_check(check) for check in spec.policy.checks]


def _differing(own: StepPolicy, otherwise: StepPolicy) -> str:
    parts: list[str] = []
    if own.timeout_s < math.inf:
        parts.append(f"{format_quantity(own.timeout_s, 'time')} at most")
    if own.retries:
        parts.append("retried once" if own.retries == 1 else f"retried {own.retries} times")
    if own.on_failure and own.on_failure != otherwise.on_failure:
        parts.append(f"a failure {_THEN[own.on_failure]}")
    if own.over_budget != otherwise.over_budget:
        then = {"record": "is only recorded", "warn": "is a warning"} | _THEN
        parts.append(f"a stage over its budget {then[own.over_budget]}")
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


def check_sequence(
    sequence: Path, profile: str | None, overrides: Sequence[str], dry_run: DryRun, *, as_json: bool
) -> None:
    """Check a sequence, and print its timeline, limits and errors; no device is opened."""
    answer = stdout_to_stderr() if as_json else None
    observer = LogLines(sys.stderr)
    try:
        session = Session.open(
            sequence, profile=profile, overrides=overrides, dry_run=dry_run, observer=observer
        )
        checked = check(session)
    except BaseException as error:
        if answer is not None:
            answer(json_errors(error))
        raise
    if answer is not None:
        answer(as_line(_as_values(session.assembly, checked)))
    else:
        _print(session.assembly, checked)


def _print(assembly: Assembly, checked: CheckReport) -> None:
    block = "█" if encodes(sys.stdout.encoding, "█") else "#"
    text_width = 2 + max(map(len, timeline_table(checked.timeline, block, 0)))
    room = shutil.get_terminal_size((text_width + BAR_WIDTH, 24)).columns - text_width
    width = max(0, min(BAR_WIDTH, room))
    parts = (
        columns(_subject(assembly)),
        timeline_table(checked.timeline, block, width),
        lines_table(checked.lines, checked.longest_shot_s, block, width),
        columns(
            [("output", "when nothing plays"), *checked.idle_outputs.items()] if checked.idle_outputs else []
        ),
        columns([*_totals(checked, assembly), *_rehearsed(checked)]),
        columns(_limits(assembly)),
    )
    say("\n\n".join("\n".join(lines) for lines in parts if lines))
    for warning in checked.warnings:
        say(*warning_lines(warning), stream=sys.stderr)


def _as_values(assembly: Assembly, checked: CheckReport) -> dict[str, Any]:
    rehearsal = checked.rehearsal
    return {
        "problems": [],
        "warnings": [*map(asdict, checked.warnings)],
        "timeline": [
            {"step": number, "name": name, "bars": [*map(asdict, bars)]}
            for number, (name, bars) in enumerate(checked.timeline)
        ],
        "shots": checked.n_shots,
        "shot_s": [checked.shortest_shot_s, checked.longest_shot_s],
        "points": checked.n_points,
        "run_s": checked.run_s,
        "lines": checked.lines,
        "idle_outputs": checked.idle_outputs,
        "n_images": checked.n_images,
        "shot_bytes": checked.shot_bytes,
        "run_bytes": None if checked.shot_bytes is None else checked.n_shots * checked.shot_bytes,
        "first_cycle_s": None if rehearsal is None else _quantiles(rehearsal),
        "calibrations": [
            {"kind": entry.kind, "id": entry.id, "taken_utc": entry.taken_utc, "age_s": age_s(entry)}
            for entry in assembly.hardware.calibrations.values()
        ],
    }


def _quantiles(rehearsal: Rehearsal) -> dict[str, float]:
    median, p95 = rehearsal.quantile_s(0.5), rehearsal.quantile_s(0.95)
    return {"median": median, "p95": p95, "n_loadings": rehearsal.n_loadings}


def _subject(assembly: Assembly) -> list[tuple[str, str]]:
    target, spec = assembly.target, assembly.sequence
    grid, document = assembly.hardware.grid, assembly.hardware.document
    listed = settings_text({k: v for k, v in assembly.planner.dump().items() if k != "use"})
    sites = f"{plural(target.n_atoms, 'atom')}, {plural(int(target.clear.sum()), 'site')} to be empty"
    simulated = ", dry run" if assembly.dry_run != "off" else ", simulated" * assembly.virtual_time
    return [
        ("sequence", f"{spec.name} ({assembly.document.path})"),
        ("profile", f"{assembly.hardware.profile.name} ({document.path}){simulated}"),
        (
            "grid",
            f"{grid.n_rows} x {grid.n_cols}, {grid.lattice}, {format_quantity(grid.spacing_m, 'length')}",
        ),
        *([] if target.is_none else [("target", f"{target.name}, {sites}")]),
        ("planner", assembly.planner.entry.name + (f" ({listed})" if listed else "")),
        *(
            ("calibration", f"{one.kind} {one.id}, {age_text(age_s(one), ' old')}, {quality_text(one)}")
            for one in assembly.hardware.calibrations.values()
        ),
        *(("scan", text) for text in _scanned(assembly)),
    ]


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
        f"{plural(scan.n_points, 'point')}{repeats}, {scan.order}; everything else here is for the first one",
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
    return [*lines, f"{what}, for the {aim}; everything else here is for the values in the files"]


def _ends(axis: Axis) -> str:
    first, last = (clean(str(axis.values[i].raw or axis.values[i].plain())) for i in (0, -1))
    return f"{first} to {last}" if len(axis.values) > 1 else first


def _totals(checked: CheckReport, assembly: Assembly) -> list[tuple[str, str]]:
    shot = [format_quantity(t, "time") for t in (checked.shortest_shot_s, checked.longest_shot_s)]
    n = checked.n_shots
    run = [clock_time(t) for t in checked.run_s]
    points = "" if checked.n_points is None else f"{plural(checked.n_points, 'point')}, "
    points = f"at most {points}" if assembly.search is not None else points
    size = "of unknown size" if checked.shot_bytes is None else f"{size_text(checked.shot_bytes)} each"
    disk = "unknown" if checked.shot_bytes is None else f"{size_text(n * checked.shot_bytes)} at most"
    root = next(
        folder for folder in (data_root().absolute(), *data_root().absolute().parents) if folder.exists()
    )
    free = size_text(shutil.disk_usage(root).free)
    return [
        ("shot", f"{shot[0]} to {shot[1]}, {plural(checked.n_images, 'image')} at most, {size}"),
        ("run", f"{points}{plural(n, 'shot')}, {run[0]} to {run[1]}, {disk} on disk, {free} free"),
    ]


def _rehearsed(checked: CheckReport) -> list[tuple[str, str]]:
    if checked.rehearsal is None:
        return []
    found = _quantiles(checked.rehearsal)
    median, p95 = (format_quantity(found[name], "time") for name in ("median", "p95"))
    text = f"median {median}, 95th percentile {p95}, over {checked.rehearsal.n_loadings} random loadings"
    return [("first cycle", text)]


def _limits(assembly: Assembly) -> list[tuple[str, str]]:
    profile, spec = assembly.hardware.profile, assembly.sequence
    motion, timeouts = profile.motion, profile.timeouts
    tones = f"{motion.max_row_tones} x {motion.max_column_tones} tones"
    dop = assembly.planner.dump().get("degree_of_parallelism")
    uses = f"; the planner uses {min(dop, motion.max_tweezers)}" if dop else ""
    hardware = assembly.hardware.chosen.items()
    real = [role for role, one in hardware if one.entry.role.is_hardware and not one.virtual_time]
    waits = (("device call", timeouts.call), ("safe state", timeouts.safe_state), ("plan", timeouts.plan))
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
        texts.append(f"{times} {each}, {plural(settings['cycles'], 'cycle')} at most; the image {image}")
    return texts
