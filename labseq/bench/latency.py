"""Measures the time from a frame in memory to the first light of the mobile tweezers."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.builtin.rearrange import checked_plan, n_beginning, play_prepared, prepare, rest_of
from labseq.console.report import Column, table
from labseq.console.text import plural, time_text
from labseq.errors import ConfigError, Problem
from labseq.guard import stop_on_signals
from labseq.model import ShotRecord, TimelineEntry
from labseq.model.policies import RunPolicy
from labseq.motion import tone_program
from labseq.realtime import raise_priority, restore_priority
from labseq.roles import Shot, Step, StepContext
from labseq.sequencer.lab import Lab
from labseq.sequencer.run import Sequencer
from labseq.session.session import Session
from labseq.units import format_quantity

HOST_STAGES: Final = ("detect", "plan", "check", "tones", "prepare")
"""The stages between a frame in memory and the first samples at the device.

In the record of a shot, ``tones`` is a part of ``prepare``. Here it counts separately."""

BETWEEN: Final = "in between"
"""Stage of the remaining time, for the shot's record and between steps."""


@dataclass(frozen=True, slots=True)
class Stage:
    """Statistics of a stage's duration over all loadings.

    Attributes:
        median_s: Median on this computer's clock.
        p99_s: The 99th percentile on this computer's clock.
        modelled_s: Median of the additional time of the hardware, modelled on the session's clock.
    """

    name: str
    median_s: float
    p99_s: float
    modelled_s: float = 0.0

    @classmethod
    def of(
        cls, name: str, host_s: NDArray[np.float64], modelled_s: NDArray[np.float64] | None = None
    ) -> Stage:
        """Statistics of durations in seconds, float64 (n,)."""
        modelled = 0.0 if modelled_s is None else float(np.median(modelled_s))
        return cls(name, float(np.median(host_s)), float(np.quantile(host_s, 0.99)), modelled)


STAGES: Final[Sequence[Column[Stage]]] = (
    Column("stage", lambda stage: stage.name),
    Column("median", lambda stage: time_text(stage.median_s or None), right=True),
    Column("99 %", lambda stage: time_text(stage.p99_s or None), right=True),
    Column("modelled", lambda stage: time_text(stage.modelled_s or None), right=True),
)


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """The times of a profile and a sequence, on this computer.

    Attributes:
        degree_of_parallelism: Maximum number of tweezers on at once.
        n_batches: Median number of batches of a plan.
        playing_s: Median playing time of its tone program.
        stages: From the frame to the first samples at the device, in order.
        total: From a frame in memory to the first samples, or to a whole program if the device needs that.
        start: Duration of ``play()``.
        light: From a frame in memory to the light.
        light_s: Time to the light for each loading, in seconds, with modelled times.
        device: Model of the mobile tweezers, from their description.
        mode: Mode of the mobile tweezers, if they have one.
        readout_s: The camera's read-out time.
        delay_s: Time from ``play()`` to the output.
        load: Mean number of busy processes in the last minute. None if unknown.
    """

    n_loadings: int
    seed: int
    profile: str
    planner: str
    degree_of_parallelism: int
    n_batches: float
    playing_s: float
    stages: tuple[Stage, ...]
    total: Stage
    start: Stage
    light: Stage
    light_s: tuple[float, ...]
    device: str
    mode: str
    readout_s: float
    delay_s: float
    n_cores: int
    load: float | None
    warnings: tuple[str, ...]

    @property
    def light_quantiles_s(self) -> tuple[float, float, float]:
        """Median, 99th percentile and maximum of the time to the light, with modelled times."""
        median, p99 = np.quantile(self.light_s, (0.5, 0.99))
        return float(median), float(p99), max(self.light_s)

    def as_json(self) -> dict[str, Any]:
        """All attributes, in SI units."""
        return asdict(self) | {"light_quantiles_s": self.light_quantiles_s}

    def as_text(self) -> list[str]:
        """A table of the stages, and notes."""
        stages = (*self.stages, self.total, self.start, self.light)
        return [*table(stages, STAGES), "", *_notes(self)]


N_WARM: Final = 5
"""Number of initial loadings that are not counted, because caches are cold."""


@dataclass(frozen=True, slots=True)
class LatencyRequest:
    """The sequence, profile and loadings of a measurement.

    Attributes:
        sequence: The sequence file, which gives the target, the planner and the first image.
        profile: Name or path of the profile, instead of the sequence's own.
        overrides: ``"address=value"`` strings, as given to ``--set``.
        n_loadings: Number of random loadings.
        seed: Seed of all loadings.
    """

    sequence: Path
    profile: str | None = None
    overrides: Sequence[str] = ()
    n_loadings: int = 200
    seed: int = 1


