"""Builds a run from its files: chooses plugins, validates settings; no device is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from labseq import builtin as builtins
from labseq.config.addresses import ROLES, Override, split_overrides
from labseq.config.document import Document, StoredText, plugin_paths
from labseq.config.find import find_sequence
from labseq.config.scan import Scan
from labseq.config.sequence import SequenceSpec, load_sequence
from labseq.errors import ConfigError, ProblemCollector
from labseq.model import TargetPattern
from labseq.plugins import PluginHost
from labseq.roles import Step
from labseq.sequencer.policies import RunPolicy
from labseq.session.adaptive import Search, make_search
from labseq.session.calibrations import with_tones
from labseq.session.construct import make_analyses, make_steps, make_target
from labseq.session.policies import make_policy, with_policies
from labseq.session.profile import (
    ChosenPlugin,
    DryRun,
    RecordedSetup,
    ResolvedProfile,
    check_dry_run,
    resolve,
    resolve_profile,
    validate,
)
from labseq.session.scan import Point, ScanPoints


@dataclass(frozen=True, slots=True)
class Assembly:
    """A run before its devices are opened.

    Attributes:
        document: The sequence's file.
        sequence: Its content.
        bench: The profile.
        target: The target pattern.
        planner: The planner and its settings.
        steps: Name and step, in order.
        dry_run: "off", "full" or "fast".
        resolved: Every setting after defaults and overrides, SI, JSON-ready; for a scan, at its first
            point, like all other attributes.
        scanned: The points of the scan; None without one.
        policy: Reactions to failures and exceeded budgets.
        search: The scanner, if it chooses the points during the run.
    """

    document: Document
    sequence: SequenceSpec
    bench: ResolvedProfile
    target: TargetPattern
    planner: ChosenPlugin
    steps: tuple[tuple[str, Step], ...]
    dry_run: DryRun
    resolved: Mapping[str, Any]
    scanned: ScanPoints | None = None
    policy: RunPolicy = field(default_factory=RunPolicy)
    search: Search | None = None

    @property
    def virtual_time(self) -> bool:
        """Whether the run's clock is virtual, without real waiting times."""
        return self.dry_run != "off" or self.bench.virtual_time

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        notes = () if self.scanned is None else self.scanned.scan.notes
        return (*self.bench.warnings, *notes)

    @property
    def begun(self) -> Point:
        """The settings of the first point of a scan; those of the files if no point is known yet."""
        alone = self.scanned is None or self.search is not None
        return Point(self.planner, self.steps, self.bench, {}) if alone else self.at(0)

    def at(self, point: int) -> Point:
        """The settings of a point of the scan."""
        if self.scanned is None:
            return Point(self.planner, self.steps, self.bench, {})
        return self.scanned.at(point)


def assemble(
    sequence_path: Path,
    *,
    profile: str | Path | None = None,
    overrides: Sequence[str] = (),
    given: Sequence[Override] = (),
    dry_run: DryRun = "off",
    kept: StoredText | None = None,
    again: RecordedSetup | None = None,
) -> Assembly:
    """Read and validate everything that can be validated without opening a device.

    Args:
        sequence_path: The sequence file, or the name of one; see :func:`labseq.config.find.find_sequence`.
        profile: Name or path of the profile, instead of the sequence's own.
        overrides: ``"address=value"`` strings, as given to ``--set``; they take precedence.
        given: Overrides from other options.
        dry_run: "full": every device by its simulator if its plugin has one, else by its virtual
            twin; "fast": virtual twins only.
        kept: The sequence's text when the run began, if it is resumed.
        again: Profile and calibrations when the run began, if it is resumed.

    Raises:
        ConfigError: The sequence, the profile or an override has an error.
        UnknownPluginError: A named plugin does not exist.
        PluginLoadError: A named plugin failed to load.
    """
    check_dry_run(dry_run)
    sequence_path = sequence_path if kept is not None else find_sequence(sequence_path)
    for_sequence, for_profile = split_overrides(overrides)
    profile_set = [one._replace(address=f"profile.{one.address}") for one in for_profile]
    found = ProblemCollector()
    try:
        document, sequence, scan = load_sequence(
            sequence_path, [*given, *for_sequence], profile_set=profile_set, found=found, kept=kept
        )
    except ConfigError as error:
        raise found.stop(error) from None
    scan = None if found.problems else scan
    try:
        bench = resolve_profile(
            sequence.profile if profile is None else profile,
            sequence_path.parent if profile is None else Path(),
            for_profile,
            dry_run,
            named_in=document if profile is None else None,
            plugin_folders=plugin_paths(document, sequence.plugin_folders),
            scan=scan,
            found=found,
            again=again,
        )
    except ConfigError as error:
        _check_alone(document, sequence, found)
        raise _explained(found.stop(error), scan) from None
    return _assembled(document, sequence, bench, scan, found, dry_run)


