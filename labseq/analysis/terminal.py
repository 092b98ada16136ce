"""`labseq replay`, `labseq analyse` and `labseq plot`: do the work and print the result."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from labseq.analysis.campaigns import campaign_in, campaign_picture
from labseq.analysis.overview import map_picture, overview, picture_of, scan_picture
from labseq.analysis.replay import (
    PlanCounts,
    Replay,
    ReplayedImages,
    ReplayedPlan,
    ReplayRequest,
    mean_counts,
    replay,
)
from labseq.analysis.scanned import ScanRequest, scan_report
from labseq.analysis.shot import save_shot, shot_picture
from labseq.config.addresses import split_overrides
from labseq.config.document import Document
from labseq.console.output import json_writer, report_compiling, say
from labseq.console.report import Column, aligned, reporting, table
from labseq.console.runs import chosen_run
from labseq.console.text import count_of, percent, plural, settings_text, time_text
from labseq.data import Run
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, visible
from labseq.model.estimate import mean
from labseq.pictures.figures import check_place
from labseq.session.analyses import AnalysisOutcome, analyse_missing, analyses_of
from labseq.session.analysis_processes import USE

MAX_REPORTED: Final = 5
"""Maximum number of failures that are printed one by one."""


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
    """The comparison of a replay with the run: shots and images counted from 0, times in seconds."""

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
    lines.append("means per plan; filling and target as predicted if no atom is lost")
    lines.append(f"the same as recorded: {count_of(n_same, len(result.plans))}")
    return [*lines, f"INVALID: {count_of(n_failed, len(result.plans))}"] if n_failed else lines


def _groups(plans: Sequence[ReplayedPlan]) -> Iterator[tuple[str, list[ReplayedPlan]]]:
    """The plans of each cycle, then of all; cycles are counted from 0 over all rearrangements of a shot."""
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
    return ["", "+ atom, none before; - no atom, one before; * both", *rows]


def _failure_lines(result: Replay) -> list[str]:
    lines = [f"shot {plan.shot}, cycle {plan.cycle}: {plan.failure}" for plan in result.plans if plan.failure]
    lines += [f"shot {s}, image {i}: {text}" for (s, i), text in result.images.failures.items()]
    lines += [f"shot {shot} is left out: {text}" for shot, text in result.unreadable.items()]
    return _first(lines, "more; all of them with --output FILE")


def _first(failures: Sequence[str], rest: str) -> list[str]:
    """The failures that are printed one by one, and how many there are besides."""
    n_more = len(failures) - MAX_REPORTED
    return [*failures[:MAX_REPORTED], *([f"and {n_more} {rest}"] if n_more > 0 else [])]


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


def analyse_run(
    path: Path | None,
    use: str | None,
    overrides: Sequence[str],
    request: ScanRequest | None = None,
    where: Sequence[str] | None = None,
    *,
    again: bool,
) -> int:
    """Analyse the shots of a run that have no result yet, and print how many; then the scan.

    Args:
        path: The run's folder; the newest if it is None.
        use: One analysis, or None for all that the sequence names.
        overrides: "key=value" for its settings.
        request: What to print of the scan.
        where: Conditions on the shots that are printed.
        again: Whether to analyse all shots again.

    Returns:
        The exit code: 1 if the analysis of a shot failed.
    """
    run = chosen_run(path)
    analyses, failed = _analyses_to_run(run, use, overrides, may_be_none=request is not None), False
    for settings in analyses:
        outcome = analyse_missing(run, settings, again=again)
        _report(outcome)
        failed = failed or bool(outcome.failures)
    if request is not None:
        say(*([""] if analyses else []), *scan_report(run.select(*where or ()), request).as_text())
    return int(failed)


def _analyses_to_run(
    run: Run, use: str | None, overrides: Sequence[str], *, may_be_none: bool
) -> list[dict[str, Any]]:
    """The settings of each analysis to run."""
    analyses = analyses_of(run)
    if use is not None:
        settings = next((analysis for analysis in analyses if analysis[USE] == use), {USE: use})
        return [{**settings, **_changes(overrides)}]
    if overrides:
        problem, hint = "it does not say which analysis has this setting", "name it with --use"
        raise ConfigError(Problem(problem, clean(f"--set {overrides[0]}"), hint=hint))
    if not analyses and not may_be_none:
        problem, hint = "the run's sequence has no analysis", "name one with --use"
        raise ConfigError(Problem(problem, visible(str(run.path)), hint=hint))
    return analyses


def _changes(overrides: Sequence[str]) -> dict[str, Any]:
    """The values of ``--set``."""
    for_sequence, for_profile = split_overrides(overrides)
    if for_profile:
        problem = "an analysis has no settings in the profile"
        raise ConfigError(Problem(problem, for_profile[0].source, expected="key=value"))
    return Document.of_options(for_sequence, "the command line").data


def _report(outcome: AnalysisOutcome) -> None:
    before = f", {outcome.n_before} had a result already" if outcome.n_before else ""
    say(f"{outcome.name}: {plural(outcome.n_done, 'shot')} analysed{before}; see {outcome.path}")
    failures = [f"{outcome.name}: shot {shot} failed: {text}" for shot, text in outcome.failures.items()]
    say(*_first(failures, "more shots failed"), stream=sys.stderr)


@dataclass(frozen=True, slots=True)
class PlotRequest:
    """The part of a run to draw; at most one of ``what``, ``scan``, ``sites`` and ``shot`` is given.

    Attributes:
        what: A part of the overview; None for all of it.
        shot: A shot, counted from 0.
        cycle: A cycle of it, counted from 0.
        scan: Quantities at the points of the scan.
        sites: Quantities at each site; "" for those that the run measures.
        where: Conditions on the shots that are drawn.
    """

    what: str | None = None
    shot: int | None = None
    cycle: int | None = None
    scan: ScanRequest | None = None
    sites: tuple[str, ...] = ()
    where: tuple[str, ...] = ()

    def check(self) -> None:
        """Check that the options are compatible.

        Raises:
            ConfigError: Options conflict, or there is no such picture.
        """
        maps = self.sites or None
        pictures = {"--what": self.what, "--shot": self.shot, "--scan": self.scan, "--map": maps}
        options = [option for option, value in pictures.items() if value is not None]
        if len(options) > 1:
            problem = "these are different pictures"
            raise ConfigError(Problem(problem, " and ".join(options), expected="one of them"))
        if self.cycle is not None and self.shot is None:
            raise ConfigError(Problem("a cycle belongs to a shot", "--cycle", expected="--shot as well"))

    @property
    def name(self) -> str:
        """Default name of the file, without suffix.

        Example:
            >>> PlotRequest(shot=3, cycle=1).name, PlotRequest(what="scan").name, PlotRequest().name
            ('shot-3-cycle-1', 'scan', 'overview')
        """
        if self.shot is not None:
            return f"shot-{self.shot}" + (f"-cycle-{self.cycle}" if self.cycle is not None else "")
        return "scan" if self.scan is not None else "map" if self.sites else self.what or "overview"


def plot_run(run: Path | None, request: PlotRequest, output: Path | None, *, replace: bool = False) -> None:
    """Draw a run or a campaign; a file is replaced only on request."""
    request.check()
    folder = campaign_in(run)
    if folder is not None and request != PlotRequest():
        problem = "a campaign has one picture; these options are for one of its runs"
        raise ConfigError(
            Problem(problem, visible(str(folder)), expected="no option but --output and --force")
        )
    path = _free_name(request.name if folder is None else "campaign") if output is None else output
    check_place(path)
    if path.exists() and not replace:
        hint = "--force replaces it"
        raise ConfigError(
            Problem("this file exists already", visible(str(path)), expected="a new name", hint=hint)
        )
    if folder is not None:
        campaign_picture(folder).save(path)
        say(f"written: {path}")
        return
    opened_run = chosen_run(run, request.where)
    if request.shot is not None:
        save_shot(path, shot_picture(opened_run, request.shot, request.cycle))
    elif request.scan is not None:
        scan_picture(opened_run, request.scan).save(path)
    elif request.sites:
        map_picture(opened_run, [*filter(None, request.sites)]).save(path)
    else:
        (overview(opened_run) if request.what is None else picture_of(opened_run, request.what)).save(path)
    say(f"written: {path}")


def _free_name(name: str) -> Path:
    """A PNG file of this name in the current folder, with a number if there is one already."""
    names = (Path(f"{name}_{i}.png" if i else f"{name}.png") for i in itertools.count())
    return next(path for path in names if not path.exists())
