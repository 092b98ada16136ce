"""The events of a run as lines of text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TextIO

from labseq.console.output import compiling_text, say
from labseq.console.text import percent, plural
from labseq.messages import clean
from labseq.model import RunRecord
from labseq.model.image_quantities import measured_in
from labseq.recording.folders import RESULT_PREFIX, split_result
from labseq.recording.index import IndexRow
from labseq.recording.results import Results, results_file
from labseq.units import format_quantity, written

LASTING: Final = frozenset(
    {
        "settling",
        "left_on",
        "compiling",
        "compiled",
        "planner_chosen",
        "warning",
        "ended_early",
        "run_starting",
        "shot_repeated",
        "safe_state",
        "closed",
    }
)
"""Events that must stay on the screen above the live view."""
PRINTED: Final = LASTING | {"shot_finished", "scan_point", "scan_ended"}
"""Events that are printed as a line if there is no live view."""


class LogLines:
    """A ``RunObserver`` that prints a line per event.

    Args:
        events: Names of the events that are printed. Without a live view, also how each shot ended.
    """

    def __init__(self, stream: TextIO, events: frozenset[str] = PRINTED) -> None:
        self._stream = stream
        self._events = events
        self._run: RunRecord | None = None
        self._results: list[MeasuredResults] = []

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Print the line of an event, if it has one, and results that have arrived since the last event."""
        if name == "run_starting":
            self._run = values["record"]
            names = measured_in(values["record"].resolved) if "shot_finished" in self._events else ()
            run_dir = Path(values["run_dir"])
            self._results = [
                MeasuredResults(run_dir, *split) for split in map(split_result, names) if split is not None
            ]
        if name in self._events and (text := event_text(name, values, self._run)):
            say(text, stream=self._stream)
        if name in ("shot_finished", "run_finished"):
            for results in self._results:
                say(*results.new(values.get("row")), stream=self._stream)

    def refresh(self) -> None:
        """Do nothing, because every line was printed at once."""

    def close(self) -> None:
        """Do nothing, because the terminal was not changed."""


class MeasuredResults:
    """A measured result of an analysis, which comes later than its shot and has its own line."""

    def __init__(self, run_dir: Path, analysis: str, key: str) -> None:
        self._key = key
        self._name = clean(f"{RESULT_PREFIX}{analysis}.{key}")
        self._results = Results(results_file(run_dir, analysis))
        self._awaited: set[int] = set()

    def new(self, row: IndexRow | None = None) -> list[str]:
        """The lines of shots whose results have arrived.

        Args:
            row: A finished shot, whose result is awaited from now on.

        Raises:
            RecordingError: The results cannot be read.
        """
        if row is not None and row.counts:
            self._awaited.add(row.shot)
        self._results.read()
        come = sorted(self._awaited & self._results.rows.keys())
        self._awaited.difference_update(come)
        values = ((shot, self._results.rows[shot].get(self._key)) for shot in come)
        return [
            f"shot {shot}  {self._name} {value:.6g}"
            for shot, value in values
            if isinstance(value, bool | int | float)
        ]


def event_text(  # noqa: C901 - a case for each event
    name: str, values: Mapping[str, Any], run: RunRecord | None
) -> str:
    """Describe an event on one line.

    Returns:
        "" if the event is not printed.
    """
    match name:
        case "run_starting":
            return run_text(values["record"], values["run_dir"], values.get("n_before", 0))
        case "shot_finished":
            return shot_text(values["row"], run)
        case "shot_repeated":
            row: IndexRow = values["row"]
            return f"shot {row.shot}: attempt {row.attempt} failed, trying again: {row.error}"
        case "safe_state" | "closed" if not values["ok"]:
            task = "brought to its safe state" if name == "safe_state" else "closed"
            return f"warning: {values['device']} could not be {task}: {values['error']}"
        case "settling" if values["timeout_s"] >= 1.0:  # s; a shorter wait is not worth a line
            longest = format_quantity(values["timeout_s"], "time")
            return f"waiting for {values['device']} to settle, at most {longest}"
        case "compiling":
            return compiling_text(values["about_s"])
        case "compiled":
            return f"compiled in {format_quantity(values['duration_s'], 'time')}"
        case "planner_chosen":
            return f"planner: {values['chosen'][0]}"
        case "warning":
            return f"warning: {values['text']}"
        case "left_on":
            return "the static tweezers stay on; 'labseq safe PROFILE' switches them off"
        case "window_too_short" | "window_exceeded":
            return window_text(values)
        case "leader_awaited":
            longest = format_quantity(values["timeout_s"], "time")
            who, signal = values["device"], values["signal"]
            return f"shot {values['shot']}: waiting for '{signal}' from {who}, at most {longest}"
        case "scan_point":
            return point_text(values)
        case "scan_ended" | "ended_early":
            return ended_text(values)
        case "device_command":
            return f"shot {values['shot']}: {values['device']}: {values['command']}"
        case _:
            return ""


def ended_text(values: Mapping[str, Any]) -> str:
    """A line about a run that ends before its last shot because its scanner or its fits have enough data."""
    if "scanner" in values:
        return f"{values['scanner']} has converged"
    return f"{values['why']}; {plural(values['n_left'], 'shot')} left out"


