"""The grid of sites, the atoms on it, and the target pattern."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import Field, field_validator

from labseq.settings import Frequency, Settings

PAPERS_LOADING: Final = 0.75
"""Default fraction of the sites that hold an atom after loading."""

Floats: TypeAlias = NDArray[np.float64]

Occupancy: TypeAlias = NDArray[np.bool_]
"""bool (n_rows, n_cols), C-contiguous, indexed [row, col], row 0 at the top of the image."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteGrid:
    """A rhombic grid of sites, spanned by a1 (along a row) and a2 (from row to row).

    On the triangular lattice a1 = a (1, 0) and a2 = a (1/2, +-sqrt(3)/2); on the
    square lattice a2 = a (0, 1). Positions are in the atom plane, x to the right
    and y down the image, with the grid's centre at the origin, so that row 0 is
    at the top of the image. The default is the paper's base array (Tian et al.,
    "Experimental Setup").

    Attributes:
        n_rows: Number of rows.
        n_cols: Number of columns.
        spacing_m: Distance a between neighbours, in metres.
        lattice: "triangular" or "square".
        shear: +1 if rows shift to the right on the way down the image, -1 if to
            the left. The wrong sign makes 120 degrees out of 60.
        row_frequency_hz: Frequency of the mobile tweezers' tone at each row, float64 (n_rows,), equally
            spaced or from a calibration.
        column_frequency_hz: The same for each column, float64 (n_cols,).
        positions_m: float64 (n_rows, n_cols, 2), (x, y) of each site, derived from the others.
    """

    n_rows: int = 20
    n_cols: int = 20
    spacing_m: float = 4.49e-6
    lattice: Literal["triangular", "square"] = "triangular"
    shear: Literal[1, -1] = 1
    row_frequency_hz: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    column_frequency_hz: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    positions_m: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        if self.n_rows < 1 or self.n_cols < 1:
            raise ValueError(f"a grid has at least 1 x 1 sites, not {self.n_rows} x {self.n_cols}")
        if not self.spacing_m > 0:
            raise ValueError(f"the spacing is {self.spacing_m} m; expected more than 0")
        set_field = object.__setattr__
        for name, n in (("row_frequency_hz", self.n_rows), ("column_frequency_hz", self.n_cols)):
            values = getattr(self, name)
            if len(values) == 0:
                values = centred_comb(n)
            set_field(self, name, read_only(values, np.float64, (n,), name))
        set_field(self, "positions_m", read_only(self._positions(), np.float64, (-1, -1, 2), "positions_m"))

    @property
    def shape(self) -> tuple[int, int]:
        """(n_rows, n_cols)."""
        return self.n_rows, self.n_cols

    @property
    def axes(self) -> NDArray[np.float64]:
        """a1 and a2 in metres, float64 (2, 2): ``axes[0]`` along a row, ``axes[1]`` row to row."""
        if self.lattice == "square":
            unit = np.array([[1.0, 0.0], [0.0, 1.0]])
        else:
            unit = np.array([[1.0, 0.0], [0.5 * self.shear, np.sqrt(3.0) / 2.0]])
        return self.spacing_m * unit

    def _positions(self) -> NDArray[np.float64]:
        rows = np.arange(self.n_rows) - (self.n_rows - 1) / 2
        cols = np.arange(self.n_cols) - (self.n_cols - 1) / 2
        a1, a2 = self.axes
        return cols[None, :, None] * a1 + rows[:, None, None] * a2


def centred_comb(n_sites: int, centre_hz: float = 100e6, step_hz: float = 1.6e6) -> NDArray[np.float64]:
    """Equally spaced tone frequencies around the AOD's centre.

    The defaults keep 20 sites and an ejection slot on each side within the band
    of about 36 MHz around 100 MHz of the mobile tweezers' AOD.

    Returns:
        float64 (n_sites,), in Hz.

    Example:
        >>> centred_comb(3).tolist()
        [98400000.0, 100000000.0, 101600000.0]
    """
    sites = np.arange(n_sites, dtype=np.float64)
    return centre_hz + step_hz * (sites - (n_sites - 1) / 2)


