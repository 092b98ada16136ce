"""The lattice on averaged frames."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray

from labseq.detection.lattice import FoundLattice, find_lattice
from labseq.errors import DeviceError
from labseq.model import SiteGrid

from .drawn import drawn, seen_sites

Floats = NDArray[np.float64]

GRID = SiteGrid()
SMALL = SiteGrid(9, 8)
SHAPE = (512, 512)
MIDDLE = (250.3, 258.7)


def furthest(found: FoundLattice, sites: Floats) -> float:
    return float(np.hypot(*np.moveaxis(found.positions_px - sites, -1, 0)).max())


def small_frame(seed: int = 0, grid: SiteGrid = SMALL, **kwargs: Any) -> Floats:
    sites = seen_sites(grid, 10.0, centre=(70.0, 80.0))
    return drawn(sites, (140, 160), 1.2, np.random.default_rng(seed), **kwargs)


@settings(max_examples=4)
@given(
    seed=st.integers(0, 2**32 - 1),
    spacing=st.floats(6, 16),
    fine=st.floats(0.0, 1.0),
    angle=st.floats(-10, 10),
    stretch=st.floats(0.91, 1.1),
    shear=st.floats(-0.03, 0.03),
    barrel=st.floats(-0.03, 0.03),
    place=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    loading=st.floats(0.5, 0.75),
    lattice=st.sampled_from(["triangular", "square"]),
    sign=st.sampled_from([1, -1]),
)
def test_any_lattice_is_found_wherever_it_lies(
    seed: int,
    spacing: float,
    fine: float,
    angle: float,
    stretch: float,
    shear: float,
    barrel: float,
    place: tuple[float, float],
    loading: float,
    lattice: Literal["triangular", "square"],
    sign: Literal[1, -1],
) -> None:
    grid = SiteGrid(12, 10, lattice=lattice, shear=sign)
    width = 0.6 + fine * (min(spacing / 4, 3.0) - 0.6)
    sites = seen_sites(grid, spacing, angle, stretch, shear, barrel)
    low = sites.min(axis=(0, 1)) - 3 * width - 1
    size = sites.max(axis=(0, 1)) + 3 * width + 1 - low
    shape = int(size[0] + 40), int(size[1] + 30)
    sites = sites - low + np.array(place) * (np.array(shape) - 1 - size)
    image = drawn(sites, shape, width, np.random.default_rng(seed), loading=loading, photoelectrons=200.0)
    found = find_lattice(image.astype(np.float32), grid)
    assert furthest(found, sites) < 0.05 + 0.1 * width


def test_the_lattice_is_described_in_the_grids_terms() -> None:
    sites = seen_sites(GRID, 12.8, 3.0, 1.08, centre=MIDDLE)
    found = find_lattice(drawn(sites, SHAPE, 1.2, np.random.default_rng(1)), GRID)
    assert found.frame == SHAPE
    assert np.rad2deg(found.angle_rad) == pytest.approx(3.0, abs=0.02)
    assert found.stretch == pytest.approx(1.08, abs=0.001)
    assert found.pixel_size_m == pytest.approx(4.49e-6 / 12.8, rel=1e-3)
    assert found.spacing_px[0] == pytest.approx(12.8 * np.sqrt(1.08), rel=1e-3)
    assert found.found.all()
    assert np.isfinite(found.residuals_px).all()


def test_dark_sites_get_the_place_of_the_lattice() -> None:
    sites = seen_sites(SMALL, 10.0, centre=(70.0, 80.0))
    found = find_lattice(small_frame(dead=7), SMALL)
    assert found.n_sites_found == 65
    assert furthest(found, sites) < 0.1
    assert (np.isnan(found.residuals_px).any(axis=-1) == ~found.found).all()


def test_touching_spots_do_not_draw_one_another() -> None:
    sites = seen_sites(SMALL, 6.0, 4.0, centre=(60.0, 60.0))
    image = drawn(sites, (120, 120), 1.7, np.random.default_rng(2), photoelectrons=6000.0)
    found = find_lattice(image, SMALL)
    assert furthest(found, sites) < 0.03
    assert found.spot_px == pytest.approx(1.7, abs=0.02)


def test_spots_at_the_edge_of_the_frame_are_not_drawn_inwards() -> None:
    sites = seen_sites(SMALL, 10.0)
    sites -= sites.min(axis=(0, 1)) - 1.0
    shape = int(sites[..., 0].max() + 2), int(sites[..., 1].max() + 2)
    image = drawn(sites, shape, 1.2, np.random.default_rng(3), photoelectrons=2000.0)
    assert furthest(find_lattice(image, SMALL), sites) < 0.05


def test_a_single_frame_of_many_atoms_is_enough_for_a_rough_lattice() -> None:
    sites = seen_sites(GRID, 12.8, 2.0, 1.1, centre=MIDDLE)
    image = drawn(sites, SHAPE, 1.2, np.random.default_rng(4), n_frames=1).clip(0, 65535).astype(np.uint16)
    found = find_lattice(image, GRID)
    assert furthest(found, sites) < 0.5
    assert 180 < found.n_sites_found < 300


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((64, 64)), "0 spots found of 72"),
        (np.full((64, 64), 500.0), "0 spots found of 72"),
        (np.random.default_rng(0).normal(500, 10, (300, 300)), "spots found of 72"),
        (np.full((64, 64), 65535, np.uint16), "4096 pixels of the frame are saturated"),
        (np.minimum(small_frame(), 540.0), "pixels of the frame are saturated"),
        (np.full((64, 64), np.nan), "expected finite numbers"),
        (np.zeros((4, 64)), "16 pixels or more"),
        (np.zeros((64, 64, 3)), r"\(64, 64, 3\)"),
    ],
)
def test_frames_without_a_lattice_say_why(image: NDArray[Any], reason: str) -> None:
    with pytest.raises(DeviceError, match=f"camera: no lattice found: .*{reason}"):
        find_lattice(image, SMALL)


@pytest.mark.parametrize("lit", [(8, 8), (9, 9)])
def test_a_grid_of_another_size_is_refused_with_both_sizes(lit: tuple[int, int]) -> None:
    image = small_frame(grid=SiteGrid(*lit))
    with pytest.raises(DeviceError, match=rf"{lit[0]} x {lit[1]} rows and columns .* has 9 x 8"):
        find_lattice(image, SMALL)


def test_a_dark_row_inside_is_no_matter_and_a_dark_outer_row_is_ambiguous() -> None:
    sites = seen_sites(SMALL, 10.0, centre=(70.0, 80.0))
    rng = np.random.default_rng(5)
    inside = find_lattice(drawn(np.delete(sites, 4, axis=0), (140, 160), 1.2, rng), SMALL)
    assert furthest(inside, sites) < 0.15
    with pytest.raises(DeviceError, match=r"8 x 8 rows and columns .* is ambiguous"):
        find_lattice(drawn(sites[1:], (140, 160), 1.2, rng), SMALL)


def test_the_wrong_shear_or_lattice_is_no_lattice() -> None:
    for grid in (SiteGrid(9, 8, shear=-1), SiteGrid(9, 8, lattice="square")):
        with pytest.raises(DeviceError, match="no lattice found"):
            find_lattice(small_frame(), grid)


def test_spots_that_stand_on_no_lattice_are_refused() -> None:
    rng = np.random.default_rng(6)
    sites = seen_sites(GRID, 12.8, centre=MIDDLE) + rng.normal(0, 1.5, (20, 20, 2))
    with pytest.raises(DeviceError, match="lattice"):
        find_lattice(drawn(np.clip(sites, 2, 509), SHAPE, 1.2, rng), GRID)


@pytest.mark.parametrize("shape", [(1, 12), (12, 1), (1, 2), (2, 1), (2, 2)])
@pytest.mark.parametrize("shear", [1, -1])
def test_a_line_is_found_along_its_axis(shape: tuple[int, int], shear: Literal[1, -1]) -> None:
    grid = SiteGrid(*shape, shear=shear)
    sites = seen_sites(grid, 11.0, 6.0, centre=(110.0, 120.0))
    found = find_lattice(drawn(sites, (220, 240), 1.2, np.random.default_rng(7)), grid)
    assert furthest(found, sites) < 0.25
    assert np.rad2deg(found.angle_rad) == pytest.approx(6.0, abs=1.5)


def test_further_traps_need_the_centre_of_the_grid() -> None:
    everything = seen_sites(SiteGrid(12, 13), 11.0, 2.0, centre=(110.0, 120.0))
    image = drawn(everything, (220, 240), 1.2, np.random.default_rng(8))
    for rows, columns in ((2, 9), (3, 11)), ((4, 5), (2, 12)), ((1, 11), (6, 7)), ((5, 6), (6, 7)):
        sites = everything[slice(*rows), slice(*columns)]
        grid = SiteGrid(*sites.shape[:2])
        with pytest.raises(DeviceError, match=r"more traps .*`--centre Y,X`"):
            find_lattice(image, grid)
        y, x = sites.mean(axis=(0, 1)) + np.array([3.0, -2.0])
        assert furthest(find_lattice(image, grid, centre_px=(y, x)), sites) < 0.25


def test_a_centre_where_there_is_nothing_is_refused() -> None:
    with pytest.raises(DeviceError, match="no lattice found"):
        find_lattice(small_frame(), SMALL, centre_px=(20.0, 500.0))
