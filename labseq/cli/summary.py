"""The summary of a run: a table of its points or cycles, and a few lines of statistics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from labseq.analysis.scanned import (
    ScanRequest,
    counted_text,
    rate_text,
    scan_report,
    scanned,
    share_text,
    title_of,
    value_text,
)
from labseq.analysis.statistics import CycleStatistics, Statistics, statistics_of
from labseq.console.report import aligned
from labseq.console.text import count_of, plural, quoted
from labseq.data import Run
from labseq.data.best import best_point
from labseq.data.follower import Follower
from labseq.messages import clean
from labseq.model.estimate import mean
from labseq.units import format_quantity
from labseq.watchdog import watchdog_lines

MAX_ROWS: Final = 40
"""Maximum number of rows of a table; of a longer one the first and the last are shown."""
MAX_LISTED: Final = 5
"""Maximum number of reasons, and of shots for each, that are listed one by one."""
MAX_DEFECTS: Final = 6
"""Shots with at least this many defects are counted together."""
NOT_JUDGED: Final = "not judged: no image step after the last rearrangement"


def summary_lines(run: Run) -> list[str]:
    """A table of the run's points or cycles, and its statistics. Shots and cycles are counted from 0."""
    statistics = statistics_of(run.shots, run.target)
    table = cycle_table(statistics)
    if scanned(run) is not None:
        table = scan_report(run, ScanRequest()).table(MAX_ROWS)
    skipped = f", {len(run.skipped)} skipped" if run.skipped else ""
    kept = f", {plural(len(run.attempts), 'attempt')} kept that did not complete" if run.attempts else ""
    rows = [
        ("run", str(run.path)),
        ("status", f"{run.status}: {run.error}" if run.status == "failed" else run.status),
        ("shots", f"{len(run.shots)} of {run.n_shots}{skipped}{kept}"),
        *_skipped_rows(run),
        *_best_rows(run),
        *(_atom_rows(run) if run.target.is_none else statistics_rows(statistics)),
        ("wall time", _wall_time(run)),
    ]
    rows += [("watchdog", clean(line)) for line in watchdog_lines(run.path)]
    if run.n_damaged_lines:
        rows.append(("warning", f"{plural(run.n_damaged_lines, 'line')} of the index cannot be read"))
    resume = (
        [f"resume it with: labseq resume {quoted(run.path)}"] if run.status in ("stopped", "failed") else []
    )
    return [*table, *([""] if table else []), *aligned(rows), *resume]


def _best_rows(run: Run) -> list[tuple[str, str]]:
    """The best point of an adaptive scan, with its value and the suggested one."""
    best = best_point(run)
    if best is None:
        return []
    at = ", ".join(f"{clean(address)} {value}" for address, value in best.point.written.items())
    value = f"{title_of(best.quantity)} {value_text(best.value, best.quantity)}"
    suggested = ", ".join(f"{clean(address)} {value}" for address, value in best.suggested.items())
    source = "a parabola through the points near it" if best.is_fitted else "no parabola fits: the best point"
    return [("best point", f"{at}: {value}"), ("suggested", f"{suggested} ({source})")]


def _atom_rows(run: Run) -> list[tuple[str, str]]:
    """The atoms on the first and the last image of the shots of a run without a target."""
    counts = [shot.row.images.n_atoms for shot in run.shots if len(shot.row.images)]
    first, last = (mean([of_shot[i] for of_shot in counts]) for i in (0, -1))
    return [
        ("target", "none"),
        *([("atoms", f"{first} on the first image, {last} on the last")] if counts else []),
    ]


def json_summary(run: Run | None) -> dict[str, Any]:
    """The summary as ``--json`` prints it; None for a run that never started."""
    if run is None:
        nothing = {"defect_free": None, "filling_fraction": None}
        return {"run_dir": None, "shots": 0, **nothing, "status": "failed"}
    values = run.summary() | {"statistics": statistics_of(run.shots, run.target)}
    if scanned(run) is not None:
        values |= scan_report(run, ScanRequest()).as_json()
    if (best := best_point(run)) is not None:
        values["best"] = best
    if run.skipped:
        values["skipped_shots"] = [{"shots": shots, "why": why} for why, shots in _by_reason(run)]
    return values | ({"error": run.error} if run.error else {})