def window_text(values: Mapping[str, Any]) -> str:
    """A line about a window that was too short for all batches, or for the batches that were played."""
    where = f"shot {values['shot']}, cycle {values['cycle']}"
    if "late_s" in values:
        late, window = (format_quantity(values[name], "time") for name in ("late_s", "window_s"))
        return f"{where}: the moves ended {late} after the window of {window}"
    fitting = f"{values['n_batches_played']} of {values['n_batches']} batches fit the window"
    return f"{where}: {fitting}; {format_quantity(values['before_moves_s'], 'time')} passed before the moves"


def run_text(run: RunRecord, run_dir: str, n_before: int = 0) -> str:
    """A line about a run that starts, or resumes after ``n_before`` shots."""
    simulated = ", simulated" if run.simulated else ""
    profile = Path(run.profile_path).stem
    before = f", {n_before} of them taken before" if n_before else ""
    return f"{run_dir}: {plural(run.n_shots, 'shot')}{before}, seed {run.seed}, profile {profile}{simulated}"


def shot_text(row: IndexRow, run: RunRecord | None) -> str:
    """A line about a finished shot."""
    name = f"shot {row.shot}"
    if run is not None and (at := point_of_shot(run.scan, row.shot, row.parameters)):
        name += f"  {at}"
    if row.status != "complete":
        return f"{name}  {row.status}" + (f": {row.error}" if row.status == "failed" else "")
    n_atoms = run.target.n_atoms if run is not None else 0
    parts = [name]
    if n_atoms:
        parts.append(outcome(bool(row.success), row.seen_defect_free_cycle, row.filling_fraction, n_atoms))
    parts += measured_texts(row)
    if not math.isnan(row.filling_fraction):
        parts.append(f"filling {percent(row.filling_fraction)}")
    if row.n_missing_atoms:
        parts.append(f"{plural(row.n_missing_atoms, 'atom')} short after loading")
    if not math.isnan(row.duration_s):
        parts.append(format_quantity(row.duration_s, "time"))
    return "  ".join(parts)


def measured_texts(row: IndexRow) -> list[str]:
    """What the run measures in a shot, if its images tell it. The filling is described elsewhere."""
    own = {name: events for name, events in row.measured.items() if name not in ("filling", "defect_free")}
    return [f"{clean(name)} {percent(n / n_trials)}" for name, (n, n_trials) in own.items() if n_trials]


def point_of_shot(scan: Mapping[str, Any], shot: int, parameters: Mapping[str, Any]) -> str:
    """The scanned values of a shot with their names and units. "" without a scan.

    Example:
        >>> scan = {"addresses": ["shot.0.load.duration"], "written": [["5 ms"]], "point_of_shot": [0]}
        >>> point_of_shot(scan, 0, {})
        'duration 5 ms'
    """
    values = scanned_values(scan, shot, parameters)
    return ", ".join(map(" ".join, zip(scanned_names(scan), values, strict=True)))


def scanned_names(scan: Mapping[str, Any]) -> list[str]:
    """The ends of the scanned addresses, such as "window". The whole addresses if two ends are the same."""
    addresses = [clean(str(address)) for address in scan.get("addresses", ())]
    names = [*map(_end, addresses)]
    return names if len({*names}) == len(names) else addresses


def _end(address: str) -> str:
    head, _, last = address.rpartition(".")
    return f"{_end(head)}.{last}" if head and last.isdecimal() else last


def scanned_values(scan: Mapping[str, Any], shot: int, parameters: Mapping[str, Any]) -> list[str]:
    """The scanned values of a shot, in the units of the sequence. "-" where the record lacks them."""
    try:
        if "written" not in scan:  # an adaptive scan in progress, whose record has no points yet
            values = [parameters[address] for address in scan["addresses"]]
            return [written(v, unit) for v, unit in zip(values, scan["written_units"], strict=True)]
        return [clean(str(word)) for word in scan["written"][scan["point_of_shot"][shot]]]
    except (KeyError, IndexError, TypeError, ValueError):  # run.json is damaged
        return ["-"] * len(scan.get("addresses", ()))


def outcome(success: bool, seen_cycle: int, filling_fraction: float, n_atoms: int) -> str:
    """How a shot ended. ``seen_cycle`` is the index of the first cycle that met the target, or -1.

    Example:
        >>> outcome(True, 1, 1.0, 225)
        'defect-free after 2 cycles'
        >>> outcome(False, 0, 0.9955555, 225)
        '1 defect (defect-free after 1 cycle)'
    """
    seen = f"defect-free after {plural(seen_cycle + 1, 'cycle')}" if seen_cycle >= 0 else ""
    if success:
        return seen or "defect-free"
    if math.isnan(filling_fraction):
        return "not judged: no image" if n_atoms else "complete"
    n_defects = round((1.0 - filling_fraction) * n_atoms)
    defects = plural(n_defects, "defect") if n_defects else "surplus atoms"
    return f"{defects} ({seen})" if seen else defects


def point_text(values: Mapping[str, Any]) -> str:
    """A line about a point of an adaptive scan, and the best point so far."""
    best = values["best"]
    at = ", ".join(f"{address} {text}" for address, text in values["written"].items())
    this = f"point {values['point']} ({at}): {values['figure']} {_number(values['value'])}"
    if best is None:
        return this
    return f"{this}; best so far " + ("this" if best["point"] == values["point"] else best_text(values))


def best_text(values: Mapping[str, Any]) -> str:
    """The best point of an adaptive scan so far, without its addresses. "" if there is none."""
    best = values["best"]
    if best is None:
        return ""
    return f"{_number(best['value'])}, point {best['point']} ({', '.join(best['written'].values())})"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.5g}"
