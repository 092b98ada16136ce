"""The points of a scan: each is a set of overrides, validated by the same functions as the files.

A scan has many points, but few different settings: a *part* is the settings of one plugin (the planner,
a step, a role or a device of the profile). A part is validated once for each content that the points
give it. Constructors are called later, when the run opens or by ``labseq check``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from labseq.config.addresses import PROFILE, ROLES, VARIABLES
from labseq.config.document import Document
from labseq.config.profile import DeviceChoice, MobileTweezersChoice
from labseq.config.scan import Axis, Scan
from labseq.config.sequence import SequenceSpec, StepSpec
from labseq.config.yaml_nodes import Node
from labseq.errors import ConfigError, Loc, PluginLoadError, ProblemCollector, one_of
from labseq.messages import clean
from labseq.roles import Step
from labseq.session.chosen import (
    HARDWARE_KINDS,
    ChosenPlugin,
    DryRun,
    choose,
    construct_role,
    dump,
    named,
    resolve,
    validate,
)
from labseq.session.profile import ResolvedProfile
from labseq.settings import Choice
from labseq.units import parse_any

MAX_PROBLEMS: Final = 20
"""The check of a scan stops after this number of wrong values."""

Part = tuple[bool, Loc]
"""Key of a part: whether it is in the profile, and the place of its settings."""


@dataclass(frozen=True, slots=True)
class PartSettings:
    """The settings of a part at one point.

    Attributes:
        chosen: The plugin; None for a step.
        step: The step; None for everything else.
        choice: The entry of a role in the profile; None for planner and steps.
        dump: The settings after defaults, SI, JSON-ready.
    """

    chosen: ChosenPlugin | None
    step: Step | None
    choice: Choice | None
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
    """

    planner: ChosenPlugin
    steps: tuple[tuple[str, Step], ...]
    hardware: ResolvedProfile
    parameters: Mapping[str, Any]
    document: Document


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints:
    """The points of a run.

    Attributes:
        scan: The scan, its axes bound to the profile.
        document: The sequence's file.
        sequence: Its content.
        hardware: The profile.
        dry_run: "off", "full" or "fast".
        planner: The planner if no axis changes it; None if it has an error.
        steps: Name and step, in order, if no axis changes them.
    """

    scan: Scan
    document: Document
    sequence: SequenceSpec
    hardware: ResolvedProfile
    dry_run: DryRun
    planner: ChosenPlugin | None
    steps: tuple[tuple[str, Step], ...]
    _documents: dict[Any, Document] = field(default_factory=dict[Any, Document], repr=False)
    _made: dict[Any, PartSettings] = field(default_factory=dict[Any, PartSettings], repr=False)
    _profiles: dict[Any, ResolvedProfile] = field(default_factory=dict[Any, ResolvedProfile], repr=False)

    def check(self, found: ProblemCollector) -> None:
        """Validate the parts with the values of every point.

        Args:
            found: Receives the problems, those of the first :data:`MAX_PROBLEMS` wrong values.
        """
        try:
            self._check_dependents()
        except ConfigError as error:
            found.add(error)
            return
        known, n_wrong = set(self.scan.explained(ConfigError(found.problems)).problems), 0
        for in_profile, point in [(side, point) for side in (False, True) for point in self._points(side)]:
            for part in self._parts():
                if part[0] != in_profile:
                    continue
                try:
                    self._part(part, point)
                except ConfigError as error:
                    new = [one for one in self.scan.explained(error).problems if one not in known]
                    known.update(new)
                    n_wrong += bool(new)
                    found.problems += new
                if n_wrong == MAX_PROBLEMS:
                    return

    def at(self, point: int) -> Point:
        """The settings of a point.

        Raises:
            ConfigError: A plugin refuses the values.
        """
        parts = {part: self._part(part, point) for part in self._parts()}
        planner, steps = self.planner, list(self.steps)
        for (in_profile, loc), made in parts.items():
            if not in_profile and made.step is None:
                planner = made.chosen
            elif not in_profile and made.step is not None:
                steps[int(loc[1])] = (steps[int(loc[1])][0], made.step)
        assert planner is not None
        parameters = {axis.address: _value_of(axis, node, parts) for axis, node in self.scan.values(point)}
        for axis in self.scan.axes:
            for loc in self._dependents(axis):
                part = _part_of(axis.of_profile, loc)
                parameters[_address(axis.of_profile, loc)] = _value_in(parts[part], part, loc)
        hardware = self._profile_at(parts, self._document_at(True, point))
        return Point(planner, tuple(steps), hardware, parameters, self._document_at(False, point))

    def of(self, scan: Scan) -> ScanPoints:
        """The points of another scan of the same run."""
        return replace(self, scan=scan, _documents={})

    def present(self, axis: Axis) -> Any:
        """The value of an axis in the files, SI; None if it is missing or invalid."""
        document = self.hardware.document if axis.of_profile else self.document
        if axis.loc[0] == VARIABLES:
            return _si(document.get(axis.loc))
        part = _part_of(axis.of_profile, axis.loc)
        try:
            return _value_in(self._make(part, document), part, axis.loc)
        except ConfigError:
            return None

    def _points(self, in_profile: bool) -> list[int]:
        """A point for each combination of the values that go into one of the two files."""
        shape, touched = self.scan.shape, self.scan.groups_in(in_profile)
        if not touched:
            return []
        sizes = [n if i in touched else 1 for i, n in enumerate(shape)]
        return [int(np.ravel_multi_index(positions, shape)) for positions in np.ndindex(*sizes)]

    def _parts(self) -> list[Part]:
        """The parts that the scan changes, directly or through expressions."""
        places = [
            (axis.of_profile, loc) for axis in self.scan.axes for loc in (axis.loc, *self._dependents(axis))
        ]
        return list(dict.fromkeys(_part_of(*place) for place in places if place[1][0] != VARIABLES))

    def _dependents(self, axis: Axis) -> list[Loc]:
        """The settings with an expression that depends on an axis."""
        expressions = (self.hardware.document if axis.of_profile else self.document).expressions
        found = [] if expressions is None else expressions.following(axis.loc)
        return [loc for loc in found if loc[0] != VARIABLES]

    def _check_dependents(self) -> None:
        """Raise for an axis that changes no setting, or a setting that must be the same in the whole run."""
        for axis in self.scan.axes:
            dependents, own = self._dependents(axis), clean(axis.address)
            if axis.loc[0] == VARIABLES and not dependents:
                hint = f"write '= {own.removeprefix(PROFILE)}' in the setting that is to follow it"
                what = f"nothing follows from '{own}'"
                raise axis.key.error(what, "an expression with it", hint)
            for loc in dependents:
                if not _is_part(axis.of_profile, loc):
                    other = clean(_address(axis.of_profile, loc))
                    what = f"'{other}' follows from '{own}', and a scan cannot change it"
                    raise axis.key.error(what, "one value of it for the whole run")

    def _document_at(self, in_profile: bool, point: int) -> Document:
        """The sequence or the profile with the values of a point."""
        positions = self.scan.positions(point)
        key = in_profile, tuple(positions[group] for group in self.scan.groups_in(in_profile))
        if key not in self._documents:
            document = self.hardware.document if in_profile else self.document
            self._documents[key] = self.scan.put(document, point, profile=in_profile)
        return self._documents[key]

    def _part(self, part: Part, point: int) -> PartSettings:
        document = self._document_at(part[0], point)
        key = part, json.dumps(document.get(part[1]))
        if key not in self._made:
            self._made[key] = self._make(part, document)
        return self._made[key]

    def _make(self, part: Part, document: Document) -> PartSettings:
        in_profile, loc = part
        if in_profile:
            return self._make_role(document, loc)
        if loc == ("planner",):
            choice = document.validate(Choice, loc).placed("planner")
            chosen = resolve(self.hardware.host, document, "planner", choice)
            return PartSettings(chosen, None, None, chosen.dump())
        step, dumped = make_step(self.hardware, document, self.sequence.shot[int(loc[1])])
        return PartSettings(None, step, None, dumped)

    def _make_role(self, document: Document, loc: Loc) -> PartSettings:
        role = str(loc[-1])
        own = {**self.hardware.profile.choices, **self.hardware.profile.devices}[role]
        choice = document.validate(type(own), loc).placed(*map(str, loc))
        kind = choice.role if isinstance(choice, DeviceChoice) else role
        if kind in HARDWARE_KINDS and choice.use != self.hardware.document.get((*loc, "use")):
            what = f"a scan cannot change the driver of {role}"
            raise document.error((*loc, "use"), what, "one driver for the whole run")
        chosen, _ = choose(self.hardware.host, document, kind, choice, self.dry_run)
        if kind in HARDWARE_KINDS and chosen.virtual_time != self.hardware.chosen[role].virtual_time:
            what = f"the scan would change whether {role} is simulated"
            raise document.error(loc, what, "all points simulated, or none")
        dumped = chosen.dump()
        if isinstance(choice, MobileTweezersChoice):
            dumped |= choice.model_dump(mode="json", exclude={"use"})
        return PartSettings(chosen, None, choice, dumped)

    def _profile_at(self, parts: Mapping[Part, PartSettings], document: Document) -> ResolvedProfile:
        """The profile at a point; points with equal parts share one object."""
        changed = {str(loc[-1]): made for (in_profile, loc), made in parts.items() if in_profile}
        key = tuple(map(id, changed.values()))
        if key not in self._profiles:
            chosen, profile = dict(self.hardware.chosen), self.hardware.profile
            for name, made in changed.items():
                assert made.chosen is not None
                chosen[name] = made.chosen
                if isinstance(made.choice, MobileTweezersChoice):
                    profile = profile.model_copy(update={"mobile_tweezers": made.choice})
            own = replace(self.hardware, document=document, profile=profile, chosen=chosen)
            self._profiles[key] = own if changed else self.hardware
        return self._profiles[key]