def cycle_table(statistics: Statistics) -> list[str]:
    """A row per cycle, judged on the image at its end; empty without cycles."""
    if not statistics.cycles:
        return []
    header = ("cycle", "shots", "defect-free", "filling", "atom moves", "batches", "left out")
    lines = aligned([header, *map(_cycle_row, statistics.cycles)], right=range(len(header)))
    ended = statistics.cycles[-1].n_shots < statistics.cycles[0].n_shots
    reached = "; only shots that reached it count" if ended else ""
    return [*lines, f"each cycle is judged on its own final image{reached}"]


def _cycle_row(cycle: CycleStatistics) -> tuple[str, ...]:
    return (
        str(cycle.cycle),
        str(cycle.n_shots),
        rate_text(cycle.defect_free),
        share_text(cycle.filling),
        str(cycle.n_atom_moves),
        str(cycle.n_batches),
        str(cycle.n_left_out),
    )


def statistics_rows(statistics: Statistics) -> list[tuple[str, str]]:
    """The results of the shots: name and value of each line."""
    one = statistics
    is_judged = bool(one.defect_free.n_trials)
    rows = [
        ("defect-free", counted_text(one.defect_free) if is_judged or not one.n_shots else NOT_JUDGED),
        ("seen defect-free", count_of(one.seen.n, one.seen.n_trials)),
        ("filling", share_text(one.filling)),
    ]
    if one.defects:
        rows.append(("defects", histogram_text(one.defects)))
    elif one.cycles and not is_judged:
        rows.append(
            ("defects", f"{histogram_text(one.cycles[-1].defects)}, after {plural(len(one.cycles), 'cycle')}")
        )
    if one.too_short.n:
        rows.append(("window", f"too short in {count_of(one.too_short.n, one.too_short.n_trials)}"))
    if one.losses:
        causes = [f"{cause.replace('_', ' ')} {loss}" for cause, loss in one.losses.items() if loss.value]
        rows.append(("lost in a shot", ", ".join(causes) or "no atoms"))
    if not math.isnan(one.defects_true.value):
        rows.append(("true defects", f"{one.defects_true} in a shot, {one.defects_seen} on its last image"))
    return rows


def histogram_text(counts: Sequence[int]) -> str:
    """The number of shots with each number of defects, as text; high numbers are counted together.

    Example:
        >>> histogram_text((7, 5, 0, 2))
        'none in 7, 1 in 5, 3 in 2 shots'
        >>> histogram_text((1,) * 12)
        'none in 1, 1 in 1, 2 in 1, 3 in 1, 4 in 1, 5 in 1, 6 or more in 6 shots'
    """
    apart = len(counts) if len(counts) <= MAX_DEFECTS + 1 else MAX_DEFECTS
    parts = [f"{n or 'none'} in {count}" for n, count in enumerate(counts[:apart]) if count]
    if rest := sum(counts[apart:]):
        parts.append(f"{apart} or more in {rest}")
    return f"{', '.join(parts)} shots"


def _skipped_rows(run: Run) -> list[tuple[str, str]]:
    """A row for each reason why shots were skipped, with the shots."""
    groups = _by_reason(run)
    rows = [
        ("skipped", f"{'shot' if len(shots) == 1 else 'shots'} {_numbers(shots)}: {clean(why)}")
        for why, shots in groups[:MAX_LISTED]
    ]
    n_more = len(groups) - MAX_LISTED
    return rows if n_more <= 0 else [*rows, ("", f"and for {plural(n_more, 'other reason')}")]


def _by_reason(run: Run) -> list[tuple[str, list[int]]]:
    """The reasons why shots were skipped, each with the indices of its shots."""
    found: dict[str, list[int]] = {}
    for shot, why in sorted(run.skipped.items()):
        found.setdefault(why, []).append(shot)
    return [*found.items()]


def _numbers(shots: Sequence[int]) -> str:
    """The indices of the first shots."""
    return ", ".join(str(shot) for shot in shots[:MAX_LISTED]) + (", ..." * (len(shots) > MAX_LISTED))


def _wall_time(run: Run) -> str:
    """Time until the end of the last shot; of a resumed run, of all its parts together."""
    ends = {"shot_finished", "shot_repeated"}
    until_s = max((event.t_s for event in Follower(run.path).events() if event.name in ends), default=0.0)
    return "-" if not until_s else f"{format_quantity(until_s, 'time')} on the computer's clock"
