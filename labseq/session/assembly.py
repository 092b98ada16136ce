"""Puts a run together: files, plugins, settings, and objects, without opening anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from labseq import builtins
from labseq.config import (
    ROLES,
    Collected,
    Document,
    Override,
    ProfileSpec,
    SequenceSpec,
    StepSpec,
    load_profile,
    load_sequence,
    plugin_paths,
    split_overrides,
)
from labseq.config.settings import Settings
from labseq.errors import ConfigError, LabseqError, PluginLoadError, UnknownPluginError, one_of
from labseq.model import SiteGrid, TargetPattern
from labseq.plugins import PluginHost
from labseq.roles import Clock, Step
from labseq.sequencer.lab import Lab, Timeouts
from labseq.session.choosing import (
    HARDWARE_KINDS,
    Chosen,
    DryRun,
    choose,
    construct,
    construct_target,
    dump,
    resolve,
    validate,
)


@dataclass(frozen=True, slots=True)
class Bench:
    """A profile with its plugins chosen, before anything is opened.

    Attributes:
        document: The profile's file.
        profile: What it says.
        host: The plugins.
        grid: The grid of sites.
        chosen: Role or device name -> what plays it; no planner.
        warnings: What the user should know although it is no error.
    """

    document: Document
    profile: ProfileSpec
    host: PluginHost
    grid: SiteGrid
    chosen: Mapping[str, Chosen]
    warnings: tuple[str, ...]

    @property
    def virtual_time(self) -> bool:
        """Whether no device needs real time."""
        return all(c.entry.virtual_time for c in self.chosen.values() if c.entry.kind in HARDWARE_KINDS)


@dataclass(frozen=True, slots=True)
class Assembly:
    """A run before anything is opened.

    Attributes:
        document: The sequence's file.
        sequence: What it says.
        bench: The profile.
        target: What the array shall look like.
        planner: What plans the moves.
        steps: Name and step, in order.
        dry_run: "off", "full" or "fast".
        resolved: Every setting after defaults and overrides, SI, JSON-ready.
    """

    document: Document
    sequence: SequenceSpec
    bench: Bench
    target: TargetPattern
    planner: Chosen
    steps: tuple[tuple[str, Step], ...]
    dry_run: DryRun
    resolved: Mapping[str, Any]

    @property
    def virtual_time(self) -> bool:
        """Whether the run need not wait in real time."""
        return self.dry_run != "off" or self.bench.virtual_time


def assemble(
    sequence_path: Path,
    *,
    profile: str | None = None,
    overrides: Sequence[str] = (),
    given: Sequence[Override] = (),
    dry_run: DryRun = "off",
) -> Assembly:
    """Read and validate everything that can be validated without opening a device.

    Args:
        sequence_path: The sequence file.
        profile: Name or path of the profile, instead of the sequence's own.
        overrides: ``"address=value"`` strings, as given to ``--set``; they win.
        given: Values of other options.
        dry_run: "full": every device by its simulated counterpart where its plugin
            declares one, else its virtual twin; "fast": virtual twins only.

    Raises:
        ConfigError: The sequence, the profile or an override is wrong.
        UnknownPluginError: A plugin that is named does not exist.
        PluginLoadError: A plugin that is named failed to load.
    """
    for_sequence, for_profile = split_overrides(overrides)
    document, sequence = load_sequence(sequence_path, [*given, *for_sequence])
    found = Collected()
    bench = set_up_bench(
        profile or sequence.profile,
        Path() if profile else sequence_path.parent,
        for_profile,
        dry_run,
        named_in=None if profile else document,
        plugin_folders=plugin_paths(document, sequence.plugin_folders),
        found=found,
    )
    made: dict[str, Any] = {}
    with found:
        made["target"], made["target_dump"] = _make_target(bench, document, sequence)
    with found:
        made["planner"] = resolve(bench.host, document, "planner", sequence.planner)
    steps, step_dumps = _make_steps(bench, document, sequence, found)
    found.raise_any()
    resolved = {
        **sequence.model_dump(mode="json", exclude={"shot", "target", "planner"}),
        "target": made["target_dump"],
        "planner": made["planner"].dump(),
        "shot": step_dumps,
        "profile": _profile_dump(bench),
    }
    return Assembly(
        document, sequence, bench, made["target"], made["planner"], tuple(steps), dry_run, resolved
    )


def set_up_bench(
    profile: str,
    beside: Path = Path(),
    overrides: Sequence[Override] = (),
    dry_run: DryRun = "off",
    *,
    named_in: Document | None = None,
    plugin_folders: Sequence[Path] = (),
    found: Collected | None = None,
) -> Bench:
    """Read a profile, load the plugins and choose what plays each role.

    Args:
        profile: Name or path of the profile.
        beside: Folder of the file that names it.
        overrides: Values that replace those of the file.
        dry_run: "off", "full" or "fast".
        named_in: The sequence that names the profile, for messages.
        plugin_folders: Folders with plugins beside those that the profile names.
        found: Where the problems with roles go; without it they are raised.

    Raises:
        ConfigError: The profile is wrong.
        PluginLoadError: A plugin that it names failed to load.
    """
    document, spec = load_profile(profile, beside=beside, overrides=overrides, named_in=named_in)
    host = load_plugins([*plugin_paths(document, spec.plugin_folders), *plugin_folders])
    problems = found or Collected()
    chosen: dict[str, Chosen] = {}
    warnings: list[str] = []
    for role, choice in {**spec.choices, **spec.devices}.items():
        kind = role if role in ROLES else "device"
        with problems:
            chosen[role], warning = choose(host, document, kind, choice, dry_run)
            warnings += [f"{role}: {warning}"] if warning else []
    if found is None:
        problems.raise_any()
    return Bench(document, spec, host, spec.grid_model(), chosen, tuple(warnings))


def load_plugins(folders: Sequence[Path] = ()) -> PluginHost:
    """Load labseq's own, the installed and the folders' plugins."""
    host = PluginHost()
    host.load_builtin(builtins)
    host.load_entry_points()
    host.load_folders(folders)
    return host


def _profile_dump(bench: Bench) -> dict[str, Any]:
    spec = bench.profile
    core = spec.model_dump(mode="json", exclude={*ROLES, "devices"})
    roles = {role: chosen.dump() for role, chosen in bench.chosen.items() if role in ROLES}
    roles["mobile_tweezers"] |= spec.mobile_tweezers.model_dump(mode="json", exclude={"use"})
    devices = {name: bench.chosen[name].dump() for name in spec.devices}
    return {**core, **roles, "devices": devices}


def _make_target(
    bench: Bench, document: Document, sequence: SequenceSpec
) -> tuple[TargetPattern, dict[str, Any]]:
    choice, grid = sequence.target, bench.grid
    chosen = resolve(bench.host, document, "pattern", choice)
    try:
        target = construct_target(chosen, grid)
    except PluginLoadError:
        raise
    except LabseqError as error:
        problem = document.problem(choice.loc, str(error))
        raise ConfigError(replace(problem, notes=(_grid_note(bench),))) from error
    return target, {"pattern": chosen.entry.name, **dump(chosen.settings)}


def _make_steps(
    bench: Bench, document: Document, sequence: SequenceSpec, found: Collected
) -> tuple[list[tuple[str, Step]], list[dict[str, Any]]]:
    steps: list[tuple[str, Step]] = []
    dumps: list[dict[str, Any]] = []
    image_seen = False
    for spec in sequence.shot:
        with found:
            step, settings = _make_step(bench, document, spec)
            steps.append((spec.name or spec.kind, step))
            dumps.append({spec.kind: dump(settings), **({"name": spec.name} if spec.name else {})})
            if step.needs_image and not image_seen:
                what = f"'{spec.kind}' needs an image before it in the shot"
                raise document.error(spec.loc, what, "an 'image' step before it", key=True)
            image_seen = image_seen or step.takes_image
    return steps, dumps


def _make_step(bench: Bench, document: Document, spec: StepSpec) -> tuple[Step, Settings | None]:
    try:
        entry = bench.host.get("step", spec.kind)
    except UnknownPluginError as error:
        what = f"unknown step '{spec.kind}'"
        raise document.error(spec.loc, what, one_of(error.known), error.hint, key=True) from None
    settings = validate(document, entry, spec.loc)
    if spec.kind == "device":
        _check_device_name(bench, document, settings, spec)
    try:
        return entry.factory(settings), settings
    except ConfigError as error:
        raise document.error(spec.loc, str(error)) from error


def _check_device_name(bench: Bench, document: Document, settings: Settings | None, spec: StepSpec) -> None:
    name = getattr(settings, "name", None)
    if name not in bench.profile.devices:
        what = f"the profile '{bench.profile.name}' has no device '{name}'"
        problem = document.problem((*spec.loc, "name"), what, one_of(sorted(bench.profile.devices)))
        raise ConfigError(replace(problem, notes=(_place(bench.document, "devices"),)))


def _grid_note(bench: Bench) -> str:
    grid = bench.grid
    return f"the grid has {grid.n_rows} x {grid.n_cols} sites: {_place(bench.document, 'grid')}"


def _place(document: Document, key: str) -> str:
    line, column = document.locate((key,), key=True)
    return f"see '{key}' at {document.path}:{line}:{column}"


def build_lab(assembly: Assembly, clock: Clock, seed: int) -> Lab:
    """Construct every role's object; nothing is opened."""
    bench = assembly.bench
    profile, motion = bench.profile, bench.profile.motion
    chosen = {**bench.chosen, "planner": assembly.planner}
    made, streams = construct(chosen, bench.grid, motion, clock, seed)
    dop = getattr(made["planner"], "degree_of_parallelism", motion.max_tweezers)
    return Lab(
        grid=bench.grid,
        motion=motion,
        target=assembly.target,
        clock=clock,
        camera=made["camera"],
        static_tweezers=made["static_tweezers"],
        mobile_tweezers=made["mobile_tweezers"],
        detector=made["detector"],
        planner=made["planner"],
        planner_name=assembly.planner.entry.name,
        degree_of_parallelism=dop if isinstance(dop, int) else motion.max_tweezers,
        devices={name: made[name] for name in profile.devices},
        simulation=made.get("simulation"),
        random_streams=streams,
        timeouts=timeouts_of(profile),
    )


def timeouts_of(profile: ProfileSpec) -> Timeouts:
    """The profile's timeouts."""
    timeouts = profile.timeouts
    return Timeouts(timeouts.call, timeouts.safe_state, timeouts.plan)