def _part_of(in_profile: bool, loc: Loc) -> Part:
    if not in_profile:
        return False, loc[:1] if loc[0] == "planner" else loc[:3]
    return True, loc[:2] if loc[0] == "devices" else loc[:1]


def _is_part(in_profile: bool, loc: Loc) -> bool:
    """Whether a scan may change a setting."""
    if in_profile:
        return loc[0] in ROLES or (loc[0] == "devices" and len(loc) > 2)
    return loc[0] == "planner" or (loc[0] == "shot" and len(loc) > 3)


def _address(in_profile: bool, loc: Loc) -> str:
    return (PROFILE if in_profile else "") + ".".join(map(str, loc))


def _value_of(axis: Axis, node: Node, parts: Mapping[Part, PartSettings]) -> Any:
    """A scanned value after the plugin's validation, in SI; a mapping as it is written."""
    if axis.loc[0] == VARIABLES:
        return _si(node.plain())
    part = _part_of(axis.of_profile, axis.loc)
    value = _value_in(parts[part], part, axis.loc)
    return node.plain() if value is None or isinstance(node.value, dict) else value


def _value_in(made: PartSettings, part: Part, loc: Loc) -> Any:
    """The value of an address in the settings of its part; None if it is missing."""
    value: Any = made.dump
    for step in loc[len(part[1]) :]:
        try:
            value = value[step]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def _si(value: Any) -> Any:
    """The value of a variable in SI."""
    return parse_any(value)[0] if isinstance(value, str) else value


