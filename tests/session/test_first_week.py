"""The sequences of the first week measure what the simulation is set to."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.session.check import check

from .whole_runs import SMALL_FRAMES

ROOT = Path(__file__).parents[2]
SURVIVAL = "survival:before,after"
IMAGE_HZ = -math.log1p(-0.00314) / 45e-3 + 1 / 33


@pytest.mark.parametrize(
    ("name", "quantity", "fit", "parameter", "true", "tolerance"),
    [
        ("lifetime", SURVIVAL, "exponential", "decay", 33.0, 0.0),
        ("loading_time", "loading", "saturation", "time", 50e-3, 0.0),
        ("imaging_exposure", SURVIVAL, "exponential", "decay", 1 / IMAGE_HZ, 0.0),
        (
            "trap_depth",
            SURVIVAL,
            "lowering",
            "temperature",
            15e-6,
            1.5e-6,
        ),  # the law is a simple one
        ("transport_speed", "analysis.survival.survival", "step", "centre", 0.42, 0.03),
        ("parking", SURVIVAL, "plateau", "centre", 0.0, 0.01e-6),
        # the same fit to 400 flights for each point, 0.9 um beside a site, at 15 uK
        ("hand_over_ramp", SURVIVAL, "gaussian", "sigma", 24.2e-6, 1e-6),
    ],
)
def test_the_fitted_value_is_that_of_the_simulation(
    name: str, quantity: str, fit: str, parameter: str, true: float, tolerance: float, tmp_path: Path
) -> None:
    sequence = ROOT / "sequences" / f"{name}.yaml"
    with labseq.Session.open(
        sequence, seed=3, output=tmp_path, overrides=["repeats=1", *SMALL_FRAMES]
    ) as session:
        run = session.run()
    given = {"centre": 0.0} if name == "hand_over_ramp" else {}
    found = run.fit(quantity, fit, fixed=given)
    value = found.parameters[parameter]
    assert abs(value.value - true) < 3 * value.error + tolerance
    assert value.error < 0.25 * abs(true) + tolerance


def test_a_wrong_step_of_the_tones_costs_atoms(tmp_path: Path) -> None:
    lost: list[float] = []
    for step in ("1.6 MHz", "1.65 MHz"):
        overrides = [f"profile.grid.column_frequency.step={step}", "shot.2.rearrange.cycles=1", *SMALL_FRAMES]
        options: Any = {"shots": 3, "seed": 1, "output": tmp_path, "overrides": overrides}
        with labseq.Session.open(ROOT / "sequences" / "compact_225.yaml", **options) as session:
            run = session.run()
        causes = ("hand_over", "transport", "collision")
        lost.append(sum(shot.readings[f"simulation.lost.{cause}"] for shot in run.shots for cause in causes))
    assert lost[1] > 20 + 3 * lost[0]


def test_speeds_at_which_the_light_of_the_virtual_lab_is_not_known_are_named() -> None:
    scan = "scan={profile.mobile_tweezers.speed: [130 um/ms, 300 um/ms]}"
    session = labseq.Session.open(ROOT / "sequences" / "transport_speed.yaml", overrides=[scan])
    (warning,) = check(session).warnings
    assert "profile.mobile_tweezers.speed is 300 um/ms; above 269 um/ms" in str(warning)
    assert "at point 1 of the scan" in str(warning)
