"""Finds and validates a profile with its plugins and calibrations. Nothing is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.assembly.calibrations import ActiveCalibrations, calibrated, with_calibrations
from labseq.assembly.options import DryRun
from labseq.assembly.plugin_choice import ChosenPlugin, load_plugins, resolve
from labseq.config.addresses import Override
from labseq.config.document import Document, plugin_paths
from labseq.config.profile import DeviceChoice, ProfileSpec, load_profile
from labseq.errors import (
    ConfigError,
    PluginLoadError,
    ProblemCollector,
    UnknownPluginError,
    collecting,
    one_of,
)
from labseq.messages import clean, did_you_mean
from labseq.model import CalibrationEntry, MotionSpec, SiteGrid
from labseq.model.lines import IDLE
from labseq.plugins.host import PluginHost
from labseq.registry import VIRTUAL_TWIN
from labseq.roles import ROLES, Clock, Context
from labseq.sequencer.lines import trigger_line
from labseq.settings import Choice

if TYPE_CHECKING:
    from labseq.assembly.recorded import RecordedFiles
    from labseq.config.scan import Scan


@dataclass(frozen=True)
class ResolvedProfile:
    """A profile with its plugins chosen, before anything is opened.

    Attributes:
        document: The profile's file.
        profile: Its content.
        dry_run: "off", "full" or "fast".
        host: The plugins.
        grid: The grid of sites, with calibrated tones.
        chosen: Role or device name -> its plugin, without the planner.
        warnings: For the user.
        refused: Role or device name -> why no plugin could be chosen.
        calibrations: The calibrations in use: kind -> entry.
    """

    document: Document
    profile: ProfileSpec
    dry_run: DryRun
    host: PluginHost
    grid: SiteGrid
    chosen: Mapping[str, ChosenPlugin]
    warnings: tuple[str, ...]
    refused: Mapping[str, ConfigError] = field(default_factory=dict[str, ConfigError])
    calibrations: Mapping[str, CalibrationEntry] = field(default_factory=dict[str, CalibrationEntry])

    def context(self, clock: Clock) -> Context:
        """The context of its plugins, without a name, random numbers and a simulation."""
        profile = self.profile
        return Context(
            grid=self.grid,
            motion=self.motion,
            clock=clock,
            calibrations=self.calibrations,
            lines=profile.line_specs,
        )

    @property
    def motion(self) -> MotionSpec:
        """Motion of the mobile tweezers, with calibrated amplitudes and starting time.

        Without a calibration or a value in the profile, the starting time is the typical value of the driver.
        """
        motion, mobile = self.profile.motion, self.profile.mobile_tweezers
        driver = self.chosen.get("mobile_tweezers")  # None if it has an error while others are made safe
        typical_s = getattr(driver and driver.settings, "overhead_per_cycle_s", None)
        if typical_s is not None and "overhead_per_cycle_s" not in mobile.model_fields_set:
            motion = replace(motion, overhead_per_cycle_s=typical_s)
        return with_calibrations(motion, self.calibrations)

    def dump(self, name: str) -> dict[str, Any]:
        """The settings of a role or device for the record, SI, JSON-ready."""
        settings = self.chosen[name].dump()
        if name == "mobile_tweezers":
            settings |= self.profile.mobile_tweezers.model_dump(mode="json", exclude={"use"})
        return settings

    @property
    def key(self) -> str:
        """The profile's name in the markers of active runs. A dry run has another, as it uses no device."""
        path = str(self.document.path.resolve())
        return path if self.dry_run == "off" else f"{path} (dry run)"

    @cached_property
    def drivers(self) -> Mapping[str, ChosenPlugin]:
        """Role or device name -> its plugin, without the detector and the simulation."""
        return {role: plugin for role, plugin in self.chosen.items() if plugin.entry.role.is_hardware}

    @cached_property
    def identities(self) -> Mapping[str, str]:
        """Name of hardware that only one process can use -> the role or device that uses it."""
        # cached, because a run must unlock what it has locked, whatever a plugin answers later
        return {
            identity: role for role, plugin in self.drivers.items() for identity in plugin.identities(role)
        }

    @cached_property
    def virtual_time(self) -> bool:
        """Whether no device needs real time, so that the clock can be virtual."""
        return self.dry_run != "off" or all(plugin.virtual_time for plugin in self.drivers.values())