def make_step(hardware: ResolvedProfile, document: Document, spec: StepSpec) -> tuple[Step, dict[str, Any]]:
    """A step of a sequence, and its settings for the record.

    Raises:
        ConfigError: The step is unknown, its settings are invalid, or the profile lacks the device that it
            names; with their place.
    """
    entry = named(hardware.host, document, "step", spec.kind, spec.loc, key=True)
    fields = entry.settings_model.model_fields if entry.settings_model is not None else {}
    for key in {"name", "policy"}.difference(fields):
        if document.root.at((*spec.loc, key)) is not None:
            what, hint = (
                f"'{key}' is in the settings of '{spec.kind}'",
                f"write '{key}' on a line of its own below",
            )
            raise document.error((*spec.loc, key), what, f"'{key}' beside '{spec.kind}'", hint, key=True)
    settings = validate(document, entry, spec.loc)
    try:
        step, dumped = construct_role(entry, settings), dump(entry, settings)
    except (ConfigError, PluginLoadError) as error:
        raise document.error(spec.loc, str(error)) from error
    key, devices = getattr(step, "device_setting", ""), hardware.profile.devices
    name = getattr(settings, key, None) if key else None
    may_be_camera = getattr(step, "device_may_be_camera", False)
    known = [one for one, choice in devices.items() if may_be_camera or choice.role == "device"]
    known += ["camera"] if may_be_camera else []
    if name is not None and name not in known:
        what = f"the profile '{hardware.profile.name}' has no device '{name}'"
        if name in devices:
            what = f"'{name}' is a camera, which '{spec.kind}' cannot use"
        problem = document.problem((*spec.loc, key), what, one_of(sorted(known)))
        raise ConfigError(replace(problem, notes=(place_note(hardware.document, "devices"),)))
    return step, dumped


def place_note(document: Document, key: str) -> str:
    """The note of a problem that names the place of a key in the other file."""
    line, column = document.locate((key,), key=True)
    return f"see '{key}' at {document.path}:{line}:{column}"
