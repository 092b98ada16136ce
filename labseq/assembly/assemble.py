"""Builds a run from its files: chooses plugins and validates settings. Opens no device."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.assembly.options import Options
from labseq.assembly.plugin_choice import (
    ChosenPlugin,
    construct_one,
    construct_target,
    dump,
    load_plugins,
    make_step,
    place_note,
    read_settings,
    resolve,
)
from labseq.assembly.point import Point
from labseq.assembly.profile import ResolvedProfile, resolve_profile
from labseq.config.addresses import PROFILE, PROFILE_ROLES, split_overrides
from labseq.config.document import Document, StoredText, plugin_paths
from labseq.config.find import find_sequence
from labseq.config.sequence import SequenceSpec, load_sequence
from labseq.errors import ConfigError, LabseqError, PluginLoadError, ProblemCollector
from labseq.model import TargetPattern
from labseq.model.image_quantities import StepSummary, measured_by_default
from labseq.model.policies import NO_POLICY, RunPolicy, StepPolicy
from labseq.recording.folders import RESULT_PREFIX
from labseq.recording.run_file import plain_regions
from labseq.roles import Context, Step
from labseq.settings import settings_of

if TYPE_CHECKING:
    from labseq.assembly.led import LedPoints
    from labseq.assembly.points import ScanPoints
    from labseq.assembly.recorded import RecordedFiles
    from labseq.assembly.search import Search
    from labseq.config.scan import Scan
    from labseq.plugins.host import PluginHost


@dataclass(frozen=True, slots=True)
class Assembly:
    """A run before its devices are opened.

    Attributes:
        document: The sequence's file.
        sequence: Its content.
        hardware: The profile.
        target: The target pattern.
        planner: The planner and its settings.
        steps: Name and step, in order.
        resolved: Every setting after defaults and overrides, SI, JSON-ready. For a scan, at its first
            point, like all other attributes.
        scanned: The points of the scan. None without a scan.
        policy: Reactions to failures and exceeded budgets.
        search: The scanner, if it chooses the points during the run.
        led: The settings that another control system may change for each shot. None if there are none.
    """

    document: Document
    sequence: SequenceSpec
    hardware: ResolvedProfile
    target: TargetPattern
    planner: ChosenPlugin
    steps: tuple[tuple[str, Step], ...]
    resolved: Mapping[str, Any]
    scanned: ScanPoints | None = None
    policy: RunPolicy = field(default_factory=RunPolicy)
    search: Search | None = None
    led: LedPoints | None = None

    @property
    def virtual_time(self) -> bool:
        """Whether the run's clock is virtual, without real waiting times."""
        return self.hardware.virtual_time

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user."""
        notes = () if self.scanned is None else self.scanned.scan.notes
        return (*self.hardware.warnings, *notes)

    @property
    def first_point(self) -> Point:
        """The settings of the first point of a scan, or of the files if no point is known yet."""
        alone = self.scanned is None or self.search is not None
        return self._alone if alone else self.at(0)

    def at(self, number: int) -> Point:
        """The settings of a point of the scan, by its number."""
        return self._alone if self.scanned is None else self.scanned.at(number)

    def point_of_shot(self, seed: int) -> list[int]:
        """Number of the point of each shot. Without a scan all shots are at one point."""
        n_shots = self.sequence.shots
        if self.scanned is None:
            return [0] * n_shots
        return self.scanned.scan.points_of_shots(seed, n_shots).tolist()

    def scan_record(self, seed: int) -> dict[str, Any]:
        """The scan for the run's record, JSON-ready. Empty without a scan."""
        if self.scanned is None:
            return {}
        if self.search is not None:
            return self.search.record()
        return self.scanned.record(self.point_of_shot(seed))

    @property
    def _alone(self) -> Point:
        """The settings of the files."""
        if self.led is not None:
            return self.led.at(0)
        return Point(self.planner, self.steps, self.hardware, {}, self.document)


