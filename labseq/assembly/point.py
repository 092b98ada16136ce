"""The settings of a run at one point of its scan, and the steps among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

from labseq.assembly.plugin_choice import ChosenPlugin, construct_role, dump, find_entry, read_settings
from labseq.errors import ConfigError, PluginLoadError, one_of
from labseq.settings import settings_of

if TYPE_CHECKING:
    from labseq.assembly.profile import ResolvedProfile
    from labseq.config.document import Document
    from labseq.config.sequence import StepSpec
    from labseq.model import TargetPattern
    from labseq.registry import Entry
    from labseq.roles import Step

T = TypeVar("T")


class Configured(NamedTuple, Generic[T]):
    """A planner or step, and its settings after defaults, SI, JSON-ready."""

    plugin: T
    dump: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Point:
    """A run's settings at one point.

    Attributes:
        planner: The planner and its settings.
        steps: Name and step, in order.
        hardware: The profile.
        parameters: Scanned address -> value, SI, JSON-ready.
        document: The sequence's file with the values of the point.
        target: The target; None for that of the run.
    """

    planner: ChosenPlugin
    steps: tuple[tuple[str, Step], ...]
    hardware: ResolvedProfile
    parameters: Mapping[str, Any]
    document: Document
    target: TargetPattern | None = None

    @property
    def lab_key(self) -> tuple[int, int]:
        """The same for points that need the same devices and planner, as long as these points exist."""
        return id(self.planner), id(self.hardware)


def make_step(hardware: ResolvedProfile, document: Document, spec: StepSpec) -> Configured[Step]:
    """A step of a sequence, and its settings for the record.

    Raises:
        ConfigError: The step is unknown, its settings are invalid, or the profile lacks the device that it
            names; with their place.
    """
    entry = find_entry(hardware.host, document, "step", spec.kind, spec.loc, key=True)
    _check_indentation(document, spec, entry)
    settings = read_settings(document, entry, spec.loc)
    try:
        step, dumped = construct_role(entry, settings), dump(entry, settings)
    except (ConfigError, PluginLoadError) as error:
        raise document.error(spec.loc, str(error)) from error
    if step.device_setting and (name := getattr(settings, step.device_setting, None)) is not None:
        _check_device(hardware, document, spec, step, name)
    return Configured(step, dumped)


def _check_indentation(document: Document, spec: StepSpec, entry: Entry) -> None:
    """Raise for keys of the item of the list that are indented as settings of the step are."""
    settings = {setting.key for setting in settings_of(entry.settings_model)}
    for key in ("name", "policy"):
        if key not in settings and document.root.at((*spec.loc, key)) is not None:
            what = f"'{key}' is in the settings of '{spec.kind}'"
            hint = f"write '{key}' on a line of its own below"
            raise document.error((*spec.loc, key), what, f"'{key}' beside '{spec.kind}'", hint, key=True)


def _check_device(
    hardware: ResolvedProfile, document: Document, spec: StepSpec, step: Step, name: str
) -> None:
    """Raise if the profile lacks the device that a step names, or if the step cannot use it."""
    devices = hardware.profile.devices
    if step.device_may_be_camera:
        known = ["camera", *devices]
    else:
        known = [device for device, choice in devices.items() if choice.role == "device"]
    if name in known:
        return
    what = f"the profile '{hardware.profile.name}' has no device '{name}'"
    if name in devices:
        what = f"'{name}' is a camera, which '{spec.kind}' cannot use"
    problem = document.problem((*spec.loc, step.device_setting), what, one_of(sorted(known)))
    raise ConfigError(replace(problem, notes=(place_note(hardware.document, "devices"),)))


def place_note(document: Document, key: str) -> str:
    """The note of a problem that names the place of a key in the other file."""
    line, column = document.locate((key,), key=True)
    return f"see '{key}' at {document.path}:{line}:{column}"
