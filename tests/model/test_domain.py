import numpy as np
import pytest

from labseq.model import Frame, MotionSpec, RandomStream, SiteGrid, StageTiming, TargetPattern, as_occupancy


def neighbours(grid):
    flat = grid.positions_m.reshape(-1, 2)
    distance = np.linalg.norm(flat[:, None] - flat[None], axis=-1)
    return (np.isclose(distance, grid.spacing_m)).sum(axis=1).reshape(grid.shape)


@pytest.mark.parametrize("shear", [1, -1])
def test_the_triangular_lattice_has_six_neighbours(shear):
    grid = SiteGrid(7, 7, shear=shear)
    assert (neighbours(grid)[1:-1, 1:-1] == 6).all()


def test_the_square_lattice_has_four_neighbours():
    assert (neighbours(SiteGrid(7, 7, lattice="square"))[1:-1, 1:-1] == 4).all()


@pytest.mark.parametrize(
    "wrong",
    [{"n_rows": 0}, {"spacing_m": 0.0}, {"spacing_m": float("nan")}, {"row_frequency_hz": np.ones(3)}],
)
def test_impossible_grids_are_refused(wrong):
    with pytest.raises(ValueError, match=r"grid|spacing|row_frequency_hz"):
        SiteGrid(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"speed_m_s": 0.0}, {"pick_up_s": -1.0}, {"max_tweezers": 0}, {"eject_slots": -1}]
)
def test_impossible_motion_is_refused(wrong):
    (setting,) = wrong
    with pytest.raises(ValueError, match=rf"{setting}\n  Input should be"):
        MotionSpec(**wrong)


def test_occupancies_are_read_from_anything_of_zeros_and_ones():
    assert as_occupancy([[0, 1], [1, 0]]).dtype == np.bool_
    assert as_occupancy(np.ones((2, 3), np.float32).T).flags.c_contiguous
    for wrong in ([[0, 2]], [0, 1], [[0.5]], np.zeros((0, 2))):
        with pytest.raises(ValueError, match="occupancy"):
            as_occupancy(wrong)
    with pytest.raises(ValueError, match="grid"):
        as_occupancy([[0, 1]], (2, 2))


def test_a_target_knows_its_defects():
    fill = np.array([[1, 1, 0]], bool)
    target = TargetPattern(fill, np.array([[0, 0, 1]], bool))
    seen = np.array([[1, 0, 1]], bool)
    assert (target.n_atoms, target.n_defects(seen), target.n_surplus(seen)) == (2, 1, 1)
    assert target.filling_fraction(seen) == 0.5
    assert not target.is_met_by(seen)
    assert target.is_met_by(fill)
    assert TargetPattern(~fill & fill, fill).filling_fraction(seen) == 1.0


def test_a_site_cannot_be_full_and_empty():
    with pytest.raises(ValueError, match="both"):
        TargetPattern(np.ones((1, 1), bool), np.ones((1, 1), bool))


def test_frames_are_never_converted():
    with pytest.raises(ValueError, match="uint16"):
        Frame(np.zeros((2, 2), np.float64), 0.1, 0.0)  # pyright: ignore[reportArgumentType]


def test_shots_draw_the_same_whatever_came_before():
    one, other = RandomStream(5), RandomStream(5)
    one.begin_shot(0, 0)
    one.shot.random(100)
    one.begin_shot(3, 1)
    other.begin_shot(3, 1)
    assert one.shot.random(4).tolist() == other.shot.random(4).tolist()
    assert one.machine().random() == other.machine().random()


def test_attempts_shots_and_consumers_draw_differently():
    drawn = set()
    for name in ("", "camera", "shutter"):
        stream = RandomStream(5, name)
        for shot, attempt in ((0, 0), (0, 1), (1, 0)):
            stream.begin_shot(shot, attempt)
            drawn.add(stream.shot.random())
    assert len(drawn) == 9


def test_the_simulation_draws_from_the_published_key():
    stream = RandomStream(7)
    stream.begin_shot(4, 2)
    key = np.random.SeedSequence(7, spawn_key=(4, 2))
    assert stream.shot.random() == np.random.default_rng(key).random()


def test_what_a_clock_overshoots_is_not_over_budget():
    assert not StageTiming("move", 0, 1, 0.0, 0.0609, 0.0, 0.06).over_budget
    assert StageTiming("move", 0, 1, 0.0, 0.0611, 0.0, 0.06).over_budget