def assemble(
    sequence_path: Path,
    options: Options,
    *,
    kept: StoredText | None = None,
    recorded: RecordedFiles | None = None,
) -> Assembly:
    """Read and validate everything that can be validated without opening a device.

    Args:
        sequence_path: File or name of the sequence, see :func:`labseq.config.find.find_sequence`.
        options: Values that replace those in the files.
        kept: The sequence's text, if the run was queued or began earlier.
        recorded: Profile and calibrations, if the run began earlier.

    Raises:
        ConfigError: The sequence, the profile or an override has an error.
        UnknownPluginError: A named plugin does not exist.
        PluginLoadError: A named plugin failed to load.
    """
    profile, dry_run = options.profile, options.dry_run
    # a kept text needs no file, which may no longer exist
    sequence_path = sequence_path if kept is not None else find_sequence(sequence_path)
    for_sequence, for_profile = split_overrides(options.overrides)
    profile_set = [override._replace(address=f"{PROFILE}{override.address}") for override in for_profile]
    problems = ProblemCollector()
    try:
        document, sequence, scan = load_sequence(
            sequence_path,
            [*options.own(), *for_sequence],
            profile_set=profile_set,
            problems=problems,
            kept=kept,
        )
    except ConfigError as error:
        raise problems.stop(error) from None
    # otherwise the points of a scan would repeat the errors of the files
    scan = None if problems.problems else scan
    try:
        try:
            hardware = resolve_profile(
                sequence.profile if profile is None else profile,
                for_profile,
                dry_run,
                named_in=document if profile is None else None,
                plugin_folders=plugin_paths(document, sequence.plugin_folders),
                scan=scan,
                problems=problems,
                recorded=recorded,
            )
        except ConfigError as error:
            _check_alone(document, sequence, problems)
            raise problems.stop(error) from None
        return _assembled(document, sequence, hardware, scan, problems)
    except ConfigError as error:
        raise (error if scan is None else scan.explained(error)) from None


def assemble_recorded(recorded: RecordedFiles, options: Options) -> Assembly:
    """Assemble a run from files and calibrations of a recorded run (see :func:`assemble`)."""
    options = replace(options, profile=recorded.profile_path)
    return assemble(recorded.sequence_path, options, kept=recorded.sequence, recorded=recorded)


def _assembled(
    document: Document,
    sequence: SequenceSpec,
    hardware: ResolvedProfile,
    scan: Scan | None,
    problems: ProblemCollector,
) -> Assembly:
    """Make the target, planner, steps and analyses of a sequence on its profile.

    Raises:
        ConfigError: All problems, including the problems that were collected before.
    """
    is_whole = not problems.problems
    target: TargetPattern | None = None
    planner: ChosenPlugin | None = None
    target_dump: dict[str, Any] | None = None
    with problems:
        target, target_dump = make_target(hardware, document, sequence)
    with problems:
        planner = resolve(hardware.host, document, "planner", sequence.planner)
    steps, step_dumps = make_steps(hardware, document, sequence, problems)
    all_steps = steps if len(steps) == len(sequence.shot) else None
    analyses, results = make_analyses(hardware, document, sequence, problems)
    if sequence.measure or sequence.policy.checks or sequence.scan:
        from labseq.assembly.quantities import readings_of  # loads modules that other runs do not need

        is_known = is_whole and all_steps is not None
        results = [*results, *readings_of(hardware, steps, is_whole=is_known)]
    # quantities may name regions, which a file with errors may have lost
    whole_target = target if is_whole else None
    policy, policy_dumps = make_policy(document, sequence, all_steps, results, whole_target, problems)
    measures = make_measures(
        document, sequence, all_steps, whole_target, results, scan, hardware.host, problems
    )
    scanned: ScanPoints | None = None
    search: Search | None = None
    if scan is not None and is_whole:
        # a run without a scan does not need these
        from labseq.assembly.points import ScanPoints
        from labseq.assembly.search import make_search

        scanned = ScanPoints(scan.bound(hardware.document), document, sequence, hardware)
        scanned.check(problems)
        search = make_search(scanned, steps, results, target, problems)
    led: LedPoints | None = None
    if sequence.leader is not None and is_whole and not problems.problems:
        from labseq.assembly.led import led_points  # most runs have no leader

        led = led_points(document, sequence, hardware, problems)
    problems.raise_any()
    assert target is not None  # else there was a problem
    assert planner is not None
    chosen = {
        "measure": measures,
        "target": target_dump,
        "planner": planner.dump(),
        "shot": [step | own for step, own in zip(step_dumps, policy_dumps, strict=True)],
        "analysis": analyses,
        "profile": _profile_dump(hardware),
    }
    resolved = _core_dump(sequence) | chosen | _optional_dump(target, document, hardware.document)
    parts = (document, sequence, hardware, target, planner, tuple(steps), resolved)
    return Assembly(*parts, scanned, policy=policy, search=search, led=led)


def _check_alone(document: Document, sequence: SequenceSpec, problems: ProblemCollector) -> None:
    """Check the settings in a sequence whose profile has errors, except for plugins from plugin folders."""
    with problems:
        host = load_plugins()
        for kind, choice in (("pattern", sequence.target), ("planner", sequence.planner)):
            if choice is not None and host.registry.find(kind, choice.use) is not None:
                with problems:
                    resolve(host, document, kind, choice)
        for spec in sequence.shot:
            entry = host.registry.find("step", spec.kind)
            if entry is not None:
                with problems:
                    read_settings(document, entry, spec.loc)


