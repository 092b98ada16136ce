"""`labseq show`: what a run has recorded."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from labseq.analysis.statistics import CycleStatistics, Rate, Statistics, statistics_of
from labseq.console.errors import lines_of
from labseq.console.output import as_line, columns, count_of, outcome, percent, plural, say, settings_text
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.messages import clean, visible
from labseq.model.estimate import Estimate
from labseq.plain import to_plain
from labseq.recording import Run, Shot, data_root, open_run
from labseq.recording.folders import find_run
from labseq.recording.reader import scan_points
from labseq.units import format_quantity

if TYPE_CHECKING:
    from labseq.analysis.timing import RunTiming, StageStatistics

_MAX: Final = 5
"""Reasons, and shots of each, that are told one by one."""


def skipped_rows(run: Run) -> list[tuple[str, str]]:
    """A row for each reason why shots were skipped, with the shots, counted from 1."""
    groups = _by_reason(run)
    rows = [("skipped", f"{_numbers(shots)}: {clean(why)}") for why, shots in groups[:_MAX]]
    return (
        rows
        if len(groups) <= _MAX
        else [*rows, ("", f"and for {plural(len(groups) - _MAX, 'other reason')}")]
    )


def json_skipped(run: Run) -> list[dict[str, Any]]:
    """The same, JSON-ready; shots are counted from 0."""
    return [{"shots": shots, "why": why} for why, shots in _by_reason(run)]


def _by_reason(run: Run) -> list[tuple[str, list[int]]]:
    found: dict[str, list[int]] = {}
    for shot, why in sorted(run.skipped.items()):
        found.setdefault(why, []).append(shot)
    return [*found.items()]


def _numbers(shots: list[int]) -> str:
    told = ", ".join(str(shot + 1) for shot in shots[:_MAX])
    return f"shot {told}" if len(shots) == 1 else f"shots {told}" + (", ..." if len(shots) > _MAX else "")


INDENT: Final = "  "
OF_SHOT: Final = (
    "attempt",
    "status",
    "error",
    "success",
    "filling_fraction",
    "seen_defect_free_cycle",
    "n_cycles",
    "n_batches",
    "n_atom_moves",
    "n_missing_atoms",
    "stage_s",
    "parameters",
    "file",
)
"""What ``--json`` tells of each shot, from its line of the index."""


def shots_table(run: Run) -> list[str]:
    """A row per shot, attempts that did not complete included, with what was scanned."""
    scan: Mapping[str, Any] = run.scan
    addresses: list[str] = [str(address) for address in scan.get("addresses", ())]
    n_atoms = run.target.n_atoms
    header = (
        "shot",
        *map(clean, addresses),
        "outcome",
        "filling",
        "cycles",
        "batches",
        "atom moves",
        "shot time",
    )
    rows = [_shot_row(shot, n_atoms, _scanned(shot, scan)) for shot in _in_order(run)]
    at = len(addresses)
    return columns([header, *rows], right=(0, *range(1, at + 1), *range(at + 2, at + 7)))


def _in_order(run: Run) -> list[Shot]:
    return sorted((*run.shots, *run.attempts), key=lambda shot: (shot.index, shot.attempt))


def _scanned(shot: Shot, scan: Mapping[str, Any]) -> list[str]:
    """The scanned values of a shot, as they are written."""
    try:
        return [clean(str(word)) for word in scan["written"][scan["point_of_shot"][shot.index]]]
    except (KeyError, IndexError, TypeError):  # run.json is damaged
        return ["-"] * len(scan.get("addresses", ()))


def _shot_row(shot: Shot, n_atoms: int, scanned: list[str]) -> tuple[str, ...]:
    row = shot.row
    told = outcome(shot.success, shot.seen_defect_free_cycle, shot.filling_fraction, n_atoms)
    if shot.status != "complete":
        told = f"attempt {shot.attempt + 1} {shot.status}: {clean(str(row.get('error', '')))}"
    time_s = shot_time_s(shot)
    return (
        str(shot.index + 1),
        *scanned,
        told,
        percent(shot.filling_fraction),
        *(str(row.get(name, "-")) for name in ("n_cycles", "n_batches", "n_atom_moves")),
        format_quantity(time_s, "time") if time_s else "-",
    )


def shot_time_s(shot: Shot) -> float:
    """How long the steps of a shot took, in seconds; 0 if its line of the index does not tell."""
    found = shot.row.get("stage_s")
    stages = cast("Mapping[str, object]", found) if isinstance(found, dict) else {}  # it may be damaged
    steps_s = [s for name, s in stages.items() if name.startswith("step ")]
    return math.fsum(s for s in steps_s if isinstance(s, float | int))


def read_timing(run: Run) -> RunTiming:
    """The stages of a run's shots; of a long run, of some of them.

    Raises:
        ConfigError: It has no shots that can be read.
    """
    from labseq.analysis.overview import A_LOOK, spread
    from labseq.analysis.timing import timing_of

    timing = timing_of(run, spread(run.shots, A_LOOK))
    if not timing.n_read:
        what = "the run has no shots yet whose files can be read"
        raise ConfigError(Problem(what, clean(str(run.path)), expected="at least one"))
    return timing


def timing_table(run: Run) -> list[str]:
    """A row per stage: what it may take, and what it took."""
    timing = read_timing(run)
    clocks = ("modelled", "host") if run.simulated else ("measured",)
    header = ("stage", "a shot", "budget", *_heads(clocks), "share", "over budget")
    rows = [_stage_row(stage, n_clocks=len(clocks)) for stage in timing.stages]
    lines = columns([header, *rows], right=range(1, len(header)))
    p50_s, p99_s = (format_quantity(s, "time") for s in timing.shot_s)
    return [*lines, "", f"shot: {p50_s} (p50), {p99_s} (p99), of {timing.n_read} of {len(run.shots)} shots"]


def _heads(clocks: tuple[str, ...]) -> list[str]:
    return [head for clock in clocks for head in (f"{clock} p50", "p99")]


def _stage_row(stage: StageStatistics, *, n_clocks: int) -> tuple[str, ...]:
    clocks = (stage.session_s, stage.host_s)[:n_clocks]
    return (
        clean(stage.stage),
        f"{stage.n_per_shot:.3g}",
        _time(stage.budget_s),
        *(_time(s) for clock in clocks for s in clock),
        percent(stage.share),
        "-" if math.isnan(stage.budget_s) else f"{stage.n_over} of {stage.n}",
    )


def _time(value_s: float) -> str:
    return "-" if math.isnan(value_s) else format_quantity(value_s, "time")


def devices_table(run: Run) -> list[str]:
    """What each device said of itself when the run began."""
    width = shutil.get_terminal_size().columns
    lines: list[str] = []
    for name, told in _devices(run).items():
        settings = {key: value for key, value in told.items() if key != "model"}
        lines.append(visible(f"{name}: {told.get('model', 'no model told')}"))
        wrapped = textwrap.wrap(visible(settings_text(settings)), max(20, width - len(INDENT)))
        lines += [INDENT + line for line in wrapped]
    return lines or ["the devices were not opened"]


def _devices(run: Run) -> dict[str, dict[str, Any]]:
    found: Any = run.record.get("devices") or {}
    return {str(name): dict(told) if isinstance(told, Mapping) else {} for name, told in found.items()}  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]


def json_shots(run: Run) -> list[dict[str, Any]]:
    """The shots as ``--json`` tells them: indices from 0, SI units, null for what is not known."""
    return [
        {"index": shot.index, **{name: to_plain(shot.row.get(name)) for name in OF_SHOT}}
        for shot in _in_order(run)
    ]


def json_timing(run: Run) -> dict[str, Any]:
    """The stages as ``--json`` tells them."""
    timing = read_timing(run)
    stages = [
        {
            "stage": stage.stage,
            "n": stage.n,
            "n_per_shot": stage.n_per_shot,
            "budget_s": stage.budget_s,
            "session_s": _named(stage.session_s),
            "host_s": _named(stage.host_s),
            "share": stage.share,
            "n_over": stage.n_over,
        }
        for stage in timing.stages
    ]
    return to_plain({"n_read": timing.n_read, "shot_s": _named(timing.shot_s), "stages": stages})


def _named(quantiles: tuple[float, float]) -> dict[str, float]:
    return dict(zip(("p50", "p99"), quantiles, strict=True))


def json_devices(run: Run) -> dict[str, Any]:
    """The devices as ``--json`` tells them."""
    return to_plain(_devices(run))


MAX_DEFECTS: Final = 6
"""From this number of defects on shots are counted together."""
NOT_JUDGED: Final = "not judged: no image step after the last rearrangement"


def cycle_table(statistics: Statistics) -> list[str]:
    """A row per cycle, judged on the image that ended it; nothing without cycles."""
    if not statistics.cycles:
        return []
    header = ("cycle", "shots", "defect-free", "filling", "atom moves", "batches", "left out")
    lines = columns([header, *map(_cycle_row, statistics.cycles)], right=range(len(header)))
    if statistics.cycles[-1].n_shots < statistics.cycles[0].n_shots:
        lines.append("each cycle on its own image, without the shots that had ended before it")
    else:
        lines.append("each cycle on its own image")
    return lines


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


def rate_text(rate: Rate) -> str:
    """A rate in per cent, with its interval.

    Example:
        >>> rate_text(Rate(7, 20)), rate_text(Rate(0, 0))
        ('35.0 % (25.3 to 46.2)', '-')
    """
    if not rate.n_trials:
        return "-"
    low, high = rate.interval
    return f"{100 * rate.value:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def counted_text(rate: Rate) -> str:
    """A rate with what it was counted of, and its interval.

    Example:
        >>> counted_text(Rate(7, 20)), counted_text(Rate(0, 0))
        ('7 of 20 (35.0 %), 25.3 to 46.2 %', '0 of 0')
    """
    if not rate.n_trials:
        return count_of(0, 0)
    low, high = rate.interval
    return f"{count_of(rate.n, rate.n_trials)}, {100 * low:.1f} to {100 * high:.1f} %"


def share_text(fraction: Estimate) -> str:
    """A mean fraction in per cent.

    Example:
        >>> share_text(Estimate(0.97664, 0.0004))
        '97.66(4) %'
    """
    text = str(fraction.scaled(100.0))
    return text if text == "-" else f"{text} %"


def statistics_rows(statistics: Statistics) -> list[tuple[str, str]]:
    """What came of the shots: name and value of each line."""
    one = statistics
    judged = bool(one.defect_free.n_trials)
    rows = [
        ("defect-free", counted_text(one.defect_free) if judged or not one.n_shots else NOT_JUDGED),
        ("seen defect-free", count_of(one.seen.n, one.seen.n_trials)),
        ("filling", share_text(one.filling)),
    ]
    if one.defects:
        rows.append(("defects", histogram_text(one.defects)))
    elif one.cycles and not judged:
        rows.append(("defects", f"{histogram_text(one.cycles[-1].defects)}, after cycle {len(one.cycles)}"))
    if one.too_short.n:
        rows.append(("window", f"too short in {count_of(one.too_short.n, one.too_short.n_trials)}"))
    if one.losses:
        causes = [f"{cause.replace('_', ' ')} {loss}" for cause, loss in one.losses.items() if loss.value]
        rows.append(("lost in a shot", ", ".join(causes) or "no atoms"))
    if not math.isnan(one.defects_true.value):
        rows.append(("true defects", f"{one.defects_true} in a shot, {one.defects_seen} on its last image"))
    if one.unreadable:
        which = ", ".join(str(index + 1) for index in one.unreadable[:5])
        more = ", ..." if len(one.unreadable) > 5 else ""
        damaged = f"{plural(len(one.unreadable), 'shot')} cannot be read and {_are(one.unreadable)} left out"
        rows.append(("warning", f"{damaged} of cycles and defects: {which}{more}"))
    return rows


def histogram_text(counts: Sequence[int]) -> str:
    """How many shots have how many defects; the highest numbers together if there are many.

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


