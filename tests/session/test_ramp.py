"""Shots in which the static tweezers are ramped, in the virtual lab."""

from pathlib import Path
from typing import Any

import numpy as np

import labseq

from .small_runs import PROFILE

SIMULATION = "simulation: {use: virtual, loading: 75 %, depth_disorder: 4 %,"
SEQUENCE = """
labseq: 1
name: ramped
profile: ./shallow.yaml
shots: 2
target: {pattern: compact, rows: 5, cols: 5}
planner: {use: psca}
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - ramp: {device: static_tweezers, depth: DEPTH, duration: 5 ms}
  - image: {exposure: 45 ms}
STEPS
"""
AGAIN = """
  - ramp: {depth: 1, duration: 5 ms}
  - image: {exposure: 45 ms}
"""


def shots(folder: Path, depth: str, steps: str = AGAIN) -> list[Any]:
    (folder / "shallow.yaml").write_text(
        PROFILE.replace("simulation: {use: virtual,", SIMULATION).replace("6, cols: 6", "8, cols: 8"),
        encoding="utf-8",
    )
    sequence = folder / "s.yaml"
    sequence.write_text(SEQUENCE.replace("DEPTH", depth).replace("STEPS", steps), encoding="utf-8")
    with labseq.Session.open(sequence, seed=5, output=folder / "data") as session:
        return list(session.run().shots)


def test_an_array_at_half_the_depth_keeps_its_atoms(tmp_path: Path) -> None:
    for shot in shots(tmp_path, "0.5"):
        assert shot.readings["simulation.lost.light"] == 0
        (full, shallow, again) = (np.count_nonzero(seen) for seen in shot.occupancies)
        assert full - 8 <= shallow <= full  # a few to the imaging, whose images are read with errors
        assert again >= shallow - 8


def test_atoms_in_shallow_tweezers_are_lost_and_the_next_shot_loads_at_full_depth(tmp_path: Path) -> None:
    for shot in shots(tmp_path, "0.1 %", AGAIN + "  - ramp: {depth: 0.1 %, duration: 5 ms}\n"):
        (full, shallow, again) = (np.count_nonzero(seen) for seen in shot.occupancies)
        assert full > 30  # of 64, in the second shot too
        assert shot.readings["simulation.lost.light"] >= full - 3
        assert shallow <= 2
        assert again <= 2  # they do not come back with the light


def test_a_rearrangement_hands_over_to_tweezers_of_their_present_depth(tmp_path: Path) -> None:
    n_lost = dict[str, int]()
    for depth in ("100 %", "11 %"):
        for shot in shots(tmp_path, depth, "  - rearrange: {cycles: 1, window: 60 ms}\n"):
            lost = sum(shot.readings[f"simulation.lost.{cause}"] for cause in ("hand_over", "transport"))
            n_lost[depth] = n_lost.get(depth, 0) + lost
            n_true, n_seen = shot.readings["simulation.n_atoms_true"], np.count_nonzero(shot.occupancies[-1])
            assert abs(n_true - n_seen) <= 4  # what was seen of the atoms is what there is
    assert n_lost["11 %"] > 2 * n_lost["100 %"]