def _core_dump(sequence: SequenceSpec) -> dict[str, Any]:
    """The settings of a sequence except its plugins, its scan and its quantities."""
    others = {"shot", "target", "planner", "scan", "measure", "regions"}
    others |= {"leader"} if sequence.leader is None else set()
    return sequence.model_dump(mode="json", exclude=others)


def _optional_dump(target: TargetPattern, sequence: Document, profile: Document) -> dict[str, Any]:
    """The sites of each region, and address -> text of each expression, without empty entries.

    In the run's record, the values of the expressions are among the settings.
    """
    expressions = {
        prefix + ".".join(map(str, loc)): text
        for prefix, document in (("", sequence), (PROFILE, profile))
        for loc, text in (document.expressions.texts.items() if document.expressions else ())
    }
    optional = {"regions": plain_regions(target), "expressions": expressions}
    return {key: value for key, value in optional.items() if value}


def _profile_dump(hardware: ResolvedProfile) -> dict[str, Any]:
    spec = hardware.profile
    core = spec.model_dump(mode="json", exclude={*PROFILE_ROLES, "devices"})
    roles = {role: hardware.dump(role) for role in hardware.chosen if role in PROFILE_ROLES}
    roles["mobile_tweezers"]["overhead_per_cycle"] = hardware.motion.overhead_per_cycle_s
    if "amplitudes" in hardware.calibrations:
        rf = hardware.motion.rf
        amplitudes = {"row_amplitudes": [*rf.row_amplitudes], "column_amplitudes": [*rf.column_amplitudes]}
        roles["mobile_tweezers"] |= {"rf": roles["mobile_tweezers"]["rf"] | amplitudes}
    devices = {name: hardware.chosen[name].dump() for name in spec.devices}
    written_grid = spec.grid_model()
    for axis in ("row_frequency", "column_frequency"):
        tones, before = (getattr(grid, f"{axis}_hz").tolist() for grid in (hardware.grid, written_grid))
        if tones != before:  # changed by calibrations
            core["grid"][axis]["table"] = tones
    return {**core, **roles, "devices": devices}


def make_target(
    hardware: ResolvedProfile, document: Document, sequence: SequenceSpec
) -> tuple[TargetPattern, dict[str, Any] | None]:
    """The target of a sequence with its regions, and its settings for the record.

    A sequence without a target gets a target that requires nothing.

    Raises:
        ConfigError: A pattern is unknown or has invalid settings, or a pattern or region does not fit on the
            grid.
        PluginLoadError: The pattern's plugin failed. The message names it.
    """
    choice, grid = sequence.target, hardware.grid
    target, dumped = TargetPattern.none(grid.shape), None
    if choice is not None:
        chosen = resolve(hardware.host, document, "pattern", choice)
        try:
            target = construct_target(chosen, grid)
        except PluginLoadError:  # names the plugin at fault, as the file is right
            raise
        except LabseqError as error:
            note = (
                f"the grid has {grid.n_rows} x {grid.n_cols} sites, {place_note(hardware.document, 'grid')}"
            )
            problem = document.problem(choice.loc, str(error))
            raise ConfigError(replace(problem, notes=(note,))) from error
        dumped = {"pattern": chosen.entry.name, **dump(chosen.entry, chosen.settings)}
    if sequence.regions:
        from labseq.assembly.regions import with_regions  # loads modules that other runs do not need

        target = with_regions(target, hardware, document, sequence.regions)
    return target, dumped


def make_steps(
    hardware: ResolvedProfile, document: Document, sequence: SequenceSpec, problems: ProblemCollector
) -> tuple[list[tuple[str, Step]], list[dict[str, Any]]]:
    """Name and step, in order, and the settings of each for the record."""
    steps: list[tuple[str, Step]] = []
    dumps: list[dict[str, Any]] = []
    image_seen = False
    for spec in sequence.shot:
        step: Step | None = None
        with problems:
            step, dumped = make_step(hardware, document, spec)
            steps.append((spec.name or spec.kind, step))
            dumps.append({spec.kind: dumped, **({"name": spec.name} if spec.name else {})})
            if step.needs_image and not image_seen:
                what = f"'{spec.kind}' needs an image before it in the shot"
                raise document.error(spec.loc, what, "an 'image' step before it", key=True)
            if step.needs_target and sequence.target is None:
                what, hint = f"'{spec.kind}' needs a target", "target: {pattern: compact, rows: 10, cols: 10}"
                raise document.error(spec.loc, what, "'target' in the sequence", f"write '{hint}'", key=True)
        # A wrong step counts as an image step, because the user may have intended one.
        image_seen = image_seen or step is None or step.takes_image
    return steps, dumps


