"""Settings of a hardware profile file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, cast

from pydantic import AfterValidator, Field, model_validator

from labseq.config.addresses import MAY_ADD, PROFILE_ROLES, Override
from labseq.config.document import Document, FallbackValues, StoredText, check_kind, load_checked
from labseq.config.find import find_profile
from labseq.errors import ProblemCollector, collecting
from labseq.messages import clean
from labseq.model import CALIBRATION_KINDS, FrequencyComb, MotionSpec, SiteGrid
from labseq.model.lines import LineSpec
from labseq.model.motion import Sites
from labseq.model.policies import Blinding, Timeouts
from labseq.settings import (
    FORMAT,
    Choice,
    Duration,
    FilePath,
    Folders,
    FormatVersion,
    Fraction,
    Length,
    Name,
    PositiveDuration,
    Settings,
    Text,
    Variables,
    empty_is,
    named_by_key,
    placed_by_field,
    setting_error,
    with_settings_of,
)
from labseq.units import format_quantity

if TYPE_CHECKING:
    from labseq.config.scan import Scan


class DeviceChoice(Choice):
    """The plugin of an instrument or further camera, and the core's settings for it."""

    role: Literal["device", "camera"] = Field(
        default="device",
        description="kind of plugin: `camera` for a further camera, such as "
        "a camera for the light of the tweezers",
    )
    blinding: Blinding | None = Field(
        default=None,
        description="no exposure with EM gain while its light is on: `{value: state, when: [on]}`",
    )

    @model_validator(mode="after")
    def _check_blinding(self) -> Self:
        if self.role == "camera" and self.blinding is not None:
            raise setting_error(
                "`blinding` is set for a camera", "`role: device` with it", at=("blinding",), key=True
            )
        return self


class PowerMeterSettings(Settings):
    """The power meter of the tweezers for `labseq calibrate tweezers` and `amplitudes`."""

    device: Text = Field(
        default="trap_camera",
        description="device of the profile that measures the power of each tweezer: a camera with "
        "`role: camera`, another meter, or `camera` for the camera of the atoms",
    )
    value: Text = Field(
        default="spot_powers",
        description="reading of a device other than a camera: an array of rows and columns, or one "
        "number for the light of all tweezers. With one number each tone is measured alone",
    )
    exposure: PositiveDuration = Field(
        default=1e-3, description="exposure time of a camera. Its brightest pixels must not be saturated"
    )
    settle: Duration = Field(
        default=0.0,
        description="time that the meter needs to show a change of the tones",
    )
    mobile_exposure: PositiveDuration = Field(
        default=0.1e-3, description="exposure time of a camera for the mobile tweezers, which are brighter"
    )
    lead: Duration = Field(
        default=5e-3,
        description="how long the mobile tweezers are on before and after an exposure. It must be longer "
        "than the delay of a camera",
    )


def check_name(name: str, what: str) -> None:
    """Raise for a name that cannot be used in an address or a file."""
    if not re.fullmatch(r"[^\W\d][\w-]*", name):
        expected = "a word of letters, digits, '_' and '-' that begins with a letter"
        raise setting_error(f"{what} is called '{clean(name)}'", expected, at=(name,), key=True)


def check_devices(devices: dict[str, DeviceChoice]) -> dict[str, DeviceChoice]:
    """Raise for invalid device names, and add to each choice its place in the file."""
    for name in devices:
        if name in (*PROFILE_ROLES, "planner"):
            raise setting_error(
                f"a device is called '{name}', like a role", "another name", at=(name,), key=True
            )
        check_name(name, "a device")
    return {name: choice.placed("devices", name) for name, choice in devices.items()}


OFF: Final = "off"
"""Value instead of an id or a folder that means no calibration."""


class CalibrationChoices(Settings):
    """The calibration of each kind to use instead of the active calibration."""

    sites: Text | None = Field(
        default=None, description="where the sites are on the frames: an id, or `off` for none"
    )
    thresholds: Text | None = Field(default=None, description="the detector's thresholds: an id, or `off`")
    tweezers: Text | None = Field(
        default=None, description="amplitudes of the static tweezers' tones: an id, or `off`"
    )
    amplitudes: Text | None = Field(
        default=None, description="amplitudes of the mobile tweezers' tones: an id, or `off`"
    )
    frequencies: Text | None = Field(
        default=None, description="tones of the mobile tweezers: an id, or `off`"
    )
    overlay: Text | None = Field(
        default=None, description="position of the mobile tweezers on the static tweezers: an id, or `off`"
    )
    timing: Text | None = Field(
        default=None, description="time from the start of a cycle to the light: an id, or `off`"
    )

    def of(self, kind: str) -> str | None:
        """The choice for a kind of calibration: an id, "off", or None for the active one."""
        return cast("str | None", getattr(self, kind))


