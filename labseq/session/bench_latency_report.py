"""What came of measuring the time from a frame to the light."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

HOST_STAGES: Final = ("detect", "plan", "check", "tone program", "renderer", "first chunk")
"""What happens between a frame in memory and the first chunk of samples."""

HAND_OVER: Final = "hand-over"
"""The way to the threads in which detector and planner are called, and back: a core has to wake for each."""

BETWEEN: Final = "in between"
"""What else passes: the shot's record, and the way from step to step."""

GOAL_S: Final = 2e-3
"""From a frame in memory to the first chunk of samples."""


@dataclass(frozen=True, slots=True)
class Stage:
    """How long something takes.

    Attributes:
        name: What.
        median_s: Median on this computer's clock.
        p99_s: Time within which 99 % are done.
        modelled_s: Median of what passes on the session's clock besides: what the hardware takes.
    """

    name: str
    median_s: float
    p99_s: float
    modelled_s: float = 0.0

    @classmethod
    def of(
        cls, name: str, host_s: NDArray[np.float64], modelled_s: NDArray[np.float64] | None = None
    ) -> Stage:
        """Sum up durations, float64 (n,)."""
        modelled = 0.0 if modelled_s is None else float(np.median(modelled_s))
        return cls(name, float(np.median(host_s)), float(np.quantile(host_s, 0.99)), modelled)


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """The times of a profile and a sequence, on this computer.

    Attributes:
        n_loadings: Random loadings.
        seed: What they were drawn from.
        profile: Name of the profile.
        planner: Name of the planner.
        degree_of_parallelism: Most tweezers on at once.
        n_batches: Median number of batches of a plan.
        playing_s: Median playing time of its tone program.
        sample_rate_hz: What the first chunk was rendered at.
        stages: From the frame to the first chunk, in order; they add up to the total, medians about.
        total: From a frame in memory to the first chunk.
        planned: From a frame in memory to the tone program.
        device: Model of the mobile tweezers, as they say.
        mode: Their mode, if they have one.
        readout_s: The camera's read-out time, as it says.
        prepare: ``prepare()`` of the mobile tweezers: all that has to be done before they can start.
        start: ``play()``.
        trigger_s: From the trigger to the output, as the device says.
        n_cores: Processor cores.
        load: Mean number of busy processes in the last minute; None where that is not known.
        warnings: What the user should know of the profile although it is no error.
    """

    n_loadings: int
    seed: int
    profile: str
    planner: str
    degree_of_parallelism: int
    n_batches: float
    playing_s: float
    sample_rate_hz: float
    stages: tuple[Stage, ...]
    total: Stage
    planned: Stage
    device: str
    mode: str
    readout_s: float
    prepare: Stage
    start: Stage
    trigger_s: float
    n_cores: int
    load: float | None
    warnings: tuple[str, ...]

    @property
    def to_light_s(self) -> float:
        """From the end of the exposure to the start of the program at the output, medians added up."""
        device_s = sum(stage.median_s + stage.modelled_s for stage in (self.prepare, self.start))
        return self.readout_s + self.planned.median_s + device_s + self.trigger_s

    def as_dict(self) -> dict[str, Any]:
        """Everything, JSON-ready, in SI."""
        return asdict(self) | {"goal_s": GOAL_S, "to_light_s": self.to_light_s}