def make_analyses(
    hardware: ResolvedProfile, document: Document, sequence: SequenceSpec, problems: ProblemCollector
) -> tuple[list[dict[str, Any]], list[str]]:
    """The settings of each analysis of the sequence, for the record, and the names of its results.

    Each is constructed once as a check. During the run analyses have their own processes.
    """
    dumps: list[dict[str, Any]] = []
    results: list[str] = []
    for choice in sequence.analysis:
        prefix, instance = f"{RESULT_PREFIX}{choice.use}.", None
        with problems:
            chosen = resolve(hardware.host, document, "analysis", choice)
            context = Context(choice.use, hardware.grid, hardware.motion, calibrations=hardware.calibrations)
            instance = construct_one(chosen, context)
            dumps.append({**chosen.dump(), "finish_within": choice.finish_within})
        results += [f"{prefix}{name}" for name in getattr(instance, "results", ("",))]
    return dumps, results


def make_policy(
    document: Document,
    sequence: SequenceSpec,
    steps: Sequence[tuple[str, Step]] | None,
    results: Collection[str],
    target: TargetPattern | None,
    problems: ProblemCollector,
) -> tuple[RunPolicy, list[dict[str, Any]]]:
    """The policies of a run and its steps, and the ``policy`` of each step for its record.

    Args:
        steps: The steps of a shot. None if some have errors.
        results: Names of the results of the analyses.
        target: The target. None if it has errors.
        problems: Receives the problems of policies and of the quantities that they check.
    """
    settings = sequence.policy
    otherwise = StepPolicy(on_failure=settings.on_failure, over_budget=settings.over_budget)
    policies = [NO_POLICY] * len(sequence.shot)
    dumps: list[dict[str, Any]] = [{} for _ in sequence.shot]
    for number, spec in enumerate(sequence.shot):
        loc = spec.policy_loc
        with problems:
            own = document.validate(StepPolicy, loc, called=f"the policy of '{spec.kind}'")
            policies[number] = replace(
                own,
                on_failure=own.on_failure or otherwise.on_failure,
                over_budget=own.over_budget or otherwise.over_budget,
            )
            if document.root.at(loc) is not None:
                keys = document.get(loc) or {}
                written = [setting for setting in settings_of(StepPolicy) if setting.key in keys]
                dumps[number] = {"policy": {one.key: getattr(own, one.name) for one in written}}
            if steps is not None and own.retries and not steps[number][1].repeatable:
                what = f"'{spec.kind}' cannot be repeated in the same shot because atoms may have moved"
                hint = "write 'on_failure: repeat_shot'"
                raise document.error((*loc, "retries"), what, "0", hint, key=True)
    if settings.checks:
        from labseq.assembly.quantities import check_checks  # loads modules that only checks need

        check_checks(document, sequence, steps, results, target, problems)
    return RunPolicy(sequence.attempts, settings.when_exhausted, otherwise, tuple(policies)), dumps


def make_measures(
    document: Document,
    sequence: SequenceSpec,
    steps: Sequence[tuple[str, Step]] | None,
    target: TargetPattern | None,
    results: Collection[str],
    scan: Scan | None,
    host: PluginHost,
    problems: ProblemCollector,
) -> list[dict[str, Any]]:
    """The quantities that a run measures, from the sequence or chosen by its steps, JSON-ready.

    Args:
        steps: The steps of a shot. None if some have errors.
        target: The target. None if it has errors.
        results: Names of the results of the analyses.
        scan: The scan. None without a scan, or if it has errors.
        host: The plugins, which may offer models to fit.
        problems: Receives the problems of names, fits and parameters.
    """
    if sequence.measure is None:
        summaries = [
            StepSummary(name, step.takes_image, spec.kind == "load")
            for spec, (name, step) in zip(sequence.shot, steps or (), strict=False)
        ]
        has_target = target is not None and not target.is_none
        return [{"value": name} for name in measured_by_default(summaries, has_target=has_target)]
    from labseq.assembly.quantities import check_quantity  # loads modules that other runs do not need

    for number, measure in enumerate(sequence.measure):
        with problems:
            place = ("measure", number, "value")
            check_quantity(document, place, measure.value, "to measure", steps, results, target)
            if measure.fit is not None:
                from labseq.assembly.fits import check_fit  # most runs fit nothing

                check_fit(document, sequence, scan, number, target, host)
    return [measure.model_dump(mode="json", exclude_defaults=True) for measure in sequence.measure]