class CalibrationSettings(Settings):
    """Where the profile's calibrations are stored, and which calibrations are used.

    The mapping may be replaced by a folder alone, or by `off` for no calibrations.
    """

    folder: FilePath | None = Field(
        default=None,
        description="folder of the calibrations, relative to this file. By default `calibrations/NAME` next "
        "to a file `NAME.yaml`, and in `./hardware_profiles` for a profile that comes with labseq",
    )
    use: Annotated[CalibrationChoices, empty_is({})] = Field(
        default=CalibrationChoices(),
        description="calibrations to use instead of those activated by `labseq calibration use`",
    )

    @model_validator(mode="before")
    @classmethod
    def _accept_folder_or_off(cls, value: Any) -> Any:
        if value == OFF:
            return {"use": dict.fromkeys(CALIBRATION_KINDS, OFF)}
        return {"folder": value} if isinstance(value, str) else value


def _distinct(channels: dict[str, LineSpec]) -> dict[str, LineSpec]:
    for (first, a), (second, b) in combinations(channels.items(), 2):
        if a.channel == b.channel:
            what = f"'{first}' and '{second}' are both on channel {a.channel}"
            raise setting_error(what, "a channel for each line", at=(second, "channel"))
    for (first, a), (second, b) in combinations(channels.items(), 2):
        if a.triggers and a.triggers == b.triggers:
            what = f"'{first}' and '{second}' both trigger the {a.triggers.replace('_', ' ')}"
            raise setting_error(what, "one line that triggers it", at=(second, "triggers"))
    for name in channels:
        check_name(name, "a line")
    return channels


class LinesChoice(Choice):
    """The timing box and its lines."""

    channels: Annotated[dict[str, LineSpec], named_by_key, AfterValidator(_distinct)] = Field(
        default={}, description="name of each line -> its channel, and when it is on"
    )
    mutually_exclusive: tuple[tuple[Text, Text], ...] = Field(
        default=(), description="pairs of lines that must never be on at the same time"
    )

    @model_validator(mode="after")
    def _check_exclusive_pairs(self) -> Self:
        for number, pair in enumerate(self.mutually_exclusive):
            for place, name in enumerate(pair):
                if name not in self.channels:
                    known = ", ".join(f"'{line}'" for line in self.channels) or "none is declared"
                    raise setting_error(
                        f"there is no line '{name}'", known, at=("mutually_exclusive", number, place)
                    )
            first, second = (self.channels[name] for name in pair)
            if both := sorted(set(first.on) & set(second.on)):
                what = f"'{pair[0]}' and '{pair[1]}' must never be on together, but are during '{both[0]}'"
                raise setting_error(what, "one of them off", at=("channels", pair[1], "on"))
        return self

    def specs(self) -> tuple[LineSpec, ...]:
        """The lines, in the order of their channels."""
        # shorter ones first, so that output 10 follows output 9
        names = {spec: str(spec.channel) for spec in self.channels.values()}
        return tuple(sorted(names, key=lambda spec: (len(names[spec]), names[spec])))


@with_settings_of(MotionSpec)
class MobileTweezersChoice(Choice):
    """The plugin of the mobile tweezers, and how they move."""

    @property
    def motion(self) -> MotionSpec:
        """The motion of the mobile tweezers."""
        return MotionSpec(**{field.name: getattr(self, field.name) for field in fields(MotionSpec)})