def _are(items: Sequence[object]) -> str:
    return "is" if len(items) == 1 else "are"


MAX_ROWS: Final = 40
"""Rows of a table; of a longer one the first and the last are shown."""


@dataclass(frozen=True, slots=True)
class Tables:
    """Which tables are wanted; the summary if none is."""

    shots: bool = False
    timing: bool = False
    scan: bool = False
    devices: bool = False

    @property
    def any(self) -> bool:
        """Whether one is."""
        return self.shots or self.timing or self.scan or self.devices


def show_run(path: Path | None, *, as_json: bool, tables: Tables | None = None) -> None:
    """Print what a run has recorded.

    Args:
        path: The run's folder or any file in it; None for the newest run.
        as_json: Whether to print one line of JSON instead.
        tables: Which tables to print instead of the summary.

    Raises:
        ConfigError: There is no such run, or it has not what a table is to show.
        RecordingError: It is damaged.
    """
    wanted = tables or Tables()
    try:
        run = chosen_run(path)
        values = (_json_tables(run, wanted) if wanted.any else json_summary(run)) if as_json else {}
    except LabseqError as error:
        if as_json:
            say(as_line(json_summary(None) | {"error": "\n".join(lines_of(error))}))
        raise
    if as_json:
        say(as_line(values))
    elif wanted.any:
        say(*_output_lines(run, wanted))
    else:
        say(*shot_table(run), "", *summary_lines(run))


