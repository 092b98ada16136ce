"""The patterns, their settings and the contract."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import labseq_patterns
import labseq_rivals
import numpy as np
import pytest
from labseq_patterns import patterns
from labseq_patterns.patterns import BlockSettings, RingSettings, SierpinskiSettings
from labseq_rivals.interleaved import InterleavedSettings, interleaved
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

import labseq
import labseq.builtin
from labseq import ConfigError, LimitError, SiteGrid, TargetPattern
from labseq.builtin.patterns import BitmapSettings, CompactSettings, bitmap, compact
from labseq.registry import Registry
from labseq.testing import PatternContract

MADE: dict[str, tuple[Callable[[Any, SiteGrid], TargetPattern], type[BaseModel], dict[str, Any]]] = {
    "compact": (compact, CompactSettings, {"rows": 5, "cols": 6}),
    "bitmap": (bitmap, BitmapSettings, {"sites": ".#.\n###"}),
    "kagome": (patterns.kagome, BlockSettings, {"rows": 7, "cols": 8}),
    "link_kagome": (patterns.link_kagome, BlockSettings, {"rows": 7, "cols": 8}),
    "honeycomb": (patterns.honeycomb, BlockSettings, {"rows": 7, "cols": 8}),
    "checkerboard": (patterns.checkerboard, BlockSettings, {"rows": 7, "cols": 8}),
    "sierpinski": (patterns.sierpinski, SierpinskiSettings, {"order": 3}),
    "ring": (patterns.ring, RingSettings, {"radius": 4}),
    "interleaved": (interleaved, InterleavedSettings, {"rows": 6, "cols": 6}),
}
"""Each pattern's function, its settings, and values for the contract."""


def make(name: str, grid: SiteGrid | None = None, **values: Any) -> TargetPattern:
    function, model, _ = MADE[name]
    return function(model.model_validate(values), grid or SiteGrid())


@pytest.mark.parametrize("name", MADE)
class TestPatterns(PatternContract):
    @pytest.fixture
    def factory(self, name: str) -> Callable[[SiteGrid], TargetPattern]:
        return partial(make, name, **MADE[name][2])


def test_every_pattern_is_tested() -> None:
    registry = Registry()
    modules: tuple[Any, ...] = (labseq.builtin, labseq_patterns, labseq_rivals)
    for module in modules:
        module.labseq_register(registry)
    assert {*registry.names("pattern")} == {*MADE}


TRIANGULAR = ("honeycomb", "kagome", "link_kagome")
ANYWHERE = ("checkerboard", "ring", "sierpinski")
BOTH_SHEARS = pytest.mark.parametrize("shear", [1, -1])
A_BLOCK: dict[str, Any] = {"rows": 16, "cols": 16}


def positions(target: TargetPattern, grid: SiteGrid) -> NDArray[np.float64]:
    """Where the atoms are, float64 (n, 2), in units of the spacing."""
    return grid.positions_m[target.fill] / grid.spacing_m


def neighbours(target: TargetPattern, grid: SiteGrid, distance: float) -> NDArray[np.intp]:
    """How many other atoms each atom has at a distance, int (n,), in the order of the sites."""
    places = positions(target, grid)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return np.count_nonzero(np.isclose(apart, distance), axis=1)


def in_bulk(target: TargetPattern, margin: int) -> NDArray[np.bool_]:
    """Which atoms, in the order of the sites, lie that many lines within the block, bool (n,)."""
    box = np.argwhere(target.fill | target.clear)
    sites = np.argwhere(target.fill)
    return ((sites >= box.min(axis=0) + margin) & (sites <= box.max(axis=0) - margin)).all(axis=1)


def as_points(places: NDArray[np.float64]) -> Counter[tuple[float, float]]:
    return Counter((round(float(x), 6) + 0.0, round(float(y), 6) + 0.0) for x, y in places)