def _assembled(
    document: Document,
    sequence: SequenceSpec,
    bench: ResolvedProfile,
    scan: Scan | None,
    found: ProblemCollector,
    dry_run: DryRun,
) -> Assembly:
    """Make the target, planner, steps and analyses of a sequence on its profile."""
    is_whole = not found.problems
    made: dict[str, Any] = {}
    with found:
        made["target"], made["target_dump"] = make_target(bench, document, sequence)
    with found:
        made["planner"] = resolve(bench.host, document, "planner", sequence.planner)
    steps, step_dumps = make_steps(bench, document, sequence, found)
    policy = make_policy(document, sequence, steps, found)
    analyses = make_analyses(bench, document, sequence, found)
    scanned: ScanPoints | None = None
    search: Search | None = None
    try:
        if scan is not None and is_whole:
            bound, planner = scan.bound(bench.document), made.get("planner")
            scanned = ScanPoints(bound, document, sequence, bench, dry_run, planner, tuple(steps))
            scanned.check(found)
            if not found.problems:
                search = make_search(scanned, steps, found)
        found.raise_any()
    except ConfigError as error:
        raise _explained(error, scan) from None
    target, planner = made["target"], made["planner"]
    resolved = {
        **sequence.model_dump(mode="json", exclude={"shot", "target", "planner", "scan"}),
        "target": made["target_dump"],
        "planner": planner.dump(),
        "shot": with_policies(document, sequence, step_dumps),
        "analysis": analyses,
        "profile": _profile_dump(bench),
    }
    if texts := _expressions(document, bench.document):
        resolved["expressions"] = texts
    parts = (document, sequence, bench, target, planner, tuple(steps), dry_run, resolved)
    return Assembly(*parts, scanned, policy=policy, search=search)


def _explained(error: ConfigError, scan: Scan | None) -> ConfigError:
    return error if scan is None else scan.explained(error)


def _check_alone(document: Document, sequence: SequenceSpec, found: ProblemCollector) -> None:
    """Check the settings in a sequence whose profile has errors, except for plugins from plugin folders."""
    host = PluginHost()
    host.load_builtin(builtins)
    host.load_entry_points()
    choices = [("pattern", sequence.target), ("planner", sequence.planner)]
    for kind, choice in choices:
        if host.registry.find(kind, choice.use) is not None:
            with found:
                resolve(host, document, kind, choice)
    for spec in sequence.shot:
        entry = host.registry.find("step", spec.kind)
        if entry is not None:
            with found:
                validate(document, entry, spec.loc)


def _expressions(sequence: Document, profile: Document) -> dict[str, str]:
    """Address -> text of each expression; the record of the run has its value among the settings."""
    texts: dict[str, str] = {}
    for prefix, document in (("", sequence), ("profile.", profile)):
        for loc, text in ({} if document.expressions is None else document.expressions.texts).items():
            texts[prefix + ".".join(map(str, loc))] = text
    return texts


def _profile_dump(bench: ResolvedProfile) -> dict[str, Any]:
    spec = bench.profile
    core = spec.model_dump(mode="json", exclude={*ROLES, "devices"})
    roles = {role: chosen.dump() for role, chosen in bench.chosen.items() if role in ROLES}
    roles["mobile_tweezers"] |= spec.mobile_tweezers.model_dump(mode="json", exclude={"use"})
    devices = {name: bench.chosen[name].dump() for name in spec.devices}
    grid = with_tones(core["grid"], bench.grid, spec.grid_model())
    return {**core, "grid": grid, **roles, "devices": devices}