class FrequencyComb(Settings):
    """Tones of the rows or columns of the grid, equally spaced or from a table of a calibration."""

    centre: Frequency = Field(default=100e6, gt=0, description="frequency of the grid's centre")
    step: Frequency = Field(
        default=1.6e6, description="frequency step from one row or column to the next, negative if it falls"
    )
    table: tuple[Annotated[Frequency, Field(gt=0)], ...] = Field(
        default=(), description="calibrated frequency of each row or column, instead of centre and step"
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
            raise ValueError("the tones neither rise nor fall throughout; expected the order of the sites")
        return table

    def tones(self, n_sites: int) -> NDArray[np.float64]:
        """Frequency of the tone of each of ``n_sites`` rows or columns, in Hz."""
        return np.array(self.table) if self.table else centred_comb(n_sites, self.centre, self.step)


def axis_positions_m(n_sites: int, spacing_m: float) -> Floats:
    """Positions of the sites along an axis from the grid's centre, float64 (n_sites,).

    Example:
        >>> axis_positions_m(3, 4e-6).tolist()
        [-4e-06, 0.0, 4e-06]
    """
    sites = np.arange(n_sites, dtype=np.float64)
    return (sites - (n_sites - 1) / 2) * spacing_m


def mean_step_hz(site_hz: Floats, other_hz: Floats) -> float:
    """Mean step from tone to tone of an axis, in Hz. For a single tone, the step of the other axis."""
    for values in (site_hz, other_hz):
        if len(values) > 1:
            return float(values[-1] - values[0]) / (len(values) - 1)
    return 1.6e6  # the paper's step, for a grid of one site


@dataclass(frozen=True, slots=True, eq=False)
class TargetPattern:
    """The sites that must hold an atom, and the sites that must be empty.

    Attributes:
        fill: bool (n_rows, n_cols), sites that must hold an atom.
        clear: bool (n_rows, n_cols), sites that must be empty. All others are the reservoir, where atoms do
            no harm.
        name: Name in records and on the screen.
        regions: Named sets of sites, bool (n_rows, n_cols), for quantities. They require nothing.
    """

    fill: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    name: str = "target"
    regions: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict[str, NDArray[np.bool_]])

    def __post_init__(self) -> None:
        shape = np.shape(self.fill)
        object.__setattr__(self, "fill", read_only(self.fill, np.bool_, (-1, -1), "fill"))
        object.__setattr__(self, "clear", read_only(self.clear, np.bool_, shape, "clear"))
        if np.any(self.fill & self.clear):
            raise ValueError("a site cannot be in both fill and clear")

    @property
    def shape(self) -> tuple[int, int]:
        """(n_rows, n_cols)."""
        return self.fill.shape[0], self.fill.shape[1]

    @classmethod
    def none(cls, shape: tuple[int, int]) -> Self:
        """The target of a sequence without one: every site may hold an atom, and no shot is judged."""
        return cls(np.zeros(shape, np.bool_), np.zeros(shape, np.bool_), "none")

    @property
    def is_none(self) -> bool:
        """Whether the target requires nothing of any site."""
        return not (self.fill.any() or self.clear.any())

    @property
    def n_atoms(self) -> int:
        """Number of sites that must hold an atom."""
        return int(np.count_nonzero(self.fill))

    def n_defects(self, occupancy: NDArray[np.bool_]) -> int:
        """Number of empty target sites."""
        return int(np.count_nonzero(self.fill & ~occupancy))

    def n_surplus(self, occupancy: NDArray[np.bool_]) -> int:
        """Number of atoms on sites that must be empty."""
        return int(np.count_nonzero(self.clear & occupancy))

    def is_met_by(self, occupancy: NDArray[np.bool_]) -> bool:
        """Whether every fill site holds an atom and every clear site is empty."""
        return not np.any((self.fill & ~occupancy) | (self.clear & occupancy))

    def filling_fraction(self, occupancy: NDArray[np.bool_]) -> float:
        """Fraction of the fill sites that hold an atom (1.0 for a target without atoms)."""
        n_atoms = self.n_atoms
        return 1.0 - self.n_defects(occupancy) / n_atoms if n_atoms else 1.0


def as_occupancy(values: Any, shape: tuple[int, int] | None = None) -> Occupancy:
    """Read any array of zeros and ones as an occupancy.

    Args:
        values: Array or nested sequence of bool, 0 or 1, of shape (n_rows, n_cols).
        shape: The grid's (n_rows, n_cols), if it is known.

    Returns:
        A C-contiguous bool array, or ``values`` itself if it already is one.

    Raises:
        ValueError: The array is not two-dimensional, has another shape, or has values other than 0 and 1.

    Example:
        >>> as_occupancy([[1, 0], [0, 1]]).sum()
        np.int64(2)
    """
    array = np.asarray(values)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"an occupancy must have shape (n_rows, n_cols), not {array.shape}")
    if shape is not None and array.shape != shape:
        raise ValueError(f"the occupancy has shape {array.shape}, but the grid has {shape}")
    if array.dtype != np.bool_:
        as_bool = array.astype(np.bool_)
        if not np.array_equal(as_bool, array):
            raise ValueError("an occupancy may only contain 0 and 1 (False and True)")
        array = as_bool
    return np.ascontiguousarray(array)


def read_only(values: Any, dtype: DTypeLike, shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """Make a read-only, C-contiguous array of a given dtype and shape.

    A read-only array that already fits is returned as it is. Anything else is copied, so that the caller's
    array is neither frozen nor shared.

    Args:
        values: Array or nested sequence.
        dtype: Required dtype. The conversion must not change values.
        shape: Required shape. -1 means any length.
        name: Field name for the error message.

    Raises:
        ValueError: The shape is wrong, or the dtype cannot represent the values.
    """
    wanted = np.dtype(dtype)
    array: NDArray[Any] = np.asarray(values)
    is_ready = array.dtype == wanted and _fits(array.shape, shape)
    if is_ready and array.flags.c_contiguous and not array.flags.writeable:
        return array
    copy = array.astype(wanted, order="C")
    if array.dtype != wanted and not np.array_equal(copy, array):
        raise ValueError(f"{name} has values that {wanted} cannot represent")
    if copy.size == 0 and 0 not in shape and copy.ndim != len(shape):  # [] for no rows of several columns
        copy = copy.reshape(tuple(0 if n == -1 else n for n in shape))
    if not _fits(copy.shape, shape):
        wanted_text = "(" + ", ".join("n" if n == -1 else str(n) for n in shape) + ")"
        raise ValueError(f"{name} has shape {copy.shape}; expected {wanted_text}")
    copy.flags.writeable = False
    return copy


def _fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    if shape == wanted or len(shape) != len(wanted):
        return shape == wanted
    for have, want in zip(shape, wanted, strict=True):  # noqa: SIM110 - all() takes three times as long
        if want not in (-1, have):
            return False
    return True