def _output_lines(run: Run, wanted: Tables) -> list[str]:
    """The tables that are wanted, with an empty line between them."""
    found: list[list[str]] = []
    if wanted.shots:
        found.append(shots_table(run))
    if wanted.timing:
        found.append(timing_table(run))
    if wanted.scan:
        found.append(_points(run))
    if wanted.devices:
        found.append(devices_table(run))
    return [line for table in found for line in ("", *table)][1:]


def _points(run: Run) -> list[str]:
    lines = point_table(run, whole=True)
    if not lines and run.skipped and run.record.get("scan"):
        return [f"no point of the scan has a shot: {len(run.skipped)} of {run.n_shots} were skipped"]
    if not lines:
        what = "the run has no scan" if not run.record.get("scan") else "the scan has no shots yet"
        raise ConfigError(Problem(what, clean(str(run.path)), expected="a run of a sequence with 'scan:'"))
    return lines


def _json_tables(run: Run, wanted: Tables) -> dict[str, Any]:
    values: dict[str, Any] = {"run_dir": str(run.path), "status": run.status}
    if wanted.shots:
        values["shot_list"] = json_shots(run)
    if wanted.timing:
        values["timing"] = json_timing(run)
    if wanted.scan:
        _points(run)
        values["points"] = _json_points(run)
    if wanted.devices:
        values["devices"] = json_devices(run)
    return values


