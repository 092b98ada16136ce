"""``labseq check``: what a sequence will do, at most."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from labseq.cli.calibration import age_s, quality_text
from labseq.cli.excerpt import excerpt
from labseq.cli.failures import lines_of
from labseq.cli.log_lines import LogLines
from labseq.cli.output import columns, stdout_to_stderr, encodes, say
from labseq.cli.policy_words import policy_texts
from labseq.cli.show import as_line
from labseq.cli.timeline import BAR_WIDTH, lines_table, timeline_table
from labseq.cli.words import age_text, clock_time, plural, settings_text
from labseq.config import Axis
from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem
from labseq.session import Assembly, CheckReport, Session, check
from labseq.session.adaptive import Search
from labseq.session.checking import Rehearsal
from labseq.session.choosing import DryRun
from labseq.units import format_quantity

_TEXT_WIDTH: Final = 48  # of the timeline without its bars


def check_sequence(
    sequence: Path, profile: str | None, overrides: Sequence[str], dry_run: DryRun, *, as_json: bool
) -> None:
    """Check a sequence and print all that can be known of it without opening a device.

    Args:
        sequence: The sequence file.
        profile: Name or path of the profile, instead of the sequence's own.
        overrides: ``"address=value"`` strings.
        dry_run: "off", "full" or "fast".
        as_json: Whether to print everything as one line of JSON, alone on stdout.

    Raises:
        ConfigError: Sequence, profile or an override is wrong.
        UnknownPluginError: A plugin that is named does not exist.
        PluginLoadError: A plugin that is named failed to load.
    """
    answer = stdout_to_stderr() if as_json else None
    observer = LogLines(sys.stderr)
    try:
        session = Session.open(
            sequence, profile=profile, overrides=overrides, dry_run=dry_run, observer=observer
        )
        checked = check(session)
    except BaseException as error:
        if answer is not None:
            answer(refusal(error))
        raise
    if answer is not None:
        answer(as_line(_as_values(checked) | {"calibrations": _calibrations(session.assembly)}))
    else:
        _print(session.assembly, checked)


def refusal(error: BaseException) -> str:
    """What is wrong with a sequence, as one line of JSON."""
    problems = error.problems if isinstance(error, ConfigError) else [Problem(t) for t in lines_of(error)]
    return as_line({"problems": [asdict(problem) for problem in problems], "warnings": []})


def _print(assembly: Assembly, checked: CheckReport) -> None:
    block = "█" if encodes(sys.stdout.encoding, "█") else "#"
    room = shutil.get_terminal_size((_TEXT_WIDTH + BAR_WIDTH, 24)).columns - _TEXT_WIDTH
    width = max(0, min(BAR_WIDTH, room))
    parts = (
        columns(_what(assembly)),
        timeline_table(checked.timeline, block, width),
        lines_table(checked.lines, checked.longest_shot_s, block, width),
        columns([*_sums(checked, assembly), *_rehearsed(checked)]),
        columns(_limits(assembly)),
    )
    say("\n\n".join("\n".join(lines) for lines in parts if lines))
    for warning in checked.warnings:
        notes = (f"      = {note}" for note in warning.notes)
        say(f"warning: {warning}", *excerpt(warning), *notes, stream=sys.stderr)


def _as_values(checked: CheckReport) -> dict[str, Any]:
    rehearsal = checked.rehearsal
    return {
        "problems": [],
        "warnings": [asdict(warning) for warning in checked.warnings],
        "timeline": [
            {"step": number, "name": name, "bars": [asdict(bar) for bar in bars]}
            for number, (name, bars) in enumerate(checked.timeline)
        ],
        "shots": checked.n_shots,
        "shot_s": [checked.shortest_shot_s, checked.longest_shot_s],
        "points": checked.n_points,
        "run_s": list(checked.run_s),
        "lines": {line: [list(span) for span in spans] for line, spans in checked.lines.items()},
        "n_images": checked.n_images,
        "shot_bytes": checked.shot_bytes,
        "run_bytes": None if checked.shot_bytes is None else checked.n_shots * checked.shot_bytes,
        "first_cycle_s": None if rehearsal is None else _quantiles(rehearsal),
    }


def _quantiles(rehearsal: Rehearsal) -> dict[str, float]:
    median, p95 = np.quantile(rehearsal.duration_s, [0.5, 0.95])
    return {"median": float(median), "p95": float(p95), "n_loadings": rehearsal.n_loadings}


def _what(assembly: Assembly) -> list[tuple[str, str]]:
    target, spec = assembly.target, assembly.sequence
    grid, document = assembly.bench.grid, assembly.bench.document
    listed = settings_text({k: v for k, v in assembly.planner.dump().items() if k != "use"})
    n_clear = int(target.clear.sum())
    return [
        ("sequence", f"{spec.name} ({assembly.document.path})"),
        ("profile", f"{assembly.bench.profile.name} ({document.path}){_simulation(assembly)}"),
        (
            "grid",
            f"{grid.n_rows} x {grid.n_cols}, {grid.lattice}, {format_quantity(grid.spacing_m, 'length')}",
        ),
        ("target", f"{target.name}, {plural(target.n_atoms, 'atom')}, {plural(n_clear, 'site')} to be empty"),
        ("planner", assembly.planner.entry.name + (f" ({listed})" if listed else "")),
        *(("calibration", text) for text in _calibrated(assembly)),
        *(("scan", text) for text in _scanned(assembly)),
    ]


def _calibrated(assembly: Assembly) -> list[str]:
    """A line for each calibration in use."""
    return [
        f"{entry.kind} {entry.id}, {age_text(age_s(entry))} old, {quality_text(entry)}"
        for entry in assembly.bench.calibrations.values()
    ]


def _calibrations(assembly: Assembly) -> list[dict[str, Any]]:
    return [
        {"kind": entry.kind, "id": entry.id, "taken_utc": entry.taken_utc, "age_s": age_s(entry)}
        for entry in assembly.bench.calibrations.values()
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
        f"{plural(scan.n_points, 'point')}{repeats}, {scan.order}; all else here is of the first one",
    ]


def _chosen(search: Search) -> list[str]:
    """A line for each range of an adaptive scan, and what is chosen from them."""
    scan, adaptive = search.scanned.scan, search.adaptive
    lines: list[str] = []
    for axis, ends in zip(scan.axes, adaptive.ends, strict=True):
        steps = f" in {plural(ends.n_steps, 'step')}" if ends.n_steps else ""
        lines.append(f"{axis.address} from {_ends(axis)}{steps}")
    repeats = f", {plural(scan.repeats, 'shot')} of each" if scan.repeats > 1 else ""
    what = f"points chosen during the run by {search.chosen.entry.name}, at most {adaptive.n_points}{repeats}"
    aim = f"{'most' if adaptive.maximise else 'least'} {clean(adaptive.figure)}"
    return [*lines, f"{what}, for the {aim}; all else here is as in the files"]


def _ends(axis: Axis) -> str:
    first, last = (clean(str(axis.values[i].raw or axis.values[i].plain())) for i in (0, -1))
    return f"{first} to {last}" if len(axis.values) > 1 else first


def _simulation(assembly: Assembly) -> str:
    if assembly.dry_run != "off":
        return ", dry run"
    return ", simulated" if assembly.virtual_time else ""


def _sums(checked: CheckReport, assembly: Assembly) -> list[tuple[str, str]]:
    shot = [format_quantity(t, "time") for t in (checked.shortest_shot_s, checked.longest_shot_s)]
    n = checked.n_shots
    run = [clock_time(t) for t in checked.run_s]
    points = "" if checked.n_points is None else f"{plural(checked.n_points, 'point')}, "
    points = f"at most {points}" if assembly.search is not None else points
    size = "of unknown size" if checked.shot_bytes is None else f"{size_text(checked.shot_bytes)} each"
    disk = "unknown" if checked.shot_bytes is None else f"{size_text(n * checked.shot_bytes)} at most"
    return [
        ("shot", f"{shot[0]} to {shot[1]}, {plural(checked.n_images, 'image')} at most, {size}"),
        ("run", f"{points}{plural(n, 'shot')}, {run[0]} to {run[1]}, {disk} on disk"),
    ]


def _rehearsed(checked: CheckReport) -> list[tuple[str, str]]:
    if checked.rehearsal is None:
        return []
    found = _quantiles(checked.rehearsal)
    median, p95 = (format_quantity(found[name], "time") for name in ("median", "p95"))
    text = f"{median} in the median, {p95} in 19 of 20, on {checked.rehearsal.n_loadings} random loadings"
    return [("first cycle", text)]


def size_text(n_bytes: int) -> str:
    """A size on disk for people.

    Example:
        >>> size_text(6_351_456), size_text(900)
        ('6.4 MB', '0.9 kB')
    """
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:.1f} {unit}"
    return f"{n_bytes / 1e3:.1f} kB"


def _limits(assembly: Assembly) -> list[tuple[str, str]]:
    profile, spec = assembly.bench.profile, assembly.sequence
    motion, timeouts = profile.motion, profile.timeouts
    tones = f"{motion.max_row_tones} x {motion.max_column_tones} tones"
    dop = assembly.planner.dump().get("degree_of_parallelism")
    at_once = f"{motion.max_tweezers} on at once, {tones}" + (f"; the planner uses {dop}" if dop else "")
    waits = (("device call", timeouts.call), ("safe state", timeouts.safe_state), ("plan", timeouts.plan))
    return [
        *(("window", text) for text in _windows(assembly.resolved)),
        ("mobile tweezers", at_once),
        ("attempts", f"{spec.attempts} at a shot that is repeated"),
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
        image = "follows the last batch" if settings["window_mode"] == "early" else "waits for its end"
        texts.append(f"{times} {each}, {plural(settings['cycles'], 'cycle')} at most; the image {image}")
    return texts