def check_kinds(document: Document, spec: ProfileSpec, host: PluginHost, problems: ProblemCollector) -> None:
    """Find lines that are on during unknown steps."""
    channels = {} if spec.lines is None else spec.lines.channels
    if not any(channel.on for channel in channels.values()):
        return  # avoids loading the modules of all steps
    registry = host.registry
    entries = {name: registry.find("step", name) for name in registry.names("step")}
    steps = [name for name, entry in entries.items() if entry and getattr(entry.factory, "takes_time", True)]
    known = [IDLE, *steps]
    for name, channel in channels.items():
        for place, kind in enumerate(channel.on):
            if kind not in known:
                loc = ("lines", "channels", name, "on", place)
                hint = did_you_mean(kind, known)
                problems.add(
                    document.error(loc, f"there is no kind of step '{clean(kind)}'", one_of(known), hint)
                )


def check_dead_time(document: Document, spec: ProfileSpec, problems: ProblemCollector) -> None:
    """Report a dead time before each batch for tweezers that are not virtual and would play silence."""
    mobile = spec.mobile_tweezers
    if mobile.motion.overhead_per_batch_s and not mobile.use.startswith(VIRTUAL_TWIN):
        what = f"a dead time before each batch is set for '{clean(mobile.use)}', which would play silence"
        expected = "none, as only `use: virtual` models a setup with dead times"
        problems.add(document.error(("mobile_tweezers", "overhead_per_batch"), what, expected, key=True))


def resolve_profile(
    profile: str | Path,
    overrides: Sequence[Override] = (),
    dry_run: DryRun = "off",
    *,
    named_in: Document | None = None,
    plugin_folders: Sequence[Path] = (),
    scan: Scan | None = None,
    problems: ProblemCollector | None = None,
    recorded: RecordedFiles | None = None,
) -> ResolvedProfile:
    """Read a profile, load the plugins and choose the plugin of each role.

    Args:
        named_in: The sequence that names the profile.
        plugin_folders: Plugin folders of the sequence, which come before the profile's folders.
        problems: Receives the problems of a readable profile. Without it they are raised.
        recorded: The profile's text and calibrations, if the run began earlier.

    Raises:
        ConfigError: The profile has an error.
        PluginLoadError: A plugin of the profile failed to load.
    """
    document, spec = load_profile(
        profile,
        overrides=overrides,
        named_in=named_in,
        scan=scan,
        problems=problems,
        kept=None if recorded is None else recorded.profile,
    )
    # if two plugins have the same name, the first is loaded
    folders = [*plugin_folders, *plugin_paths(document, spec.plugin_folders)]
    host = load_plugins(folders, max_wait_s=spec.timeouts.load_s)
    pins = None if recorded is None else recorded.calibrations
    with collecting(problems) as collector:
        return choose_plugins(document, spec, host, dry_run, collector, pins)