def measure_latency(
    request: LatencyRequest,
    *,
    announce: Callable[[float], None] = lambda _: None,
    progress: Callable[[int, int], None] = lambda _done, _wanted: None,
) -> LatencyReport:
    """Take shots in a dry run up to the first image, and time the following stages.

    Frames, detector, planner and driver are the same as in a run, and are called in the same way. No program
    is played to its end.

    Args:
        request: Sequence, profile and loadings.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.
        progress: Called with the numbers of finished and requested loadings.

    Raises:
        ConfigError: The request, the sequence or the profile has an error.
        PluginLoadError: A plugin that is named failed to load.
        StopRequested: Ctrl-C or SIGTERM.
        LabseqError: The error that ended a shot.
    """
    times = _TimesRecorder(announce, progress, request.n_loadings)
    session = Session.open(
        request.sequence,
        profile=request.profile,
        overrides=request.overrides,
        seed=request.seed,
        dry_run="full",  # the driver's real code runs, down to the simulated card
        observer=times,
    )
    lab = session.build_lab()
    lab = replace(lab, motion=replace(lab.motion, overhead_per_cycle_s=0.0))  # the real overhead is measured
    rearrangement = _RearrangeOnce()
    steps: list[tuple[str, Any]] = [*_up_to_the_image(session), ("latency", rearrangement)]
    with stop_on_signals(session.stop_flag):
        session.warm(lab)
        sequencer = Sequencer(
            lab, steps, session.stop_flag, times, times, seed=request.seed, policy=RunPolicy(attempts=1)
        )
        try:
            sequencer.open()
            for shot in range(N_WARM + request.n_loadings):
                sequencer.take(shot)
            device = dict(lab.mobile_tweezers.describe())
        finally:
            sequencer.shut_down()
    return _report(request, session, lab, times, rearrangement, device)


