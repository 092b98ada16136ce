"""``labseq check``: what a sequence will do, at most."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, cast

from labseq.cli.output import columns, encodes, say
from labseq.cli.words import clock_time, plural
from labseq.model import TimelineEntry
from labseq.session import Assembly, Session
from labseq.session.choosing import DryRun
from labseq.units import format_quantity

BAR_WIDTH: Final = 30

Timeline = Sequence[tuple[str, Sequence[TimelineEntry]]]


def check_sequence(sequence: Path, profile: str | None, overrides: Sequence[str], dry_run: DryRun) -> None:
    """Check a sequence and print its timeline and limits.

    Args:
        sequence: The sequence file.
        profile: Name or path of the profile, instead of the sequence's own.
        overrides: ``"address=value"`` strings.
        dry_run: "off", "full" or "fast".

    Raises:
        ConfigError: Sequence, profile or an override is wrong.
        UnknownPluginError: A plugin that is named does not exist.
        PluginLoadError: A plugin that is named failed to load.
    """
    session = Session.open(sequence, profile=profile, overrides=overrides, dry_run=dry_run)
    assembly, timeline = session.assembly, session.timeline()
    block = "█" if encodes(sys.stdout.encoding, "█") else "#"
    parts = (
        columns(_what(assembly)),
        timeline_table(timeline, block),
        columns(_sums(timeline, assembly.sequence.shots)),
        columns(_limits(assembly)),
    )
    say("\n\n".join("\n".join(lines) for lines in parts))
    say(*(f"warning: {text}" for text in assembly.bench.warnings), stream=sys.stderr)


def timeline_table(timeline: Timeline, block: str) -> list[str]:
    """A row per bar of the timeline: step, start, length, and the bar itself.

    Args:
        timeline: Name of each step and its bars.
        block: What bars are made of.
    """
    total_s = sum(bar.duration_s for _, bars in timeline for bar in bars)
    rows = [("step", "", "start", "at most", "")]
    start_s = 0.0
    for number, (name, bars) in enumerate(timeline):
        for i, bar in enumerate(bars):
            label = bar.label if bar.label != name else ""
            length = format_quantity(bar.duration_s, "time")
            drawn = _bar(start_s, bar.duration_s, total_s, block)
            step = f"{number} {name}" if i == 0 else ""
            rows.append((step, label, format_quantity(start_s, "time"), length, drawn))
            start_s += bar.duration_s
    return columns(rows, right=(2, 3))


def _bar(start_s: float, duration_s: float, total_s: float, block: str) -> str:
    if not total_s:
        return ""
    first, last = (round(BAR_WIDTH * t / total_s) for t in (start_s, start_s + duration_s))
    first = min(first, BAR_WIDTH - 1)
    return " " * first + block * max(1, last - first)


def _what(assembly: Assembly) -> list[tuple[str, str]]:
    target, spec = assembly.target, assembly.sequence
    grid, document = assembly.bench.grid, assembly.bench.document
    settings = {k: v for k, v in assembly.planner.dump().items() if k != "use"}
    listed = ", ".join(f"{key} {value}" for key, value in settings.items())
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
    ]


def _simulation(assembly: Assembly) -> str:
    if assembly.dry_run != "off":
        return ", dry run"
    return ", simulated" if assembly.virtual_time else ""


def _sums(timeline: Timeline, n_shots: int) -> list[tuple[str, str]]:
    bars = [bar for _, step_bars in timeline for bar in step_bars]
    shot_s = sum(bar.duration_s for bar in bars)
    n_images = sum(bar.n_images for bar in bars)
    return [
        ("shot", f"{format_quantity(shot_s, 'time')} at most, {plural(n_images, 'image')} at most"),
        ("run", f"{plural(n_shots, 'shot')}, {clock_time(n_shots * shot_s)} at most"),
    ]


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
        ("attempts", f"{spec.attempts} at a shot that fails with a transient error"),
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
