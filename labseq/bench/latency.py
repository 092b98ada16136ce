"""Measures the time from the end of the exposure to the first light of the mobile tweezers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.console.text import columns, percent, plural
from labseq.errors import ConfigError, LimitError, Problem
from labseq.guard import stop_on_signals
from labseq.model import Frame, Occupancy, Plan, ShotRecord, StageTiming, TargetPattern, TimelineEntry
from labseq.motion import Renderer, RenderPath, check_plan, comb_sample_rate, tone_program
from labseq.roles import Detection, Detector, Planner, Shot, Step, StepContext, offers
from labseq.sequencer.lab import Lab
from labseq.sequencer.policies import RunPolicy
from labseq.sequencer.run import Sequencer
from labseq.session.session import Session
from labseq.units import format_quantity

HOST_STAGES: Final = ("detect", "plan", "check", "tone program", "renderer", "first chunk")
"""The stages between a frame in memory and the first chunk of samples."""

HAND_OVER: Final = "hand-over"
"""Stage of switching to the threads of detector and planner, and back; each switch wakes a core."""

BETWEEN: Final = "in between"
"""Stage of the remaining time, for the shot's record and between steps."""

GOAL_S: Final = 2e-3
"""Goal for the total time from a frame in memory to the first chunk of samples, in seconds."""


@dataclass(frozen=True, slots=True)
class Stage:
    """Durations of a stage over all loadings.

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


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """The times of a profile and a sequence, on this computer.

    Attributes:
        degree_of_parallelism: Maximum number of tweezers on at once.
        n_batches: Median number of batches of a plan.
        playing_s: Median playing time of its tone program.
        sample_rate_hz: Sample rate of the first chunk.
        stages: From the frame to the first chunk, in order; they add up to the total.
        total: From a frame in memory to the first chunk.
        planned: From a frame in memory to the tone program.
        device: Model of the mobile tweezers, from their description.
        mode: Their mode, if they have one.
        readout_s: The camera's read-out time.
        prepare: Duration of ``prepare()`` of the mobile tweezers, which must end before they can start.
        start: Duration of ``play()``.
        trigger_s: Time from the trigger to the output, from the description of the device.
        load: Mean number of busy processes in the last minute; None if unknown.
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
        """Time from the end of the exposure to the start of the program at the output: a sum of medians."""
        device_s = sum(stage.median_s + stage.modelled_s for stage in (self.prepare, self.start))
        return self.readout_s + self.planned.median_s + device_s + self.trigger_s

    def as_dict(self) -> dict[str, Any]:
        """Everything, JSON-ready, in SI."""
        return asdict(self) | {"goal_s": GOAL_S, "to_light_s": self.to_light_s}


CHUNK: Final = 1 << 17
"""Samples per channel that a streaming driver hands over at a time: 0.2 ms at 625 MS/s."""

N_WARM: Final = 5
"""Number of initial loadings that are not counted, because caches are cold."""

FALLBACK_RATE_HZ: Final = 625e6
"""Sample rate if the profile has none and the tones form no comb."""


@dataclass(frozen=True, slots=True)
class LatencyRequest:
    """The sequence, profile and loadings of a measurement.

    Attributes:
        sequence: The sequence file: its target, its planner, and how its first image is taken.
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

    Frames, detector, planner and driver are those of a run, and are called as in a run. No program
    is played to its end.

    Args:
        request: Sequence, profile and loadings.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.
        progress: Called with the numbers of loadings that are done and wanted.

    Raises:
        ConfigError: The request, the sequence or the profile has an error.
        PluginLoadError: A plugin that is named failed to load.
        StopRequested: Ctrl-C or SIGTERM.
        LabseqError: The error that ended a shot.
    """
    watch = _Watch(announce, progress, request.n_loadings)
    session = Session.open(
        request.sequence,
        profile=request.profile,
        overrides=request.overrides,
        seed=request.seed,
        dry_run="full",
        observer=watch,
    )
    lab = session.build_lab()
    timed = _Timed(lab.detector, lab.planner)
    measured = _Measured(_sample_rate_hz(session, lab), watch, timed)
    steps: list[tuple[str, Any]] = [*_up_to_the_image(session), ("latency", measured)]
    with stop_on_signals(session.stop_flag):
        session.warm(lab)
        lab = replace(lab, detector=timed, planner=timed)
        sequencer = Sequencer(
            lab, steps, session.stop_flag, watch, watch, seed=request.seed, policy=RunPolicy(attempts=1)
        )
        try:
            sequencer.open()
            sequencer.run(range(N_WARM + request.n_loadings))
            device = dict(lab.mobile_tweezers.describe())
        finally:
            sequencer.shut_down()
    return _report(request, session, lab, watch, measured, device)