class _TimesRecorder:
    """Receives events and shots, and keeps only the times."""

    def __init__(
        self, announce: Callable[[float], None], progress: Callable[[int, int], None], n_loadings: int
    ) -> None:
        self._announce = announce
        self._progress = progress
        self._n_loadings = n_loadings
        self.shots: list[dict[str, tuple[float, float]]] = []

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Report that kernels are compiled."""
        if name == "compiling":
            self._announce(float(values["about_s"]))

    def write_shot(self, shot: ShotRecord) -> None:
        """Keep host time and modelled time of each stage."""
        self.shots.append({stage.stage: (stage.host_s, stage.duration_s) for stage in shot.timing})
        if shot.shot_index >= N_WARM:
            self._progress(shot.shot_index + 1 - N_WARM, self._n_loadings)


class _RearrangeOnce(Step):
    """A step that rearranges once, without a window and without an image after it."""

    needs_image = True
    takes_image = False

    def __init__(self) -> None:
        self.plans: list[tuple[int, float]] = []

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002
        """Empty, because its duration is not planned."""
        return []

    def run(self, shot: Shot) -> None:
        """Plan, prepare and play, as a rearrangement does."""
        raise_priority()  # as a run in real time does before the frame
        plan, report = checked_plan(shot, 0)
        if plan.n_batches == 0:
            problem = "there is nothing to move: a random loading needs no moves or has no atoms"
            raise ConfigError(Problem(problem, "shot", hint="choose another target or loading"))
        n_first = n_beginning(shot, plan, report, plan.n_batches)
        build = partial(tone_program, plan.first(n_first), shot.grid, shot.motion)
        is_whole = n_first == plan.n_batches
        prepare(shot, build, shot.clock.now(), 0, is_whole=is_whole)
        self.plans.append((plan.n_batches, report.duration_s))
        play_prepared(shot, report.duration_s, 0, rest_of(shot, plan, n_first, plan.n_batches))
        restore_priority()


def _up_to_the_image(session: Session) -> list[tuple[str, Step]]:
    """The sequence's steps before its first rearrangement.

    Raises:
        ConfigError: None of these steps takes an image.
    """
    steps = list(takewhile(lambda item: not item[1].needs_image, session.assembly.steps))
    if not any(step.takes_image for _, step in steps):
        problem = "there is no image before the first rearrangement"
        raise session.assembly.document.error(("shot",), problem, "an `image` step")
    return steps


def _report(
    request: LatencyRequest,
    session: Session,
    lab: Lab,
    times_recorder: _TimesRecorder,
    rearrangement: _RearrangeOnce,
    device: dict[str, Any],
) -> LatencyReport:
    shots = times_recorder.shots[N_WARM:]
    times = {name: np.array([shot[name] for shot in shots]).T for name in (*HOST_STAGES, "start", "light")}
    times["prepare"][0] -= times["tones"][0]  # in the record they include the tones
    light_s, modelled_s = times["light"]
    # light ends with start, before which the samples are at the device
    total_s = light_s - times["start"][0]
    between_s = total_s - sum(times[name][0] for name in HOST_STAGES)
    stages = [Stage.of(name, *times[name]) for name in HOST_STAGES]
    n_batches, playing_s = np.median(np.array(rearrangement.plans[N_WARM:]), axis=0)
    return LatencyReport(
        n_loadings=request.n_loadings,
        seed=request.seed,
        profile=session.assembly.hardware.profile.name,
        planner=lab.planner_name,
        degree_of_parallelism=lab.degree_of_parallelism,
        n_batches=float(n_batches),
        playing_s=float(playing_s),
        stages=(*stages, Stage.of(BETWEEN, between_s)),
        total=Stage.of("frame to first samples", total_s, times["prepare"][1]),
        start=Stage.of("start", *times["start"]),
        light=Stage.of("frame to light", light_s, modelled_s),
        light_s=tuple((light_s + modelled_s).tolist()),
        device=str(device.get("model", "")),
        mode=str(device.get("mode", "")),
        readout_s=lab.step_context.camera.readout_s,
        delay_s=lab.mobile_tweezers.start_delay_s,
        n_cores=os.cpu_count() or 1,
        load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        warnings=session.assembly.hardware.warnings,
    )


def draw_report(report: LatencyReport, path: Path) -> None:
    """Draw a histogram of the times from a frame to the light, see :func:`draw_times`."""
    mode = f", mode {report.mode}" if report.mode else ""
    load = "" if report.load is None else f", load {report.load:.2g}"
    title = f"{report.device}{mode}: {plural(report.n_loadings, 'program')}{load}"
    draw_times(report.light_s, title, path)


def draw_times(light_s: Sequence[float], title: str, path: Path) -> None:
    """Draw a histogram of times from a frame to the light, in seconds.

    Raises:
        ConfigError: matplotlib is not installed, or the file cannot be written.
    """
    from labseq.pictures.figures import make_figure, save_figure, show_plain_numbers

    def draw() -> Any:
        figure = make_figure(6.4, 3.2, layout="constrained")
        axes = figure.add_subplot(xlabel="frame in memory to light (ms)", ylabel="programs")
        light_ms = 1e3 * np.array(light_s)
        # logarithmic, as the rare long times matter
        bins = np.geomspace(0.95 * light_ms.min(), 1.05 * light_ms.max(), 80)
        axes.hist(light_ms, bins, color="#3b6ea5")
        axes.set(xscale="log", yscale="log", ylim=(0.7, None))  # counts begin at one
        for axis in (axes.xaxis, axes.yaxis):
            show_plain_numbers(axis)
        for share, name, side in ((0.5, "median", "right"), (0.99, "99 %", "left")):
            value_ms = float(np.quantile(light_ms, share))
            axes.axvline(value_ms, color="#c44e52", linewidth=1)
            place: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "va": "top", "ha": side}
            text = f" {name} {format_quantity(1e-3 * value_ms, 'time')} "
            axes.text(value_ms, 0.97, text, fontsize=8, **place)
        axes.set_title(title, fontsize=9)
        return figure

    save_figure(path, draw)


def _notes(report: LatencyReport) -> list[str]:
    """Notes below the table on times, plans, profile and computer."""
    device = f"{report.device}, mode {report.mode}" if report.mode else report.device
    load = "" if report.load is None else f", load {report.load:.2g}"
    playing, delay = format_quantity(report.playing_s, "time"), format_quantity(report.delay_s, "time")
    planner = f"{report.planner}, degree of parallelism {report.degree_of_parallelism}"
    median, p99, worst = (format_quantity(s, "time") for s in report.light_quantiles_s)
    ended = format_quantity(report.light_quantiles_s[0] + report.readout_s, "time")
    return [
        f"frame to light, with modelled times: median {median}, 99 % {p99}, at most {worst}",
        f"end of the exposure to light: {ended}, then {playing} of moves",
        f"{plural(report.n_loadings, 'loading')}, seed {report.seed}, {plural(report.n_cores, 'core')}{load}",
        f"{planner}: {report.n_batches:g} batches",
        f"profile {report.profile}: {device}; {delay} from play() to the output",
        "prepare and start include the work of a simulated device",
    ]
