"""The summary of a run, with a table of its points or cycles and a few lines of statistics. Also as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from labseq.analysis.scanned import (
    ScanReport,
    ScanRequest,
    counted_text,
    rate_text,
    results_of,
    scan_report,
    share_text,
    title_of,
    value_text,
)
from labseq.analysis.statistics import CycleStatistics, Statistics, statistics_of
from labseq.console.errors import lines_of
from labseq.console.report import Column, Facts, aligned, table
from labseq.console.text import count_of, percent, plural, quoted
from labseq.data.best import BestPoint, BestShot, best_point, best_shot
from labseq.data.follower import Follower
from labseq.data.quantities import WITH_TARGET, Quantity, measured_by, quantity_of
from labseq.data.reader import Run
from labseq.data.scanned import scanned
from labseq.errors import StopRequested
from labseq.messages import clean, one_line, visible
from labseq.model.estimate import Estimate, Estimated, mean
from labseq.units import format_quantity
from labseq.watchdog import watchdog_lines

MAX_ROWS: Final = 40
"""Maximum number of rows of a table. The first and last rows of a longer table are shown."""
MAX_LISTED: Final = 5
"""Maximum number of reasons, and of shots for each, that are listed one by one."""
MAX_DEFECTS: Final = 6
"""Shots with at least this many defects are counted together."""
NOT_JUDGED: Final = "not judged: no image step after the last rearrangement"


@dataclass(frozen=True, slots=True)
class SkippedShots:
    """Shots that a policy skipped for the same reason."""

    shots: Sequence[int]
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """The result of a run. If the run never started, only the status and the error are known.

    Attributes:
        run_dir: The run's folder.
        name: Name of the sequence.
        profile: Name of the hardware profile.
        target: Name of the target, or "".
        changes: Settings changed by ``--set`` and other options: address -> value, as it was typed.
        note: The note about the run.
        tags: Tags of the run.
        shots: Number of shots that were taken.
        skipped: Number of shots that were skipped.
        defect_free: Fraction of the shots that met the target.
        filling_fraction: Mean filling of the target.
        status: "complete", "stopped", "failed" or "running".
        error: Why the run failed.
        ended_early: Why the run is complete before its last shot.
        statistics: Results of the shots.
        n_shots: Requested number of shots.
        skipped_shots: The reasons why shots were skipped, each with its shots.
        n_attempts: Number of attempts that did not complete.
        has_target: Whether the sequence has a target.
        n_atoms: Mean number of atoms on the first and on the last image. Empty without images.
        measured: The measured quantities, each with its mean over all shots.
        scan: The measured quantities at each point of the scan, with fits.
        results: Name and value of each requested result of a fit.
        best: The best point of an adaptive scan.
        best_shot: The shot that came closest to the target.
        simulated_time_s: Time that the shots took in a simulated run.
        wall_time_s: Time on the computer's clock until the end of the last shot, summed over
            all parts of a resumed run.
        watchdog: The watchdog's actions.
        resumed: Where the run was resumed, and how it had ended before.
        n_damaged_lines: Lines of the index that cannot be read.
    """

    run_dir: Path | None = None
    name: str = ""
    profile: str = ""
    target: str = ""
    changes: Mapping[str, str] = field(default_factory=dict[str, str])
    note: str = ""
    tags: Sequence[str] = ()
    shots: int = 0
    skipped: int = 0
    defect_free: float = math.nan
    filling_fraction: float = math.nan
    status: str = "failed"
    error: str | None = None
    ended_early: str = ""
    statistics: Statistics | None = None
    n_shots: int = 0
    skipped_shots: Sequence[SkippedShots] = ()
    n_attempts: int = 0
    has_target: bool = True
    n_atoms: Sequence[Estimate] = ()
    measured: Sequence[tuple[Quantity, Estimated]] = ()
    scan: ScanReport | None = None
    results: Sequence[tuple[str, str]] = ()
    best: BestPoint | None = None
    best_shot: BestShot | None = None
    simulated_time_s: float = math.nan
    wall_time_s: float = math.nan
    watchdog: Sequence[str] = ()
    resumed: Sequence[str] = ()
    n_damaged_lines: int = 0

    @classmethod
    def of(cls, run: Run) -> Summary:
        """The result of a run so far."""
        scan = None if scanned(run) is None else scan_report(run, ScanRequest())
        return cls(
            run_dir=run.path,
            name=run.name,
            profile=str(((run.record.get("resolved") or {}).get("profile") or {}).get("name") or ""),
            target="" if run.target.is_none else run.target.name,
            changes=run.changes,
            note=run.note,
            tags=run.tags,
            shots=len(run.shots),
            skipped=len(run.skipped),
            defect_free=run.defect_free,
            filling_fraction=run.filling_fraction,
            status=run.status,
            error=run.error or None,
            ended_early=run.ended_early,
            statistics=statistics_of(run.shots, run.target),
            n_shots=run.n_shots,
            skipped_shots=_by_reason(run),
            n_attempts=len(run.attempts),
            has_target=not run.target.is_none,
            n_atoms=_n_atoms(run),
            measured=[(one := quantity_of(run, name), one.over(run.shots)) for name in measured_by(run)],
            scan=scan,
            results=results_of(run, scan) if scan else (),
            best=best_point(run),
            best_shot=best_shot(run),
            simulated_time_s=sum(shot.row.duration_s for shot in run.shots) if run.simulated else math.nan,
            wall_time_s=_wall_time_s(run),
            watchdog=watchdog_lines(run.path),
            resumed=_resumed(run),
            n_damaged_lines=run.n_damaged_lines,
        )

    def ended_by(self, failure: BaseException) -> Summary:
        """The same with an error, which may be missing in the run's files because the disk was full."""
        status = "stopped" if isinstance(failure, StopRequested | KeyboardInterrupt) else "failed"
        return replace(self, status=status, error="\n".join(lines_of(failure)))

    def as_json(self) -> dict[str, Any]:
        """All attributes. The points of a scan are keys at the same level."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "scan"}
        values["measured"] = {quantity.name: mean for quantity, mean in self.measured}
        values["results"] = dict(self.results)
        return values | (self.scan.as_json() if self.scan else {})

    def as_text(self) -> list[str]:
        """A table of the points or cycles, and the statistics."""
        tables = self.scan.table(MAX_ROWS) if self.scan else cycle_table(self.statistics)
        has_missing = self.status in ("stopped", "failed") and self.shots + self.skipped < self.n_shots
        next_step: list[str] = []
        if has_missing and self.status == "failed" and not self.shots:
            # a resumed run has the files as they were, and the cause is mostly in them
            next_step = ["correct the cause, then run the sequence again"]
        elif has_missing and self.run_dir:
            next_step = [f"resume it with: labseq resume {quoted(self.run_dir)}"]
        return [*tables, *([""] if tables else []), *aligned(self._facts()), *next_step]

    def _facts(self) -> Facts:
        skipped = f", {self.skipped} skipped" if self.skipped else ""
        kept = f", {plural(self.n_attempts, 'attempt')} kept that did not complete" if self.n_attempts else ""
        damaged = f"{plural(self.n_damaged_lines, 'line')} of the index cannot be read"
        return [
            ("run", str(self.run_dir)),
            *self._about(),
            ("status", f"failed: {self.error}" if self.error and self.status == "failed" else self.status),
            ("shots", f"{self.shots} of {self.n_shots}{skipped}{kept}"),
            *([("ended early", one_line(self.ended_early))] if self.ended_early else []),
            *_skipped_rows(self.skipped_shots),
            *_best_rows(self.best),
            *(statistics_rows(self.statistics) if self.has_target else _atom_rows(self.n_atoms)),
            *(_best_shot_rows(self.best_shot) if self.shots > 1 else []),
            *_measured_rows(self.measured, is_judged=_is_judged(self.statistics)),
            *((clean(name), value) for name, value in self.results),
            *_time_rows(self.simulated_time_s, self.wall_time_s),
            *(("watchdog", one_line(line)) for line in self.watchdog),
            *(("resumed", line) for line in self.resumed),
            *([("warning", damaged)] if self.n_damaged_lines else []),
        ]

    def _about(self) -> Facts:
        """Files, changed settings, note and tags of the run."""
        on, to = f" on {self.profile}" if self.profile else "", f", to {self.target}" if self.target else ""
        rows = {
            "sequence": f"{self.name}{on}{to}",
            "changed": ", ".join(f"{address}={value}" for address, value in self.changes.items()),
            "note": self.note,
            "tags": ", ".join(self.tags),
        }
        return [(name, visible(text)) for name, text in rows.items() if text]


def _best_rows(best: BestPoint | None) -> Facts:
    """The best point of an adaptive scan, with its value and the suggested one."""
    if best is None:
        return []
    at = ", ".join(f"{clean(address)} {value}" for address, value in best.point.written.items())
    value = f"{title_of(best.quantity)} {value_text(best.value, best.quantity)}"
    suggested = ", ".join(f"{clean(address)} {value}" for address, value in best.suggested.items())
    source = "a parabola through the points near it" if best.is_fitted else "best point, as no parabola fits"
    return [("best point", f"{at}: {value}"), ("suggested", f"{suggested} ({source})")]


def _best_shot_rows(best: BestShot | None) -> Facts:
    """The number of the shot to look at first, and how close to the target it came."""
    if best is None:
        return []
    filled = "defect-free" if best.success else f"{percent(best.filling)} filled"
    cycles, duration = plural(best.n_cycles, "cycle"), format_quantity(best.duration_s, "time")
    return [("best shot", f"{best.shot}: {filled} after {cycles}, {duration}")]


def _resumed(run: Run) -> list[str]:
    """A line for each time that a run was resumed. Runs of earlier versions do not record how they ended."""
    entries: Any = run.record.get("resumed") or ()
    return [
        f"at shot {entry.get('first_shot')}, after it had {one_line(str(entry.get('before', 'ended early')))}"
        for entry in entries
        if isinstance(entry, dict)
    ]


def _n_atoms(run: Run) -> list[Estimate]:
    counts = [shot.row.images.n_atoms for shot in run.shots if len(shot.row.images)]
    return [mean([of_shot[i] for of_shot in counts]) for i in (0, -1)] if counts else []


def _atom_rows(n_atoms: Sequence[Estimate]) -> Facts:
    """The atoms on the images of a run without a target."""
    texts = [f"{n} on the {which} image" for n, which in zip(n_atoms, ("first", "last"), strict=False)]
    return [("target", "none"), *([("atoms", ", ".join(texts))] if texts else [])]


def _measured_rows(measured: Sequence[tuple[Quantity, Estimated]], *, is_judged: bool) -> Facts:
    """The measured quantities over all shots, without those that have rows of their own.

    If shots are not judged, this includes the filling of their last image.
    """
    own = (one for one in measured if one[0].name not in (WITH_TARGET if is_judged else WITH_TARGET[1:]))
    return [(title_of(quantity), _mean_text(quantity, mean)) for quantity, mean in own]


def _mean_text(quantity: Quantity, mean: Estimated) -> str:
    """A mean over the shots of a run, or a hint if no shot has a value because it is never read."""
    if not math.isnan(mean.value):
        return value_text(mean, quantity)
    return f"no shot has this value; see the available values with labseq show --scan {clean(quantity.name)}"


CYCLES: Final[Sequence[Column[CycleStatistics]]] = (
    Column("cycle", lambda cycle: cycle.cycle, right=True),
    Column("shots", lambda cycle: cycle.n_shots, right=True),
    Column("defect-free", lambda cycle: rate_text(cycle.defect_free), right=True),
    Column("filling", lambda cycle: share_text(cycle.filling), right=True),
    Column("atom moves", lambda cycle: cycle.n_atom_moves, right=True),
    Column("batches", lambda cycle: cycle.n_batches, right=True),
    Column("left out", lambda cycle: cycle.n_left_out, right=True),
)


def cycle_table(statistics: Statistics | None) -> list[str]:
    """A row per cycle, judged on the image at its end. Empty without cycles."""
    if statistics is None or not statistics.cycles:
        return []
    ended = statistics.cycles[-1].n_shots < statistics.cycles[0].n_shots
    reached = ", and only shots that reached it count" if ended else ""
    return [*table(statistics.cycles, CYCLES), f"each cycle is judged on its own final image{reached}"]


def _is_judged(results: Statistics | None) -> bool:
    return results is not None and bool(results.defect_free.n_trials)


def statistics_rows(results: Statistics | None) -> Facts:
    """The results of the shots: name and value of each line."""
    if results is None:
        return []
    is_judged = _is_judged(results)
    rows = [
        (
            "defect-free",
            counted_text(results.defect_free) if is_judged or not results.n_shots else NOT_JUDGED,
        ),
        ("seen defect-free", count_of(results.seen.n, results.seen.n_trials)),
        *([("filling", share_text(results.filling))] if is_judged else []),
    ]
    if results.defects:
        rows.append(("defects", histogram_text(results.defects)))
    elif results.cycles and not is_judged:
        rows.append(
            (
                "defects",
                f"{histogram_text(results.cycles[-1].defects)}, after {plural(len(results.cycles), 'cycle')}",
            )
        )
    if results.too_short.n:
        rows.append(("window", f"too short in {count_of(results.too_short.n, results.too_short.n_trials)}"))
    if results.losses:
        causes = [f"{cause.replace('_', ' ')} {loss}" for cause, loss in results.losses.items() if loss.value]
        rows.append(("lost in a shot", ", ".join(causes) or "no atoms"))
    if not math.isnan(results.defects_true.value):
        rows += [
            ("true defects", f"{results.defects_true} at the end of a shot, known from the simulation"),
            ("seen defects", f"{results.defects_seen} on the last image of a shot"),
        ]
    return rows


def histogram_text(counts: Sequence[int]) -> str:
    """The number of shots with each number of defects, as text. High numbers are counted together.

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