def turned(places: NDArray[np.float64], angle_deg: float) -> NDArray[np.float64]:
    """Positions, turned about their centre."""
    angle, centre = np.deg2rad(angle_deg), places.mean(axis=0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return (places - centre) @ turn + centre


@BOTH_SHEARS
@pytest.mark.parametrize(("name", "expected"), [("compact", 6), ("kagome", 4), ("honeycomb", 3)])
def test_nearest_neighbours_in_the_bulk(name: str, expected: int, shear: Literal[1, -1]) -> None:
    grid = SiteGrid(shear=shear)
    target = make(name, grid, **A_BLOCK)
    bulk = in_bulk(target, 1)
    assert np.count_nonzero(bulk) > 100
    assert (neighbours(target, grid, 1)[bulk] == expected).all()


@pytest.mark.parametrize(
    ("name", "settings", "n_atoms"),
    [
        ("kagome", {"rows": 16, "cols": 16}, 192),
        ("kagome", {"rows": 17, "cols": 17}, 225),
        ("honeycomb", {"rows": 15, "cols": 15}, 150),
        ("link_kagome", {"rows": 16, "cols": 16}, 96),
        ("link_kagome", {"rows": 17, "cols": 17}, 112),
        ("checkerboard", {"rows": 15, "cols": 15}, 113),
        ("sierpinski", {"order": 0}, 1),
        ("sierpinski", {"order": 4}, 81),
        ("sierpinski", {"rows": 8, "cols": 16}, 27),
        ("ring", {"radius": 1, "width": 1}, 6),
        ("ring", {"radius": 2, "width": 1}, 12),
        ("ring", {"radius": 0}, 1),
    ],
)
@BOTH_SHEARS
def test_numbers_of_atoms(name: str, settings: dict[str, Any], n_atoms: int, shear: Literal[1, -1]) -> None:
    assert make(name, SiteGrid(shear=shear), **settings).n_atoms == n_atoms


@pytest.mark.parametrize(
    ("name", "settings", "n_atoms"),
    [
        ("checkerboard", {"rows": 14, "cols": 16}, 112),
        ("sierpinski", {"order": 4}, 81),
        ("ring", {"radius": 3, "width": 1}, 16),
    ],
)
def test_numbers_of_atoms_on_a_square_grid(name: str, settings: dict[str, Any], n_atoms: int) -> None:
    target = make(name, SiteGrid(lattice="square"), **settings)
    assert target.n_atoms == n_atoms


def test_a_sierpinski_triangle_holds_three_of_the_order_below() -> None:
    grid = SiteGrid(lattice="square")
    large, small = (make("sierpinski", grid, order=n, origin=(0, 0)).fill for n in (4, 3))
    for row, col in ((0, 0), (8, 0), (8, 8)):
        assert (large[row : row + 8, col : col + 8] == small[:8, :8]).all()
    assert not large[:8, 8:].any()


@pytest.mark.parametrize("lattice", ["triangular", "square"])
@pytest.mark.parametrize(("radius", "width"), [(1.0, 1.0), (2.5, 2.0), (6.9, 1.0), (7.0, 30.0)])
@BOTH_SHEARS
def test_a_ring_is_round_and_whole(
    lattice: Literal["triangular", "square"], radius: float, width: float, shear: Literal[1, -1]
) -> None:
    grid = SiteGrid(19, 19, lattice=lattice, shear=shear)
    target = make("ring", grid, radius=radius, width=width)
    distance = np.linalg.norm(grid.positions_m / grid.spacing_m, axis=-1)
    assert (target.fill == ((distance <= radius + 1e-9) & (distance > radius - width + 1e-9))).all()
    places = positions(target, grid)
    assert as_points(turned(places, 60 if lattice == "triangular" else 90)) == as_points(places)


@pytest.mark.parametrize("name", [*TRIANGULAR, *ANYWHERE])
def test_the_rest_of_the_block_is_cleared_or_left_to_the_reservoir(name: str) -> None:
    target = make(name, rows=9, cols=7, origin=(3, 4))
    block = np.zeros((20, 20), np.bool_)
    block[3:12, 4:11] = True
    assert ((target.fill | target.clear) == block).all()
    left = make(name, rows=9, cols=7, origin=(3, 4), clear="none")
    assert (left.fill == target.fill).all()
    assert not left.clear.any()


@pytest.mark.parametrize("name", [*TRIANGULAR, *ANYWHERE])
def test_an_origin_only_shifts_the_pattern(name: str) -> None:
    centred = make(name, rows=9, cols=7)
    for row, col in ((0, 0), (11, 13), (6, 2)):
        moved = make(name, rows=9, cols=7, origin=(row, col))
        shift = (row - 5, col - 6)
        assert (np.roll(centred.fill, shift, (0, 1)) == moved.fill).all()
        assert (np.roll(centred.clear, shift, (0, 1)) == moved.clear).all()


@pytest.mark.parametrize(("name", "settings"), [("sierpinski", {"order": 5}), ("ring", {"radius": 10})])
def test_a_size_in_one_number_must_fit_too(name: str, settings: dict[str, Any]) -> None:
    with pytest.raises(LimitError, match="the size of the target"):
        make(name, **settings)


def test_a_block_too_small_for_an_atom_is_refused() -> None:
    with pytest.raises(LimitError, match="choose a larger target"):
        make("honeycomb", rows=1, cols=1)


@pytest.mark.parametrize("name", TRIANGULAR)
def test_a_diluted_triangular_lattice_needs_a_triangular_grid(name: str) -> None:
    with pytest.raises(ConfigError, match=f"'{name}' .*lattice: triangular"):
        make(name, SiteGrid(lattice="square"), rows=9, cols=9)


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        (BlockSettings, {"rows": 3, "cols": 3, "origin": (-1, 0)}, "greater than or equal to 0"),
        (SierpinskiSettings, {}, "the size is missing, .*'order'"),
        (SierpinskiSettings, {"rows": 3}, "the size is missing"),
        (SierpinskiSettings, {"order": 3, "rows": 3}, "two sizes are given"),
        (RingSettings, {"width": 2}, "expected either 'radius', or 'rows' and 'cols'"),
        (RingSettings, {"radius": 3, "rows": 5, "cols": 5}, "two sizes are given"),
    ],
)
def test_wrong_settings_are_refused(model: type[BaseModel], values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        model.model_validate(values)


SEQUENCE = """
labseq: 1
name: any pattern
profile: virtual
shots: 1
target: {target}
shot:
  - load: {{duration: 500 ms}}
  - image: {{exposure: 45 ms}}
"""


def test_a_sequence_names_a_pattern(tmp_path: Path) -> None:
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target="{pattern: link_kagome, rows: 9, cols: 7, origin: [2, 3]}"))
    target = labseq.Session.open(sequence).assembly.target
    expected = make("link_kagome", rows=9, cols=7, origin=(2, 3))
    assert target.name == expected.name == "link-kagome 9 x 7"
    assert (target.fill == expected.fill).all()
    assert (target.clear == expected.clear).all()


def test_a_pattern_that_does_not_suit_the_profile_is_an_error_with_its_place(tmp_path: Path) -> None:
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target="{pattern: kagome, rows: 9, cols: 9}"))
    with pytest.raises(ConfigError, match=r"sequence\.yaml:6:9: the pattern 'kagome' dilutes"):
        labseq.Session.open(sequence, overrides=["profile.grid.lattice=square"])