def chosen_run(path: Path | None) -> Run:
    """Open the run that a command is given.

    Args:
        path: The run's folder or any file in it; None for the newest run.

    Raises:
        ConfigError: There is no such run: a mistake of the user, not of the data.
        RecordingError: It is damaged.
    """
    return open_run(newest_run(data_root()) if path is None else existing(path))


def existing(path: Path) -> Path:
    """The folder of the run that a command is given.

    Raises:
        ConfigError: There is no such run: a mistake of the user, not of the data.
    """
    try:
        return find_run(path)
    except RecordingError as error:
        raise ConfigError(str(error)) from error
    except OSError as error:
        reason = str(error.strerror or error).lower()
        raise ConfigError(Problem(f"the folder cannot be read: {reason}", clean(str(path)))) from error


def newest_run(root: Path) -> Path:
    """The folder of the run that was started last: newest day, highest counter.

    Raises:
        ConfigError: There is none.
    """
    folders = [file.parent for file in root.glob("*-*-*/*_*/run.json")]
    if not folders:
        raise ConfigError(f"{root} holds no runs; give a run's folder, or set LABSEQ_DATA")
    return max(folders, key=lambda folder: (folder.parent.name, _counter(folder)))


def _counter(folder: Path) -> int:
    number = folder.name.partition("_")[0]
    return int(number) if number.isdecimal() else -1


def json_summary(run: Run | None) -> dict[str, Any]:
    """What ``--json`` prints; for None, what is true of a run that never came to be."""
    if run is None:
        nothing = {"defect_free": None, "filling_fraction": None}
        return {"run_dir": None, "shots": 0, **nothing, "status": "failed"}
    values = run.summary() | {"statistics": statistics_of(run.shots, run.target).as_dict()}
    if points := _json_points(run):
        values["points"] = points
    if run.skipped:
        values["skipped_shots"] = json_skipped(run)
    return values | ({"error": run.error} if run.error else {})