class GridSettings(Settings):
    """The grid of static tweezer sites, and the mobile tweezers' tones at them."""

    rows: Sites = Field(description="number of rows")
    cols: Sites = Field(description="number of columns")
    spacing: Annotated[Length, Field(gt=0)] = Field(description="distance between neighbouring sites")
    lattice: Literal["triangular", "square"] = Field(default="triangular", description="kind of lattice")
    shear: Literal[1, -1] = Field(
        default=1, description="1 if rows shift to the right on the way down the image, -1 if to the left"
    )
    row_frequency: Annotated[FrequencyComb, empty_is({})] = Field(
        default=FrequencyComb(), description="tones of the rows"
    )
    column_frequency: Annotated[FrequencyComb, empty_is({})] = Field(
        default=FrequencyComb(), description="tones of the columns"
    )

    @model_validator(mode="after")
    def _tones_fit(self) -> Self:
        combs = (
            ("row_frequency", self.row_frequency, self.rows),
            ("column_frequency", self.column_frequency, self.cols),
        )
        for name, comb, n_sites in combs:
            if comb.table and len(comb.table) != n_sites:
                what = f"there are {len(comb.table)} tones for {n_sites} sites"
                raise setting_error(what, f"{n_sites} frequencies", at=(name, "table"))
            lowest = float(comb.tones(n_sites).min())
            if lowest <= 0:
                what = f"the lowest of the {n_sites} tones is at {format_quantity(lowest, 'frequency')}"
                raise setting_error(what, "all tones above 0 Hz", "choose a smaller step", at=(name,))
        return self

    def model(self) -> SiteGrid:
        """The grid."""
        return SiteGrid(
            self.rows,
            self.cols,
            self.spacing,
            self.lattice,
            self.shear,
            self.row_frequency.tones(self.rows),
            self.column_frequency.tones(self.cols),
        )


class BudgetSettings(Settings):
    """Time budgets of the computer for the stages of a shot."""

    detect: Duration = Field(default=5e-3, description="finding the atoms on a frame")
    plan: Duration = Field(default=5e-3, description="planning a cycle")
    check: Duration = Field(default=2e-3, description="checking a plan")
    tones: Duration = Field(default=2e-3, description="making the tone program of a plan")
    write: Duration = Field(default=50e-3, description="writing a shot to the disk")


class AlarmSettings(Settings):
    """Signs in a shot that the machine does not see or move atoms."""

    saturated: Fraction = Field(
        default=0.05,
        description="largest share of a frame's pixels at its highest value. 100 % turns the alarm off",
    )
    frozen: bool = Field(default=True, description="whether two identical frames in a row are an alarm")
    atoms: Fraction = Field(
        default=0.02,
        description="least share of the sites with an atom on the first image, over as many shots as have "
        "100 sites together. 0 turns the alarm off",
    )
    full: int = Field(
        default=100,
        ge=0,
        description="an alarm if this many sites, in one shot or several in a row, all have an atom on the "
        "first image. 0 turns the alarm off",
    )
    loading: Fraction = Field(
        default=0.5,
        description="least number of loaded atoms, relative to the mean of the last 10 to 20 shots with the "
        "same settings. It must also be 5 standard deviations below. 0 turns the alarm off",
    )
    confidence: Fraction = Field(
        default=0.99,
        description="least confidence of the detector, on average over the sites of an image, over as many "
        "shots as have 1,000 sites together. 0 turns the alarm off",
    )
    arrived: Fraction = Field(
        default=0.1,
        description="least share of the atoms moved to empty sites by the first cycle that the next image "
        "shows there, over as many shots as have 100 such atoms together. 0 turns the alarm off",
    )
    clock: Duration = Field(
        default=10.0, description="largest jump of the computer's clock between two shots"
    )
    stop_after: int = Field(
        default=10,
        ge=0,
        description="number of shots in a row with the same alarm that stops the run. 0 means never",
    )