def choose_plugins(
    document: Document,
    spec: ProfileSpec,
    host: PluginHost,
    dry_run: DryRun,
    problems: ProblemCollector,
    calibrations: Mapping[str, str] | None = None,
) -> ResolvedProfile:
    """Choose the plugin of each role of a profile.

    Args:
        spec: Its content, with fallbacks for wrong values.
        calibrations: Kind -> id of the active calibration. None for the choice of profile and store.
    """
    repaired = bool(problems.problems)
    chosen: dict[str, ChosenPlugin] = {}
    warnings: list[str] = []
    refused: dict[str, ConfigError] = {}
    for role, choice in {**spec.choices, **spec.devices}.items():
        if choice.loc in document.replaced:  # its problem is reported, and this choice is a fallback
            refused[role] = ConfigError("its settings in the profile are invalid")
            continue
        try:
            chosen[role], warning = choose(host, document, spec, role, choice, dry_run)
            warnings += [f"{role}: {warning}"] if warning else []
        except ConfigError as error:
            refused[role] = error
            problems.add(error)
    check_kinds(document, spec, host, problems)
    check_dead_time(document, spec, problems)
    detector = chosen["detector"].dump() if "detector" in chosen else {}
    # calibrations need not fit a fallback grid
    active = (
        ActiveCalibrations({}, spec.grid_model())
        if repaired
        else calibrated(document, spec, problems, dry_run, detector, calibrations)
    )
    warnings += active.warnings
    return ResolvedProfile(
        document, spec, dry_run, host, active.grid, chosen, tuple(warnings), refused, active.entries
    )


def choose(
    host: PluginHost, document: Document, spec: ProfileSpec, role: str, choice: Choice, dry_run: DryRun
) -> tuple[ChosenPlugin, str]:
    """The plugin of a role or device of a profile, and a warning for the user or "".

    Raises:
        ConfigError: The name is unknown, the plugin failed to load, or its settings are wrong.
    """
    kind = choice.role if isinstance(choice, DeviceChoice) else role
    # not for a further camera among the devices, whose kind is also the name of a role
    by_line = kind == role and trigger_line(spec.line_specs, role) is not None
    if dry_run == "off" or not ROLES[kind].has_twin or choice.use == VIRTUAL_TWIN:
        chosen, warning = resolve(host, document, kind, choice), ""
    else:
        chosen, warning = _in_dry_run(host, document, kind, choice, dry_run)
    return replace(chosen, by_line=by_line), warning


def _in_dry_run(
    host: PluginHost, document: Document, kind: str, choice: Choice, dry_run: DryRun
) -> tuple[ChosenPlugin, str]:
    """The plugin with its simulated device or else its virtual twin, and a warning for the user or ""."""
    if kind == "simulation":  # a simulation on another computer has an identity, like hardware
        chosen = resolve(host, document, kind, choice)
        elsewhere = chosen.settings is not None and chosen.settings.identities()
        return (_twin(host, document, kind, choice) if elsewhere else chosen), ""
    if dry_run == "fast":
        return _twin(host, document, kind, choice), ""
    # lets a user try a sequence on a computer without the machine's drivers
    if absence := _absence(host, kind, choice.use):
        twin = _twin(host, document, kind, choice)
        return twin, f"{absence}; its virtual twin is used instead, and its settings were not checked"
    chosen = resolve(host, document, kind, choice)
    if chosen.entry.virtual_time:
        return chosen, ""
    if chosen.entry.simulated is not None and chosen.settings is not None:
        settings = chosen.settings.model_copy(update=dict(chosen.entry.simulated))
        return replace(chosen, settings=settings), ""
    reason = chosen.entry.no_simulator
    twin = _twin(host, document, kind, choice)
    return twin, f"{reason}; its virtual twin is used instead" if reason else ""


def _twin(host: PluginHost, document: Document, kind: str, choice: Choice) -> ChosenPlugin:
    """The virtual twin of a role."""
    entry = host.get(kind, VIRTUAL_TWIN)
    defaults = None if entry.settings_model is None else entry.settings_model()
    return ChosenPlugin(entry, defaults, document, choice.loc)


def _absence(host: PluginHost, kind: str, name: str) -> str:
    """The reason why no plugin offers a name (it failed to load, or does not exist), or ""."""
    if host.registry.find(kind, name) is not None:
        return ""
    try:
        host.get(kind, name)
    except PluginLoadError as error:
        return str(error)
    except UnknownPluginError as error:
        hint = f" ({error.hint})" if error.hint else ""
        return f"plugin '{clean(name)}' is not installed{hint}"
    return ""
