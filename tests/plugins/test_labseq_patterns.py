"""The patterns, their settings and the contract."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings as hypothesis_settings, strategies as st
from labseq_patterns import (
    patterns as checkerboard,
    patterns as honeycomb,
    patterns as kagome,
    patterns as ring,
    patterns as settings,
    patterns as sierpinski,
)
from labseq_patterns.patterns import BlockSettings, RingSettings, SierpinskiSettings
from labseq_scans.pattern import InterleavedSettings, interleaved
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

import labseq
from labseq import ConfigError, LimitError, SiteGrid, TargetPattern, make_target
from labseq.builtin.patterns import BitmapSettings, CompactSettings, bitmap, compact
from labseq.testing import PatternContract

BLOCK = settings.BlockSettings(rows=7, cols=8)

PATTERNS: dict[str, Callable[[SiteGrid], TargetPattern]] = {
    "compact": partial(compact, CompactSettings(rows=5, cols=6)),
    "bitmap": partial(bitmap, BitmapSettings(sites=".#.\n###")),
    "kagome": partial(kagome.kagome, BLOCK),
    "link_kagome": partial(kagome.link_kagome, BLOCK),
    "honeycomb": partial(honeycomb.honeycomb, BLOCK),
    "checkerboard": partial(checkerboard.checkerboard, BLOCK),
    "sierpinski": partial(sierpinski.sierpinski, settings.SierpinskiSettings(order=3)),
    "ring": partial(ring.ring, settings.RingSettings(radius=4)),
    "interleaved": partial(interleaved, InterleavedSettings(rows=6, cols=6)),
}


@pytest.mark.parametrize("name", PATTERNS)
class TestPatterns(PatternContract):
    @pytest.fixture
    def factory(self, name: str) -> Callable[[SiteGrid], TargetPattern]:
        return PATTERNS[name]


def test_every_pattern_is_held_to_them() -> None:
    import labseq_patterns
    import labseq_scans

    import labseq.builtin
    from labseq.registry import Registry

    registry, modules = Registry(), (labseq.builtin, labseq_patterns, labseq_scans)
    for module in modules:
        plugin: Any = module
        plugin.labseq_register(registry)
    assert {*registry.names("pattern")} == {*PATTERNS}


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
    target = make_target(name, grid=grid, **A_BLOCK)
    bulk = in_bulk(target, 1)
    assert np.count_nonzero(bulk) > 100
    assert (neighbours(target, grid, 1)[bulk] == expected).all()


@BOTH_SHEARS
def test_a_link_of_the_kagome_lattice_has_six_links_at_its_ends(shear: Literal[1, -1]) -> None:
    grid = SiteGrid(shear=shear)
    target = make_target("link_kagome", grid=grid, **A_BLOCK)
    bulk = in_bulk(target, 2)
    for distance in (1, np.sqrt(3), 2):
        assert (neighbours(target, grid, distance)[bulk] == 2).all()


@BOTH_SHEARS
def test_links_lie_halfway_between_neighbours_of_a_kagome_lattice(shear: Literal[1, -1]) -> None:
    grid = SiteGrid(17, 17, shear=shear)
    links = positions(make_target("link_kagome", grid=grid, rows=17, cols=17), grid)
    coarse = SiteGrid(9, 9, shear=shear)
    ends = 2 * positions(make_target("kagome", grid=coarse, rows=9, cols=9), coarse)
    pairs = [(a, b) for i, a in enumerate(ends) for b in ends[:i] if np.isclose(np.linalg.norm(a - b), 2)]
    assert as_points(links) == as_points(np.array([(a + b) / 2 for a, b in pairs]))


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
    assert make_target(name, grid=SiteGrid(shear=shear), **settings).n_atoms == n_atoms


@pytest.mark.parametrize(
    ("name", "settings", "n_atoms"),
    [
        ("checkerboard", {"rows": 14, "cols": 16}, 112),
        ("sierpinski", {"order": 4}, 81),
        ("ring", {"radius": 3, "width": 1}, 16),
    ],
)
def test_numbers_of_atoms_on_a_square_grid(name: str, settings: dict[str, Any], n_atoms: int) -> None:
    target = make_target(name, grid=SiteGrid(lattice="square"), **settings)
    assert target.n_atoms == n_atoms


@pytest.mark.parametrize("name", [*TRIANGULAR, "sierpinski", "ring"])
@given(rows=st.integers(3, 16), cols=st.integers(3, 16))
@hypothesis_settings(max_examples=6, deadline=None)
def test_the_other_shear_makes_the_mirror_image(name: str, rows: int, cols: int) -> None:
    there, here = (SiteGrid(16, 16, shear=shear) for shear in (1, -1))
    settings: dict[str, Any] = {"rows": rows, "cols": cols, "origin": (0, 0)}
    mirrored: dict[str, Any] = settings | {"origin": (0, 16 - cols)}
    left = positions(make_target(name, grid=there, **settings), there) * (-1, 1)
    assert as_points(left) == as_points(positions(make_target(name, grid=here, **mirrored), here))


@pytest.mark.parametrize("size", [n for n in range(3, 20) if n % 3 < 2])
@BOTH_SHEARS
def test_no_atom_of_a_honeycomb_hangs_on_by_one_neighbour(size: int, shear: Literal[1, -1]) -> None:
    grid = SiteGrid(shear=shear)
    target = make_target("honeycomb", grid=grid, rows=size, cols=size)
    assert neighbours(target, grid, 1).min() == 2


@pytest.mark.parametrize("order", range(5))
@BOTH_SHEARS
def test_a_sierpinski_triangle_looks_the_same_from_each_corner(order: int, shear: Literal[1, -1]) -> None:
    grid = SiteGrid(shear=shear)
    places = positions(make_target("sierpinski", grid=grid, order=order), grid)
    assert as_points(turned(places, 120)) == as_points(places)
    assert np.count_nonzero(places[:, 1] == places[:, 1].min()) == 1
    assert np.count_nonzero(places[:, 1] == places[:, 1].max()) == 2**order


def test_a_sierpinski_triangle_holds_three_of_the_order_below() -> None:
    grid = SiteGrid(lattice="square")
    large, small = (make_target("sierpinski", grid=grid, order=n, origin=(0, 0)).fill for n in (4, 3))
    for row, col in ((0, 0), (8, 0), (8, 8)):
        assert (large[row : row + 8, col : col + 8] == small[:8, :8]).all()
    assert not large[:8, 8:].any()


@pytest.mark.parametrize("lattice", ["triangular", "square"])
@pytest.mark.parametrize("radius", [1.0, 2.5, 4.0, 6.9, 7.0])
@pytest.mark.parametrize("width", [1.0, 2.0, 30.0])
@BOTH_SHEARS
def test_a_ring_is_round_and_whole(
    lattice: Literal["triangular", "square"], radius: float, width: float, shear: Literal[1, -1]
) -> None:
    grid = SiteGrid(19, 19, lattice=lattice, shear=shear)
    target = make_target("ring", grid=grid, radius=radius, width=width)
    distance = np.linalg.norm(grid.positions_m / grid.spacing_m, axis=-1)
    assert (target.fill == ((distance <= radius + 1e-9) & (distance > radius - width + 1e-9))).all()
    places = positions(target, grid)
    assert as_points(turned(places, 60 if lattice == "triangular" else 90)) == as_points(places)


@pytest.mark.parametrize(("rows", "cols"), [(15, 15), (12, 15), (15, 12)])
def test_a_ring_fills_its_block(rows: int, cols: int) -> None:
    grid = SiteGrid(lattice="square")
    sites = np.argwhere(make_target("ring", grid=grid, rows=rows, cols=cols).fill)
    height, width = np.ptp(sites, axis=0) + 1
    assert max(height, width) == min(rows, cols)


@pytest.mark.parametrize("name", [*TRIANGULAR, *ANYWHERE])
def test_the_rest_of_the_block_is_cleared_or_left_to_the_reservoir(name: str) -> None:
    target = make_target(name, rows=9, cols=7, origin=(3, 4))
    block = np.zeros((20, 20), np.bool_)
    block[3:12, 4:11] = True
    assert ((target.fill | target.clear) == block).all()
    left = make_target(name, rows=9, cols=7, origin=(3, 4), clear="none")
    assert (left.fill == target.fill).all()
    assert not left.clear.any()


@pytest.mark.parametrize("name", [*TRIANGULAR, *ANYWHERE])
@given(row=st.integers(0, 11), col=st.integers(0, 13))
@hypothesis_settings(max_examples=6, deadline=None)
def test_an_origin_only_shifts_the_pattern(name: str, row: int, col: int) -> None:
    centred = make_target(name, rows=9, cols=7)
    moved = make_target(name, rows=9, cols=7, origin=(row, col))
    shift = (row - 5, col - 6)
    assert (np.roll(centred.fill, shift, (0, 1)) == moved.fill).all()
    assert (np.roll(centred.clear, shift, (0, 1)) == moved.clear).all()


@pytest.mark.parametrize("name", [*TRIANGULAR, *ANYWHERE])
def test_what_does_not_fit_is_refused(name: str) -> None:
    with pytest.raises(
        LimitError, match=r"21 rows x 9 columns; the limit is the grid of 20 rows x 20 columns"
    ):
        make_target(name, rows=21, cols=9)
    with pytest.raises(LimitError, match=r"rows 0 to 11 and columns 0 to 13 on a grid of 20 x 20"):
        make_target(name, rows=9, cols=7, origin=(12, 0))


@pytest.mark.parametrize(("name", "settings"), [("sierpinski", {"order": 5}), ("ring", {"radius": 10})])
def test_a_size_in_one_number_must_fit_too(name: str, settings: dict[str, Any]) -> None:
    with pytest.raises(LimitError, match="the size of the target"):
        make_target(name, **settings)


@pytest.mark.parametrize("name", ["honeycomb", "link_kagome"])
def test_a_block_too_small_for_an_atom_is_refused(name: str) -> None:
    with pytest.raises(LimitError, match="choose a larger target"):
        make_target(name, rows=1, cols=1)


@pytest.mark.parametrize("name", TRIANGULAR)
def test_a_diluted_triangular_lattice_needs_a_triangular_grid(name: str) -> None:
    with pytest.raises(
        ConfigError, match=f"'{name}' dilutes a triangular lattice, and the grid is square"
    ) as no:
        make_target(name, grid=SiteGrid(lattice="square"), rows=9, cols=9)
    assert "lattice: triangular" in str(no.value)


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        (BlockSettings, {"rows": 3}, "cols"),
        (BlockSettings, {"rows": 0, "cols": 3}, "greater than or equal to 1"),
        (BlockSettings, {"rows": 3, "cols": 3, "origin": (-1, 0)}, "greater than or equal to 0"),
        (BlockSettings, {"rows": 3, "cols": 3, "clear": "all"}, "bounding_box"),
        (BlockSettings, {"rows": 3, "cols": 3, "size": 3}, "Extra inputs"),
        (SierpinskiSettings, {}, "the size is missing, or half of it; expected either 'order'"),
        (SierpinskiSettings, {"rows": 3}, "the size is missing, or half of it"),
        (SierpinskiSettings, {"order": 3, "rows": 3}, "two sizes are given"),
        (SierpinskiSettings, {"order": 13}, "less than or equal to 12"),
        (RingSettings, {"width": 2}, "expected either 'radius', or 'rows' and 'cols'"),
        (RingSettings, {"radius": 3, "rows": 5, "cols": 5}, "two sizes are given"),
        (RingSettings, {"radius": -1}, "greater than or equal to 0"),
        (RingSettings, {"radius": 3, "width": 0.5}, "greater than or equal to 1"),
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


@pytest.mark.parametrize("name", [*TRIANGULAR, *ANYWHERE])
def test_a_sequence_names_a_pattern(name: str, tmp_path: Path) -> None:
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target=f"{{pattern: {name}, rows: 9, cols: 7, origin: [2, 3]}}"))
    target = labseq.Session.open(sequence).assembly.target
    expected = make_target(name, rows=9, cols=7, origin=(2, 3))
    assert (target.name, expected.name) == (f"{name.replace('_', '-')} 9 x 7",) * 2
    assert (target.fill == expected.fill).all()
    assert (target.clear == expected.clear).all()


def test_a_pattern_that_does_not_suit_the_profile_is_an_error_with_its_place(tmp_path: Path) -> None:
    sequence = tmp_path / "sequence.yaml"
    sequence.write_text(SEQUENCE.format(target="{pattern: kagome, rows: 9, cols: 9}"))
    with pytest.raises(ConfigError, match=r"sequence\.yaml:6:9: the pattern 'kagome' dilutes"):
        labseq.Session.open(sequence, overrides=["profile.grid.lattice=square"])
