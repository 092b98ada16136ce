"""The bench of the AWG: the real driver on a simulated card, atoms that fly in what it plays.

In dds mode the planner keeps to the card's tones. Long comparisons with the virtual profile: LABSEQ_SHOTS=40.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq import Run, Session
from labseq.recording.shot import Shot

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"
N_SHOTS = int(os.environ.get("LABSEQ_SHOTS", "1"))
DDS = ("profile.mobile_tweezers.max_row_tones=16", "profile.mobile_tweezers.max_column_tones=5")


def run(tmp_path: Path, profile: str, *overrides: str, shots: int = N_SHOTS) -> Run:
    with Session.open(
        SEQUENCE, profile=profile, shots=shots, seed=1, output=tmp_path, overrides=overrides
    ) as session:
        return session.run()


@pytest.fixture(scope="module")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., NDArray[np.float64]]:
    """Filling after the first cycle of each shot on the virtual profile, made once for equal settings."""

    @cache
    def filled(*overrides: str) -> NDArray[np.float64]:
        done = run(tmp_path_factory.mktemp("ideal"), "virtual", *overrides, shots=20 * N_SHOTS)
        return np.array([filled_once(shot, done) for shot in done.shots])

    return filled


def filled_once(shot: Shot, done: Run) -> float:
    """Filling after the first cycle."""
    first = next(i for i, image in enumerate(shot.record().images) if image.cycle == 1)
    return done.target.filling_fraction(shot.occupancies[first])


@pytest.mark.parametrize("mode", ["replay", "fifo", "dds"])
def test_filling_agrees_with_the_virtual_profile(
    tmp_path: Path, ideal: Callable[..., NDArray[np.float64]], mode: str
) -> None:
    overrides = DDS if mode == "dds" else ()
    played = run(tmp_path, "bench_awg", f"profile.mobile_tweezers.mode={mode}", *overrides)
    expected = ideal(*overrides)
    found = np.array([filled_once(shot, played) for shot in played.shots])
    error = float(expected.std()) * math.sqrt(1 / len(found) + 1 / len(expected))
    print(f"{mode}: {found.mean():.4f}, virtual {expected.mean():.4f}, error of the difference {error:.4f}")
    assert abs(found.mean() - expected.mean()) < 4 * error
    for shot in played.shots:
        flights = shot.atom_events["flights"]
        held = flights[~np.isnan(flights["held_s"])]
        n_wrong = np.count_nonzero(np.isin(held["fate"], [b"transport", b"collision"]))
        assert len(held) > 100
        assert n_wrong < 0.02 * len(held)
        assert held["offset_m"].max() < 5e-9
        assert len(shot.atom_events["jumps"]) == 0


def test_the_same_seed_gives_the_same_flights(tmp_path: Path) -> None:
    first, again = (run(tmp_path, "bench_awg", shots=1).shots[0] for _ in range(2))
    np.testing.assert_array_equal(first.occupancies, again.occupancies)
    assert first.atom_events["flights"].tobytes() == again.atom_events["flights"].tobytes()


def test_the_virtual_profile_tells_no_story(tmp_path: Path) -> None:
    assert run(tmp_path, "virtual", shots=1).shots[0].atom_events == {}