class ProfileSpec(Settings):
    """A hardware profile. The settings of its plugins are checked later."""

    labseq: FormatVersion = Field(description="version of the file format: 1")
    name: Name = Field(description="name of the machine")
    grid: GridSettings = Field(description="the grid of sites")
    camera: Annotated[Choice, placed_by_field] = Field(description="the camera's plugin")
    static_tweezers: Annotated[Choice, placed_by_field] = Field(description="the plugin of the static array")
    mobile_tweezers: Annotated[MobileTweezersChoice, placed_by_field] = Field(
        description="the plugin that moves the atoms, and how they move"
    )
    detector: Annotated[Choice, placed_by_field] = Field(
        description="the plugin that finds the atoms on an image"
    )
    devices: Annotated[dict[str, DeviceChoice], empty_is({}), AfterValidator(check_devices)] = Field(
        default={}, description="further instruments, by name"
    )
    lines: Annotated[LinesChoice, placed_by_field] | None = Field(
        default=None, description="the timing box that switches light and sends triggers, and its lines"
    )
    simulation: Annotated[Choice, placed_by_field] | None = Field(
        default=None, description="the simulation that virtual devices act on"
    )
    equalise: Annotated[PowerMeterSettings, empty_is({})] = Field(
        default=PowerMeterSettings(),
        description="power meter of `labseq calibrate tweezers` and `amplitudes`, instead of the "
        "defaults of the step `equalise`",
    )
    calibrations: Annotated[CalibrationSettings, empty_is({})] = Field(
        default=CalibrationSettings(), description="which calibrations to use: a mapping, a folder, or `off`"
    )
    plugin_folders: Folders = Field(default=[], description="folders with plugins, relative to this file")
    variables: Variables = Field(default={}, description="numbers and quantities that expressions refer to")
    timeouts: Annotated[Timeouts, empty_is({})] = Field(
        default=Timeouts(), description="how long plugins may take"
    )
    budgets: Annotated[BudgetSettings, empty_is({})] = Field(
        default=BudgetSettings(), description="time budgets of the computer for its part of a shot"
    )
    alarms: Annotated[AlarmSettings, empty_is({})] = Field(
        default=AlarmSettings(), description="when a shot gives an alarm, and when alarms end a run"
    )

    @model_validator(mode="after")
    def _check_meter(self) -> Self:
        named = self.equalise.device
        if "device" in self.equalise.model_fields_set and named not in (known := ["camera", *self.devices]):
            expected = ", ".join(f"'{one}'" for one in known)
            raise setting_error(f"there is no device '{clean(named)}'", expected, at=("equalise", "device"))
        return self

    @property
    def choices(self) -> dict[str, Choice]:
        """The plugins chosen in this file, by role, with lines and simulation only if the file has them."""
        choices = {role: getattr(self, role) for role in PROFILE_ROLES}
        return {role: choice for role, choice in choices.items() if choice is not None}

    @property
    def motion(self) -> MotionSpec:
        """The motion of the mobile tweezers."""
        return self.mobile_tweezers.motion

    @property
    def blinding(self) -> dict[str, Blinding]:
        """The devices whose light would damage a camera with EM gain, and when it is on."""
        marks = {name: device.blinding for name, device in self.devices.items()}
        return {name: mark for name, mark in marks.items() if mark is not None}

    @property
    def line_specs(self) -> tuple[LineSpec, ...]:
        """The lines, in the order of their channels."""
        return () if self.lines is None else self.lines.specs()

    def grid_model(self) -> SiteGrid:
        """The grid of sites, with the tones of its rows and columns."""
        return self.grid.model()


_VIRTUAL: Final = {"use": "virtual"}
_NARROW: Final = {"step": "1 Hz"}
_FALLBACKS: Final = FallbackValues(
    values={
        "labseq": FORMAT,
        "name": "x",
        "grid": {
            "rows": 1000,
            "cols": 1000,
            "spacing": "1 um",
            "row_frequency": _NARROW,
            "column_frequency": _NARROW,
        },
        "camera": _VIRTUAL,
        "static_tweezers": _VIRTUAL,
        "mobile_tweezers": _VIRTUAL,
        "detector": {"use": "threshold"},
    },
    items={"devices": _VIRTUAL},
)


def load_profile(
    name_or_path: str | Path,
    *,
    overrides: Sequence[Override] = (),
    named_in: Document | None = None,
    scan: Scan | None = None,
    problems: ProblemCollector | None = None,
    kept: StoredText | None = None,
) -> tuple[Document, ProfileSpec]:
    """Find and read a hardware profile.

    Args:
        name_or_path: As for :func:`find_profile`, next to ``named_in`` or else in the working folder.
        overrides: Values that replace those in the file, addresses without "profile.".
        named_in: The sequence whose key ``profile`` names it.

    Returns:
        The document, overrides included, and its content, with fallbacks for wrong values.

    Raises:
        ConfigError: All errors, except in settings of plugins.
    """
    beside = Path() if named_in is None else named_in.path.parent
    document = Document.read(find_profile(name_or_path, beside, named_in=named_in), kept)
    check_kind(document, "hardware profile")
    with collecting(problems) as collector:
        document = document.override_all(overrides, collector, may_add=MAY_ADD).evaluated()
        document = document if scan is None else scan.bound(document).at_first_point(document, profile=True)
        return load_checked(document, ProfileSpec, "a hardware profile", _FALLBACKS, collector)
