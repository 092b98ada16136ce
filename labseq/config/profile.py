"""Hardware profiles: what a run runs on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, field_validator, model_validator

from labseq.config.addresses import Override
from labseq.config.calibrations import CalibrationSettings
from labseq.config.collect import ProblemCollector
from labseq.config.devices import DeviceChoice, named
from labseq.config.document import Document, StoredText
from labseq.config.fields import (
    FORMAT,
    MAY_ADD,
    ROLES,
    Choice,
    Folders,
    FormatVersion,
    Name,
    check_kind,
    empty_is,
    setting_error,
    placed_by_field,
)
from labseq.config.find import find_profile
from labseq.config.lines import LinesChoice
from labseq.config.mending import FallbackValues, load_checked
from labseq.config.motion import MobileTweezersChoice, Sites
from labseq.config.policies import BudgetSettings
from labseq.config.scan import Scan
from labseq.config.scan_reading import bind_scan
from labseq.config.settings import Frequency, Length, Settings
from labseq.config.timeouts import TimeoutSettings
from labseq.config.variables import Variables
from labseq.model import MotionSpec, SiteGrid
from labseq.model.grid import centred_comb
from labseq.model.lines import LineSpec
from labseq.units import format_quantity


class FrequencyComb(Settings):
    """Tones of the rows or columns of the grid: equally spaced, or a table from a calibration."""

    centre: Frequency = Field(default=100e6, gt=0, description="frequency of the grid's centre")
    step: Frequency = Field(
        default=1.6e6, description="frequency from one row or column to the next; negative if it falls"
    )
    table: tuple[Annotated[Frequency, Field(gt=0)], ...] = Field(
        default=(), description="calibrated frequency of each row or column, in place of centre and step"
    )

    @field_validator("step")
    @classmethod
    def _tones_differ(cls, step: float) -> float:
        if step == 0:
            raise ValueError("a step of 0 puts all tones at one frequency; expected another value")
        return step

    @field_validator("table")
    @classmethod
    def _tones_in_order(cls, table: tuple[float, ...]) -> tuple[float, ...]:
        steps_hz = np.diff(table)
        if not (np.all(steps_hz > 0) or np.all(steps_hz < 0)):
            raise ValueError("the tones neither rise nor fall all along; expected the sites' in order")
        return table

    def tones(self, n_sites: int) -> NDArray[np.float64]:
        """Frequencies of the tones of so many sites, in Hz."""
        return np.array(self.table) if self.table else centred_comb(n_sites, self.centre, self.step)


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


class ProfileSpec(Settings):
    """A hardware profile, checked but for the settings of its plugins."""

    labseq: FormatVersion = Field(description="version of the file format: 1")
    name: Name = Field(description="name of the machine")
    grid: GridSettings = Field(description="the grid of sites")
    camera: Annotated[Choice, placed_by_field] = Field(description="what takes images")
    static_tweezers: Annotated[Choice, placed_by_field] = Field(description="what makes the static array")
    mobile_tweezers: Annotated[MobileTweezersChoice, placed_by_field] = Field(
        description="what moves the atoms, and how"
    )
    detector: Annotated[Choice, placed_by_field] = Field(description="what finds the atoms on an image")
    devices: Annotated[dict[str, DeviceChoice], empty_is({}), AfterValidator(named)] = Field(
        default={}, description="further instruments, by name"
    )
    lines: Annotated[LinesChoice, placed_by_field] | None = Field(
        default=None, description="the timing box that switches light and sends triggers, and its lines"
    )
    simulation: Annotated[Choice, placed_by_field] | None = Field(
        default=None, description="the simulated world that virtual devices act on"
    )
    calibrations: Annotated[CalibrationSettings, empty_is({})] = Field(
        default=CalibrationSettings(), description="which calibrations count: a mapping, a folder, or `off`"
    )
    plugin_folders: Folders = Field(default=[], description="folders with plugins, relative to this file")
    variables: Variables = Field(default={}, description="numbers and quantities that expressions refer to")
    timeouts: Annotated[TimeoutSettings, empty_is({})] = Field(
        default=TimeoutSettings(), description="how long plugins may take"
    )
    budgets: Annotated[BudgetSettings, empty_is({})] = Field(
        default=BudgetSettings(), description="what the computer may take for its part of a shot"
    )

    @property
    def choices(self) -> dict[str, Choice]:
        """The plugins chosen in this file, by role; lines and simulation only if there are any."""
        chosen = {role: getattr(self, role) for role in ROLES}
        return {role: choice for role, choice in chosen.items() if choice is not None}

    @property
    def motion(self) -> MotionSpec:
        """How the mobile tweezers move."""
        return self.mobile_tweezers.spec()

    @property
    def line_specs(self) -> tuple[LineSpec, ...]:
        """The lines, in the order of their channels."""
        return () if self.lines is None else self.lines.specs()

    def grid_model(self) -> SiteGrid:
        """The grid of sites, with the tones of its rows and columns."""
        return self.grid.model()


_VIRTUAL: Final = {"use": "virtual"}
_NARROW: Final = {"step": 1.0}
_STAND_INS: Final = FallbackValues(
    values={
        "labseq": FORMAT,
        "name": "x",
        "grid": {
            "rows": 1000,
            "cols": 1000,
            "spacing": 1e-6,
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
    beside: Path,
    overrides: Sequence[Override | tuple[str, str]] = (),
    named_in: Document | None = None,
    scan: Scan | None = None,
    found: ProblemCollector | None = None,
    kept: StoredText | None = None,
) -> tuple[Document, ProfileSpec]:
    """Find and read a hardware profile.

    Args:
        name_or_path: See :func:`find_profile`.
        beside: Folder of the file that names the profile.
        overrides: Values that replace those of the file, addresses without "profile.".
        named_in: The sequence whose key ``profile`` names it, for messages.
        scan: The sequence's scan; the values of its first point count.
        kept: What the file says, in place of what it says today.
        found: Where the problems of a file that can be read go; without it they are raised.

    Returns:
        The document, overrides included, and what it says; stand-ins for everything of which
        a problem was found.

    Raises:
        ConfigError: Everything that is wrong, but for the settings of plugins.
    """
    document = Document.read(find_profile(name_or_path, beside, named_in=named_in), kept)
    check_kind(document, "hardware profile")
    placed = [_of_profile(Override(*override)) for override in overrides]
    document = document.override_all(placed, may_add=MAY_ADD, found=found).evaluated()
    document = document if scan is None else bind_scan(scan, document).begun(document, profile=True)
    return load_checked(document, ProfileSpec, "a hardware profile", _STAND_INS, found)


def _of_profile(override: Override) -> Override:
    origin = override.origin or f"--set profile.{override.address}={override.value}"
    return Override(override.address, override.value, origin)