def _json_points(run: Run) -> list[dict[str, Any]]:
    points = [(point, statistics_of(point.shots, run.target)) for point in scan_points(run)]
    return [
        {
            "parameters": dict(point.parameters),
            "shots": len(point.shots),
            "defect_free": to_plain(statistics.defect_free.value),
            "filling_fraction": to_plain(statistics.filling.value),
            "statistics": statistics.as_dict(),
        }
        for point, statistics in points
    ]


def point_table(run: Run, *, whole: bool = False) -> list[str]:
    """A table of the scan's points; nothing without a scan.

    Where no shot is judged, the images that ended the last cycles are.

    Args:
        run: The run.
        whole: Whether a long table is shown in full.
    """
    points = [(point, statistics_of(point.shots, run.target)) for point in scan_points(run)]
    if not points:
        return []
    judged = any(statistics.defect_free.n_trials for _, statistics in points)
    rows: list[tuple[str, ...]] = []
    for point, statistics in points:
        shown = statistics if judged or not statistics.cycles else statistics.cycles[-1]
        written = map(clean, point.written.values())
        n_shots = str(len(point.shots))
        rows.append((*written, n_shots, share_text(shown.filling), counted_text(shown.defect_free)))
    names = ("filling", "defect-free")
    last = names if judged else tuple(f"{name}, last cycle" for name in names)
    header = (*map(clean, points[0][0].written), "shots", *last)
    lines = columns([header, *rows], right=tuple(range(len(header) - 1)))
    return lines if whole else _shortened(lines)


def _shortened(lines: list[str]) -> list[str]:
    """The first and the last rows of a long table."""
    if len(lines) - 1 <= MAX_ROWS:
        return lines
    half = MAX_ROWS // 2
    return [*lines[: half + 1], "...", *lines[-half:]]


def shot_table(run: Run) -> list[str]:
    """A table of the shots that count."""
    n_atoms = run.target.n_atoms
    rows = [_show_shot_row(shot, n_atoms) for shot in run.shots]
    header = ("shot", "outcome", "filling", "cycles", "atom moves", "shot time")
    return _shortened(columns([header, *rows], right=(0, 2, 3, 4, 5)))


def _show_shot_row(shot: Shot, n_atoms: int) -> tuple[str, ...]:
    row, duration_s = shot.row, shot_time_s(shot)
    return (
        str(shot.index + 1),
        outcome(shot.success, shot.seen_defect_free_cycle, shot.filling_fraction, n_atoms),
        percent(shot.filling_fraction),
        str(row.get("n_cycles", "-")),
        str(row.get("n_atom_moves", "-")),
        format_quantity(duration_s, "time") if duration_s else "-",
    )


def summary_lines(run: Run) -> list[str]:
    """What came of the run: a table of its points or cycles, and the whole of it in a few lines."""
    statistics = statistics_of(run.shots, run.target)
    table = point_table(run) or cycle_table(statistics)
    rows = [
        ("run", str(run.path)),
        ("status", f"{run.status}: {run.error}" if run.status == "failed" else run.status),
        ("shots", f"{len(run.shots)} of {run.n_shots}" + _skipped(run) + _repeated(run)),
        *skipped_rows(run),
        *statistics_rows(statistics),
        ("duration", _duration(run)),
    ]
    if run.n_damaged_lines:
        rows.append(("warning", f"{plural(run.n_damaged_lines, 'line')} of the index cannot be read"))
    return [*table, *([""] if table else []), *columns(rows)]


def _repeated(run: Run) -> str:
    return f", {plural(len(run.attempts), 'attempt')} kept that did not complete" if run.attempts else ""


def _skipped(run: Run) -> str:
    return f", {len(run.skipped)} skipped" if run.skipped else ""


def _duration(run: Run) -> str:
    """From the start of the run to the end of its last shot, on the clock on the wall."""
    ends = [str(shot.row.get("t_end_utc") or "") for shot in (*run.shots, *run.attempts)]
    try:
        start = datetime.fromisoformat(str(run.record["t_start_utc"]))
        duration = max(datetime.fromisoformat(text) for text in ends if text) - start
    except (KeyError, ValueError, TypeError):  # no shots, or a damaged index
        return "-"
    return format_quantity(duration.total_seconds(), "time")
