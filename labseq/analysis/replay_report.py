"""`labseq replay`: replays a run and prints the comparison."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from labseq.analysis.replay import (
    PlanCounts,
    Replay,
    ReplayedImages,
    ReplayedPlan,
    ReplayRequest,
    mean_counts,
    replay,
)
from labseq.console.output import json_writer, report_compiling, say
from labseq.console.report import Column, aligned, reporting, table
from labseq.console.runs import chosen_run
from labseq.console.text import count_of, first_of, percent, plural, settings_text, time_text
from labseq.model.estimate import mean


def replay_run(path: Path | None, request: ReplayRequest, output: Path | None, *, as_json: bool) -> int:
    """Replay a run and print the comparison.

    Returns:
        The exit code: 1 if the run's own planner or detector did not reproduce the recorded results.
    """
    run = chosen_run(path)
    # before the work, as the file may not be writable
    write = json_writer(None if output is None else str(output))
    with reporting(as_json=as_json) as show:
        report = ReplayReport(replay(run, request, announce=report_compiling))
        write(report)
        show(report)
    result = report.replay
    say(*_failure_lines(result), stream=sys.stderr)
    return 1 if result.is_own and not result.is_reproduced else 0


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """The comparison of a replay with the run. Shots and images count from 0, times are in seconds."""

    replay: Replay

    def as_text(self) -> list[str]:
        """The comparison, in tables."""
        return report_lines(self.replay)

    def as_json(self) -> dict[str, Any]:
        """The comparison, and each plan and image."""
        result = self.replay
        return {
            "run_dir": result.run.path,
            "shots": result.n_shots,
            "used": result.used,
            "reproduced": result.is_reproduced if result.is_own else None,
            "planner": _plan_values(result.plans) if "planner" in result.used else None,
            "detector": _image_values(result.images) if "detector" in result.used else None,
            "unreadable": result.unreadable,
        }


def report_lines(result: Replay) -> list[str]:
    """The comparison, in tables."""
    lines = [f"{result.run.path}: {plural(result.n_shots, 'shot')}"]
    if result.plans:
        lines += ["", *_plan_lines(result)]
    elif "planner" in result.used:
        lines += ["", "planner: these shots have no plans"]
    if "detector" in result.used:
        lines += ["", *_image_lines(result)]
    if result.is_own:
        lines += ["", _verdict(result)]
    return lines


def _verdict(result: Replay) -> str:
    if not result.is_reproduced:
        return (
            "NOT REPRODUCED: the results of the run's own planner or detector differ from the recorded ones"
        )
    n_images = len(result.images.images)
    if not result.plans and not n_images:
        return "nothing to reproduce: no plans, and no frames were kept"
    parts = [plural(n, kind) for n, kind in ((len(result.plans), "plan"), (n_images, "image")) if n]
    return f"reproduced: {' and '.join(parts)}, all as recorded"


def _title(role: str, used: Mapping[str, Any], changed: Mapping[str, Any]) -> str:
    settings = settings_text(changed)
    return f"{role} {used['use']}" + (f": {settings}" if settings else "")


PLANS: Final[Sequence[Column[tuple[str, Mapping[str, Any]]]]] = (
    Column("", lambda row: row[0]),
    Column("plans", lambda row: row[1]["n_plans"], right=True),
    Column("batches", lambda row: row[1]["n_batches"], right=True),
    Column("atom moves", lambda row: row[1]["n_atom_moves"], right=True),
    Column("duration", lambda row: time_text(row[1]["duration_s"].value), right=True),
    Column("planning", lambda row: time_text(row[1]["planning_s"].value), right=True),
    Column("filling", lambda row: percent(row[1]["filling"].value, 2), right=True),
    Column("target met", lambda row: count_of(row[1]["n_met"], row[1]["n_plans"]), right=True),
)


def _plan_lines(result: Replay) -> list[str]:
    rows: list[tuple[str, Mapping[str, Any]]] = []
    for label, plans in _groups(result.plans):
        rows.append((f"{label}, recorded", mean_counts([plan.recorded for plan in plans])))
        rows.append((f"{label}, replayed", mean_counts(_replayed_counts(plans))))
    n_same, n_failed = sum(plan.same for plan in result.plans), sum(bool(p.failure) for p in result.plans)
    lines = [_title("planner", result.used["planner"], result.changed["planner"]), *table(rows, PLANS)]
    lines.append("means per plan, with filling and target as predicted if no atom is lost")
    lines.append(f"the same as recorded: {count_of(n_same, len(result.plans))}")
    return [*lines, f"INVALID: {count_of(n_failed, len(result.plans))}"] if n_failed else lines


def _groups(plans: Sequence[ReplayedPlan]) -> Iterator[tuple[str, list[ReplayedPlan]]]:
    """The plans of each cycle, then of all. Cycles count from 0 over all rearrangements of a shot."""
    by_cycle: dict[int, list[ReplayedPlan]] = {}
    last: dict[int, int] = {}
    for plan in plans:
        last[plan.shot] = last.get(plan.shot, -1) + 1
        by_cycle.setdefault(last[plan.shot], []).append(plan)
    for cycle in sorted(by_cycle):
        yield f"cycle {cycle}", by_cycle[cycle]
    if len(by_cycle) > 1:
        yield "all", list(plans)


def _replayed_counts(plans: Sequence[ReplayedPlan]) -> list[PlanCounts]:
    return [plan.replayed for plan in plans if plan.replayed is not None]


def _image_lines(result: Replay) -> list[str]:
    images, lines = result.images, [_title("detector", result.used["detector"], result.changed["detector"])]
    if not images.images:
        reason = (
            "no frames were kept in these shots" if images.n_without_frame else "these shots have no images"
        )
        return [*lines, reason]
    n_sites = len(images.images) * images.appeared.size
    appeared, vanished = int(images.appeared.sum()), int(images.vanished.sum())
    differing = sum(1 for image in images.images if image.n_appeared or image.n_vanished)
    rows = [
        ("images", str(len(images.images)) + _without(images)),
        ("sites that differ", f"{images.n_differing} of {n_sites}, on {plural(differing, 'image')}"),
        ("  atom, none before", str(appeared)),
        ("  no atom, one before", str(vanished)),
        (
            "atoms on an image",
            f"recorded {_mean_text(images, 'n_atoms')}, now {_mean_text(images, 'n_atoms_replayed')}",
        ),
        (
            "confidence",
            f"recorded {_mean_text(images, 'confidence')}, now {_mean_text(images, 'confidence_replayed')}",
        ),
    ]
    with_truth = [image for image in images.images if image.n_atoms_true is not None]
    if with_truth:
        means = (
            (name, str(mean([getattr(image, key) for image in with_truth])))
            for name, key in (("recorded", "n_atoms"), ("now", "n_atoms_replayed"), ("truth", "n_atoms_true"))
        )
        rows.append(("on a last image", ", ".join(f"{name} {value}" for name, value in means)))
    return [*lines, *aligned(rows), *_map(images)]


def _without(images: ReplayedImages) -> str:
    return f", and {images.n_without_frame} without a frame" if images.n_without_frame else ""


def _mean_text(images: ReplayedImages, name: str) -> str:
    return str(mean([getattr(image, name) for image in images.images]))


def _map(images: ReplayedImages) -> list[str]:
    """Draw the differing sites: + a new atom, - a missing atom, * both."""
    if not images.n_differing or images.appeared.shape[1] > 64:  # two characters a site
        return []
    kinds = np.array([".", "+", "-", "*"])[(images.appeared > 0) + 2 * (images.vanished > 0)]
    rows = [" ".join(row) for row in kinds.tolist()]
    return ["", "+ atom, none before   - no atom, one before   * both", *rows]


def _failure_lines(result: Replay) -> list[str]:
    lines = [f"shot {plan.shot}, cycle {plan.cycle}: {plan.failure}" for plan in result.plans if plan.failure]
    lines += [f"shot {s}, image {i}: {text}" for (s, i), text in result.images.failures.items()]
    lines += [f"shot {shot} is left out: {text}" for shot, text in result.unreadable.items()]
    return first_of(lines, "more; --output FILE writes all of them")


def _plan_values(plans: Sequence[ReplayedPlan]) -> dict[str, Any]:
    return {
        "recorded": mean_counts([plan.recorded for plan in plans]),
        "replayed": mean_counts(_replayed_counts(plans)),
        "n_same": sum(plan.same for plan in plans),
        "n_invalid": sum(bool(plan.failure) for plan in plans),
        "plans": plans,
    }


def _image_values(images: ReplayedImages) -> dict[str, Any]:
    failures = [
        {"shot": shot, "image": image, "error": text} for (shot, image), text in images.failures.items()
    ]
    return {
        "n_images": len(images.images),
        "n_without_frame": images.n_without_frame,
        "appeared": images.appeared,
        "vanished": images.vanished,
        "images": images.images,
        "failures": failures,
    }
