"""What a target pattern promises."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np
import pytest

from labseq.errors import LabseqError
from labseq.model import SiteGrid, TargetPattern
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import (
    ContractViolation,
    doing,
    format_error,
    no_factory,
    promise,
    refusal,
)

PatternFactory: TypeAlias = Callable[[SiteGrid], TargetPattern]

FITS: Final = "it makes a TargetPattern of the grid's shape"


class PatternContract:
    """Promises of a target pattern; provide the fixture ``factory``, a function of the grid.

    Attributes:
        grids: Grids that it fits on with the settings of the test.
        too_small: A grid that it does not fit on; None if it fits on any.
    """

    grids: ClassVar[Sequence[SiteGrid]] = (SiteGrid(), SiteGrid(17, 23, shear=-1))
    too_small: ClassVar[SiteGrid | None] = SiteGrid(1, 1)

    @pytest.fixture
    def factory(self) -> PatternFactory:
        """Makes the target, given a grid; provided by the plugin's test."""
        no_factory(self, "grid -> target")

    @promise(FITS)
    def test_fits_the_grid(self, factory: PatternFactory) -> None:
        """On each of ``grids``."""
        for grid in self.grids:
            _target_of(factory, grid)

    @promise("at least one site must hold an atom")
    def test_wants_atoms(self, factory: PatternFactory) -> None:
        """A pattern without atoms is met by doing nothing."""
        for grid in self.grids:
            assert _target_of(factory, grid).n_atoms > 0, f"on {_called(grid)} it wants none"

    @promise("the same grid gives the same target")
    def test_same_grid_same_target(self, factory: PatternFactory) -> None:
        """Again, and after other grids: a run that is resumed fills the same target."""
        first = [_target_of(factory, grid) for grid in self.grids]
        for grid, target in zip(self.grids, first, strict=True):
            again = _target_of(factory, grid)
            for name in ("fill", "clear"):
                same = np.array_equal(getattr(target, name), getattr(again, name))
                assert same, f"on {_called(grid)} {name} is another the second time"
            assert target.name == again.name, f"it is called '{target.name}', then '{again.name}'"

    @promise("a grid that it does not fit on raises LabseqError")
    def test_refuses_small_grids(self, factory: PatternFactory) -> None:
        """``labseq check`` says so beforehand; a target that is cut off is another one."""
        if self.too_small is not None:
            refusal(LabseqError, _called(self.too_small), factory, self.too_small)

    @promise("it is pure: no I/O, nothing changed that all code shares")
    def test_is_pure(self, factory: PatternFactory) -> None:
        """``labseq check`` makes it too; other plugins draw from the global random numbers."""
        with doing("the first target"):
            factory(self.grids[0])  # may compile
        with quietly():
            factory(self.grids[0])


def _target_of(factory: PatternFactory, grid: SiteGrid) -> TargetPattern:
    try:
        target: Any = factory(grid)
    except Exception as error:
        raise ContractViolation(FITS, f"on {_called(grid)} it {format_error(error)}") from error
    if not isinstance(target, TargetPattern):
        raise ContractViolation(FITS, f"it made a {type(target).__name__}")
    if target.shape != grid.shape:
        raise ContractViolation(FITS, f"on {_called(grid)} it made one of {target.shape}")
    return target


def _called(grid: SiteGrid) -> str:
    return f"a {grid.lattice} grid of {grid.n_rows} x {grid.n_cols}"
