"""The tables that ``labseq show`` prints when it is asked for them."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, cast

from labseq.cli.output import columns
from labseq.cli.telling import outcome
from labseq.cli.words import percent, settings_text
from labseq.config.wording import clean, visible
from labseq.errors import ConfigError, Problem
from labseq.recording import Run, Shot
from labseq.recording.plain import to_plain
from labseq.units import format_quantity

if TYPE_CHECKING:
    from labseq.session.run_figures import RunTiming, StageStatistics

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
    from labseq.session.run_figures import A_LOOK, spread, timing_of  # it takes 0.5 s to import

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