class _Watch:
    """Observer and sink of the shots that keeps only the times."""

    def __init__(
        self, announce: Callable[[float], None], progress: Callable[[int, int], None], n_loadings: int
    ) -> None:
        self._announce = announce
        self._progress = progress
        self._n_loadings = n_loadings
        self.frame_s = 0.0
        self.shots: list[dict[str, tuple[float, float]]] = []

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Record when a frame is in memory."""
        timing = values.get("timing")
        if isinstance(timing, StageTiming) and timing.stage == "expose":
            self.frame_s = time.perf_counter()
        elif name == "compiling":
            self._announce(float(values["about_s"]))

    def write_shot(self, shot: ShotRecord) -> None:
        """Keep host time and modelled time of each stage."""
        self.shots.append({t.stage: (t.host_s, t.duration_s) for t in shot.timing})
        if shot.shot_index >= N_WARM:
            self._progress(shot.shot_index + 1 - N_WARM, self._n_loadings)


class _Timed:
    """Measures the time of detector and planner, without that for switching threads."""

    def __init__(self, detector: Detector, planner: Planner) -> None:
        self._detector = detector
        self._planner = planner
        self.detect_s = self.plan_s = 0.0

    def detect(self, frame: Frame) -> Detection:
        start_s = time.perf_counter()
        answer = self._detector.detect(frame)
        self.detect_s = time.perf_counter() - start_s
        return answer

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        start_s = time.perf_counter()
        answer = self._planner.plan(occupancy, target)
        self.plan_s = time.perf_counter() - start_s
        return answer


class _Measured(Step):
    """A step that does the work of a rearrangement, and times the first chunk of a stream separately."""

    needs_image = True
    takes_image = False

    def __init__(self, sample_rate_hz: float, watch: _Watch, timed: _Timed) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.plans: list[tuple[int, float]] = []
        self.own_s: list[tuple[float, float]] = []
        self.total_s: list[float] = []
        self._watch = watch
        self._timed = timed
        self._samples = np.empty((2, CHUNK), np.int16)
        self._frames = np.empty((CHUNK, 2), np.int16)

    def plan_timeline(self, context: StepContext) -> Sequence[TimelineEntry]:  # noqa: ARG002
        """Empty: its duration is not planned."""
        return []

    def run(self, shot: Shot) -> None:
        """Plan, prepare and start playing; then wait for the end, as a run does."""
        occupancy = shot.occupancy
        assert occupancy is not None
        mobile, limit_s = shot.mobile_tweezers, shot.call_timeout_s
        if offers(mobile, "settle"):
            start_s = time.perf_counter()
            mobile.settle()  # a simulated device does here what was due while the virtual clock advanced
            self._watch.frame_s += time.perf_counter() - start_s
        with shot.stage("plan"):
            seen = occupancy.copy()
            plan = shot.call("planner", shot.plan_timeout_s, shot.planner.plan, seen, shot.target)
        if plan.n_batches == 0:
            what = "there is nothing to move: a random loading needs no moves, or has no atoms to move"
            raise ConfigError(Problem(what, "shot", hint="choose another target or loading"))
        with shot.stage("check"):
            dop = shot.degree_of_parallelism
            check_plan(plan, occupancy, shot.target, dop, shot.grid, shot.motion, shot.planner_name)
        with shot.stage("tone program"):
            program = tone_program(plan, shot.grid, shot.motion)
        with shot.stage("renderer"):
            renderer = Renderer(program, self.sample_rate_hz)
        with shot.stage("first chunk"):
            self._render_first(renderer)
        self.total_s.append(time.perf_counter() - self._watch.frame_s)
        self.own_s.append((self._timed.detect_s, self._timed.plan_s))
        self.plans.append((plan.n_batches, program.total_duration_s))
        with shot.stage("prepare"):
            playing_s = shot.call("mobile_tweezers", limit_s, mobile.prepare, program)
        with shot.stage("start"):
            shot.call("mobile_tweezers", limit_s, mobile.play)
        shot.call("mobile_tweezers", playing_s + 2 * limit_s, mobile.wait, playing_s + limit_s)

    def _render_first(self, renderer: Renderer) -> None:
        """Render a chunk that begins with the first tones, for both channels in parallel."""
        loud = (renderer.path != RenderPath.SILENT).any(axis=0)
        start = int(renderer.first_sample[loud.argmax()])
        for channel, samples in enumerate(self._samples):
            renderer.write(channel, start, samples)
            self._frames[:, channel] = samples


def _up_to_the_image(session: Session) -> list[tuple[str, Step]]:
    """The sequence's steps before its first rearrangement.

    Raises:
        ConfigError: None of these steps takes an image.
    """
    steps = list(takewhile(lambda named: not named[1].needs_image, session.assembly.steps))
    if not any(step.takes_image for _, step in steps):
        what = "there is no image before the first rearrangement"
        raise session.assembly.document.error(("shot",), what, "an `image` step")
    return steps


def _sample_rate_hz(session: Session, lab: Lab) -> float:
    """The sample rate that the profile sets, if its device has one, else one that suits its tones."""
    settings = session.assembly.hardware.chosen["mobile_tweezers"].settings
    given = getattr(settings, "sample_rate", None)
    if isinstance(given, float):
        return given
    try:
        return comb_sample_rate(lab.grid)
    except LimitError:
        return FALLBACK_RATE_HZ


def _report(
    request: LatencyRequest,
    session: Session,
    lab: Lab,
    watch: _Watch,
    measured: _Measured,
    device: dict[str, Any],
) -> LatencyReport:
    shots = watch.shots[N_WARM:]
    names = (*HOST_STAGES, "prepare", "start")
    times = {name: np.array([shot[name] for shot in shots]).T for name in names}
    total_s, own_s = np.array(measured.total_s[N_WARM:]), np.array(measured.own_s[N_WARM:]).T
    here_s = {name: times[name][0] for name in HOST_STAGES}
    between_s = total_s - sum(here_s.values())
    handed_s = here_s["detect"] + here_s["plan"] - own_s.sum(axis=0)
    here_s |= {"detect": own_s[0], "plan": own_s[1], HAND_OVER: handed_s, BETWEEN: between_s}
    rendered_s = here_s["renderer"] + here_s["first chunk"]  # prepare() does this again
    n_batches, playing_s = np.median(np.array(measured.plans[N_WARM:]), axis=0)
    return LatencyReport(
        n_loadings=request.n_loadings,
        seed=request.seed,
        profile=session.assembly.hardware.profile.name,
        planner=lab.planner_name,
        degree_of_parallelism=lab.degree_of_parallelism,
        n_batches=float(n_batches),
        playing_s=float(playing_s),
        sample_rate_hz=measured.sample_rate_hz,
        stages=tuple(Stage.of(name, taken_s) for name, taken_s in here_s.items()),
        total=Stage.of("frame to first chunk", total_s),
        device=str(device.get("model", "")),
        mode=str(device.get("mode", "")),
        readout_s=lab.step_context.camera.readout_s,
        prepare=Stage.of("prepare", *times["prepare"]),
        start=Stage.of("start", *times["start"]),
        trigger_s=float(device.get("trigger_delay_s", 0.0)),
        planned=Stage.of("frame to tone program", total_s - rendered_s),
        n_cores=os.cpu_count() or 1,
        load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        warnings=session.assembly.hardware.warnings,
    )


def report_text(report: LatencyReport) -> list[str]:
    """The two tables and the notes that are printed."""
    return [*_chunk_table(report), "", *_light_table(report), "", *_notes(report)]


def _time(duration_s: float) -> str:
    return format_quantity(duration_s, "time") if duration_s else "-"


def _chunk_table(report: LatencyReport) -> list[str]:
    """From a frame in memory to the first chunk of samples."""
    rows = [("stage", "median", "99 %", "share")]
    for stage in (*report.stages, report.total):
        share = percent(stage.median_s / report.total.median_s, 0)
        rows.append((stage.name, _time(stage.median_s), _time(stage.p99_s), share))
    return columns(rows, right=(1, 2, 3))


def _light_table(report: LatencyReport) -> list[str]:
    """From the end of the exposure to the output; the times of the hardware are modelled."""
    parts = (
        Stage("camera read-out", 0.0, 0.0, report.readout_s),
        report.planned,
        report.prepare,
        report.start,
        Stage("trigger", 0.0, 0.0, report.trigger_s),
    )
    rows = [("to the light", "this computer", "99 %", "modelled")]
    rows += [(s.name, _time(s.median_s), _time(s.p99_s), _time(s.modelled_s)) for s in parts]
    here_s = sum(stage.median_s for stage in parts)
    rows.append(("end of exposure to light", _time(here_s), "-", _time(report.to_light_s - here_s)))
    return columns(rows, right=(1, 2, 3))


def _notes(report: LatencyReport) -> list[str]:
    """Notes below the tables: the measured stages, and the computer."""
    device = f"{report.device}, mode {report.mode}" if report.mode else report.device
    load = "" if report.load is None else f", load {report.load:.2g}"
    playing, rate = format_quantity(report.playing_s, "time"), report.sample_rate_hz
    planner = f"{report.planner}, degree of parallelism {report.degree_of_parallelism}"
    median, goal = (format_quantity(s, "time") for s in (report.total.median_s, GOAL_S))
    return [
        f"frame to first chunk: {median}; the goal is {goal}",
        f"{plural(report.n_loadings, 'loading')}, seed {report.seed}; {plural(report.n_cores, 'core')}{load}",
        f"{planner}: {report.n_batches:g} batches, played in {playing}",
        f"profile {report.profile}: {device}; first chunk at {format_quantity(rate, 'frequency')}",
        "prepare includes the driver's own rendering and the work of a simulated device",
    ]
