"""Runs that probe where the mobile tweezers stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from labseq.calibrations import read_entry
from labseq.errors import ConfigError, Problem
from labseq.model import MotionSpec, SiteGrid
from labseq.recording import Run
from labseq.session.plan_inputs import recorded_machine

_ADDRESS = ".probe.offset"


@dataclass(frozen=True, slots=True, eq=False)
class ProbeCounts:
    """What a scan of the probe's offset saw.

    Attributes:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int64 (n_points, n_rows, n_cols), atoms that were probed on each site.
        n_survived: int64, likewise: how many of them were seen afterwards.
        grid: The grid, with the tones that were played.
        motion: How the tweezers moved.
        in_use_m: float64 (2,), the offset that an overlay calibration made up for in the run.
        calibrations: Those in use in the run: kind -> id.
    """

    offset_m: NDArray[np.float64]
    n_before: NDArray[np.int64]
    n_survived: NDArray[np.int64]
    grid: SiteGrid
    motion: MotionSpec
    in_use_m: NDArray[np.float64]
    calibrations: dict[str, str]


def read_probed(run: Run) -> ProbeCounts:
    """Count, at each offset and on each site, the atoms before and after the probe.

    Raises:
        ConfigError: The run does not scan the offset of a probe between two images.
        RecordingError: A shot's file is damaged.
    """
    before: dict[tuple[float, float], NDArray[np.int64]] = {}
    after: dict[tuple[float, float], NDArray[np.int64]] = {}
    for shot in run.shots:
        offset = next((v for k, v in shot.parameters.items() if k.endswith(_ADDRESS)), None)
        seen = shot.occupancies
        if offset is None or len(seen) < 2:
            what = "the run does not scan the offset of a probe between two images"
            expected = "one such as 'labseq calibrate overlay' takes"
            raise ConfigError(Problem(what, str(run.path), expected=expected))
        point = float(offset[0]), float(offset[1])
        before[point] = before.get(point, 0) + seen[0].astype(np.int64)
        after[point] = after.get(point, 0) + (seen[0] & seen[-1]).astype(np.int64)
    if not before:
        raise ConfigError(
            Problem("the run has no shots", str(run.path), expected="a scan of a probe's offset")
        )
    machine = recorded_machine(run.record["resolved"]["profile"], "the profile of the run")
    calibrations: dict[str, str] = dict(run.record.get("calibrations") or {})
    in_use_m = np.zeros(2)
    if "overlay" in calibrations:
        in_use_m = read_entry(run.path / "calibration_overlay.json").values["offset_m"]
    return ProbeCounts(
        np.array([*before]),
        np.stack([*before.values()]),
        np.stack([*after.values()]),
        machine.grid,
        machine.motion,
        in_use_m,
        calibrations,
    )
