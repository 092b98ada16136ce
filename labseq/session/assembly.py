"""Puts a run together: files, plugins, settings, and objects, without opening anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from labseq import builtins
from labseq.config import (
    Document,
    ProfileSpec,
    SequenceSpec,
    find_profile,
    load_profile,
    load_sequence,
    split_overrides,
)
from labseq.config.settings import Settings
from labseq.errors import LabseqError, PluginLoadError, UnknownPluginError, one_of
from labseq.model import SiteGrid, TargetPattern
from labseq.plugins import PluginHost
from labseq.roles import Clock, Step
from labseq.sequencer.lab import Lab, Timeouts
from labseq.session.choosing import HARDWARE_KINDS, Chosen, DryRun, choose, construct, dump, resolve, validate


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
    dry_run: DryRun = "off",
) -> Assembly:
    """Read and validate everything that can be validated without opening a device.

    Args:
        sequence_path: The sequence file.
        profile: Name or path of the profile, instead of the sequence's own.
        overrides: ``"address=value"`` strings, as given to ``--set``.
        dry_run: "full": every device by its simulated counterpart where its plugin
            declares one, else its virtual twin; "fast": virtual twins only.

    Raises:
        ConfigError: The sequence, the profile or an override is wrong.
        UnknownPluginError: A plugin that is named does not exist.
        PluginLoadError: A plugin that is named failed to load.
    """
    for_sequence, for_profile = split_overrides(overrides)
    document, sequence = load_sequence(sequence_path, for_sequence)
    beside = sequence_path.parent if profile is None else Path()
    folders = [sequence_path.parent / folder for folder in sequence.plugin_folders]
    bench = set_up_bench(profile or sequence.profile, beside, for_profile, dry_run, folders)
    target, target_dump = _make_target(bench, document, sequence)
    steps, steps_dump = _make_steps(bench, document, sequence)
    planner = resolve(bench.host, document, "planner", sequence.planner_choice)
    resolved = {
        **sequence.model_dump(mode="json", exclude={"shot", "target", "planner"}),
        "target": target_dump,
        "planner": planner.dump(),
        "shot": steps_dump,
        "profile": {
            **bench.profile.core_dump(),
            **{role: chosen.dump() for role, chosen in bench.chosen.items()},
        },
    }
    return Assembly(document, sequence, bench, target, planner, steps, dry_run, resolved)


def set_up_bench(
    profile: str,
    beside: Path,
    overrides: Sequence[tuple[str, str]] = (),
    dry_run: DryRun = "off",
    plugin_folders: Sequence[Path] = (),
) -> Bench:
    """Read a profile, load the plugins and choose what plays each role.

    Raises:
        ConfigError: The profile is wrong.
        PluginLoadError: A plugin that it names failed to load.
    """
    path = find_profile(profile, beside)
    document, spec = load_profile(path, overrides)
    own_folders = [path.parent / folder for folder in spec.plugin_folders]
    host = load_plugins([*own_folders, *plugin_folders])
    chosen: dict[str, Chosen] = {}
    warnings: list[str] = []
    for role, choice in spec.role_choices().items():
        kind = "device" if role in spec.devices else role
        chosen[role], warning = choose(host, document, kind, choice, dry_run)
        warnings += [warning] if warning else []
    return Bench(document, spec, host, spec.grid_model(), chosen, tuple(warnings))


def load_plugins(folders: Sequence[Path] = ()) -> PluginHost:
    """Load labseq's own, the installed and the folders' plugins."""
    host = PluginHost()
    host.load_builtin(builtins)
    host.load_entry_points()
    host.load_folders(folders)
    return host


def _make_target(
    bench: Bench, document: Document, sequence: SequenceSpec
) -> tuple[TargetPattern, dict[str, Any]]:
    choice, grid = sequence.target_choice, bench.grid
    chosen = resolve(bench.host, document, "pattern", choice)
    try:
        target = chosen.entry.factory(chosen.settings, grid)
    except LabseqError as error:
        raise document.error(choice.loc, f"target: {error}") from error
    if not isinstance(target, TargetPattern) or target.shape != grid.shape:
        text = f"pattern '{chosen.entry.name}' made no TargetPattern of shape {grid.shape}"
        raise PluginLoadError(chosen.entry.origin, text)
    return target, {"pattern": chosen.entry.name, **dump(chosen.settings)}


def _make_steps(
    bench: Bench, document: Document, sequence: SequenceSpec
) -> tuple[tuple[tuple[str, Step], ...], list[dict[str, Any]]]:
    steps: list[tuple[str, Step]] = []
    dumps: list[dict[str, Any]] = []
    image_seen = False
    for spec in sequence.steps:
        try:
            entry = bench.host.get("step", spec.kind)
        except UnknownPluginError as error:
            what = f"unknown step '{spec.kind}'"
            raise document.error(spec.loc, what, one_of(error.known), error.hint, key=True) from None
        settings = validate(document, entry, spec.loc)
        step: Step = entry.factory(settings)
        if step.needs_image and not image_seen:
            what = f"'{spec.kind}' needs an image before it in the shot"
            raise document.error(spec.loc, what, "an 'image' step before it", key=True)
        if spec.kind == "device":
            _check_device_name(bench, document, settings, spec.loc)
        image_seen = image_seen or step.takes_image
        steps.append((spec.name or spec.kind, step))
        dumps.append({spec.kind: dump(settings), **({"name": spec.name} if spec.name else {})})
    return tuple(steps), dumps


def _check_device_name(
    bench: Bench, document: Document, settings: Settings | None, loc: tuple[str | int, ...]
) -> None:
    name = getattr(settings, "name", None)
    if name not in bench.profile.devices:
        what = f"the profile '{bench.profile.name}' has no device '{name}'"
        raise document.error((*loc, "name"), what, one_of(sorted(bench.profile.devices)))


def build_lab(assembly: Assembly, clock: Clock, seed: int) -> Lab:
    """Construct every role's object; nothing is opened."""
    bench = assembly.bench
    profile, motion = bench.profile, bench.profile.motion_spec()
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