def _skipped_rows(skipped: Sequence[SkippedShots]) -> Facts:
    """A row for each reason why shots were skipped, with the shots."""
    rows = [
        (
            "skipped",
            f"{'shot' if len(group.shots) == 1 else 'shots'} {_numbers(group.shots)}: {one_line(group.why)}",
        )
        for group in skipped[:MAX_LISTED]
    ]
    n_more = len(skipped) - MAX_LISTED
    return rows if n_more <= 0 else [*rows, ("", f"and for {plural(n_more, 'other reason')}")]


def _by_reason(run: Run) -> list[SkippedShots]:
    """The reasons why shots were skipped, each with the indices of its shots."""
    shots_of: dict[str, list[int]] = {}
    for shot, why in sorted(run.skipped.items()):
        shots_of.setdefault(why, []).append(shot)
    return [SkippedShots(shots, why) for why, shots in shots_of.items()]


def _numbers(shots: Sequence[int]) -> str:
    """The indices of the first shots."""
    return ", ".join(str(shot) for shot in shots[:MAX_LISTED]) + (", ..." * (len(shots) > MAX_LISTED))


def _time_rows(simulated_s: float, wall_s: float) -> Facts:
    """The duration of the run. For a simulated run both the shots' time and the computer's time are given."""
    wall_time = "-" if math.isnan(wall_s) else format_quantity(wall_s, "time")
    if math.isnan(simulated_s):
        return [("wall time", wall_time)]
    simulated = f"{format_quantity(simulated_s, 'time')} in all shots together"
    return [("simulated time", simulated), ("computer time", wall_time)]


def _wall_time_s(run: Run) -> float:
    ends = {"shot_finished", "shot_repeated"}
    times_s = [event.t_s for event in Follower(run.path).log() if event.name in ends]
    return max(times_s, default=math.nan)
