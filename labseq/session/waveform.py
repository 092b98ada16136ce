"""The waveform of one plan, without a run: for looking at what the AWG would play."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO, Final

from labseq.errors import ConfigError, LimitError, Problem
from labseq.model import SegmentKind, ToneProgram
from labseq.motion import Renderer, tone_program
from labseq.session.plan_inputs import PlanRequest
from labseq.session.planning import PlannedMoves
from labseq.session.waveform_inputs import SampleRate, read_batches, read_moves, read_sample_rate
from labseq.session.waveform_statistics import AxisStatistics, measure
from labseq.units import format_quantity

FRAME_BYTES: Final = 4
"""Size of a sample of both channels."""

MAX_DURATION_S: Final = 60.0
"""Far longer than any cycle; more is a mistake that would take hours to render."""


@dataclass(frozen=True, slots=True)
class WaveformRequest:
    """Which waveform, in the words of the command line.

    Attributes:
        plan: What is to be planned; or a plan: its occupancy then is a file that ends in
            .json, or "-" for standard input.
        batches: "2" or "1-3", from 1; None for all.
        sample_rate: A frequency; None for the profile's.
    """

    plan: PlanRequest
    batches: str | None = None
    sample_rate: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlannedWaveform:
    """The waveform of a checked plan, not yet rendered.

    Attributes:
        moves: The plan.
        program: Its tones.
        renderer: Makes samples of them.
        batches: The batches that are looked at, indices from 0.
        segments: Their segments, with the pause before each batch.
        warnings: What the user should know although nothing is wrong.
    """

    moves: PlannedMoves
    program: ToneProgram
    renderer: Renderer
    batches: range
    segments: range
    warnings: tuple[str, ...] = ()

    @property
    def samples(self) -> range:
        """The samples that are looked at, counted from the start of the program."""
        first, stop = self.renderer.first_sample[[self.segments.start, self.segments.stop]]
        return range(int(first), int(stop))

    @property
    def duration_s(self) -> float:
        """Playing time, pauses included."""
        return float(self.program.duration_s[self._part].sum())

    @property
    def tones_on_s(self) -> float:
        """Playing time without the pauses between batches."""
        on = self.program.kind[self._part] != SegmentKind.IDLE
        return float(self.program.duration_s[self._part][on].sum())

    @property
    def n_bytes(self) -> int:
        """Size of the samples of both channels."""
        return FRAME_BYTES * len(self.samples)

    @property
    def _part(self) -> slice:
        return slice(self.segments.start, self.segments.stop)

    def statistics(self) -> tuple[AxisStatistics, AxisStatistics]:
        """Render everything once, and say in numbers what the row and the column axis play."""
        return measure(self.program, self.renderer, self.segments, self.moves.grid, self.moves.motion)

    def as_dict(self) -> dict[str, Any]:
        """What it is, but for its statistics, SI, JSON-ready; indices of batches count from 0."""
        return {
            "source": self.moves.source,
            "planner": self.moves.planner,
            "degree_of_parallelism": self.moves.degree_of_parallelism,
            "seed": self.moves.seed,
            "first_batch": self.batches.start,
            "n_batches": len(self.batches),
            "duration_s": self.duration_s,
            "tones_on_s": self.tones_on_s,
            "sample_rate_hz": self.renderer.sample_rate_hz,
            "n_samples": len(self.samples),
            "n_bytes": self.n_bytes,
        }


def plan_waveform(
    request: WaveformRequest,
    stdin: BinaryIO | None = None,
    *,
    announce: Callable[[str], None] = lambda _: None,
) -> PlannedWaveform:
    """Read or make a plan, check it as a run does, and turn it into tones.

    Args:
        request: Which waveform.
        stdin: What "-" reads; standard input if None.
        announce: Called with the name of a module before its kernels are compiled.

    Raises:
        ConfigError: Something in the request is wrong, or there is nothing to play.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
        LimitError: The tones break a limit of AOD or amplifier.
    """
    from labseq.kernels.compile import announcing

    moves, machine = read_moves(request.plan, stdin, announce)
    rate = read_sample_rate(request.sample_rate, request.plan, machine)
    if moves.plan.n_batches == 0:
        hint = "choose an occupancy and a target that need moves"
        raise ConfigError(
            Problem("there is nothing to play: the plan has no batches", moves.source, hint=hint)
        )
    batches = read_batches(request.batches, moves.plan)
    with announcing(announce):
        program = _tones(moves, request.plan)
        _refuse_slow(rate, program)
        renderer = Renderer(program, rate.hz)
    segments = [i for i in range(program.n_segments) if program.batch[i] in batches]
    made = PlannedWaveform(
        moves,
        program,
        renderer,
        batches,
        range(segments[0], segments[-1] + 1),
        (rate.warning,) if rate.warning else (),
    )
    if not made.tones_on_s * rate.hz >= 1:
        what = f"there is nothing to play: tones are on for {made.tones_on_s} s"
        raise ConfigError(Problem(what, moves.source))
    if made.duration_s > MAX_DURATION_S:
        what = f"the waveform is {format_quantity(made.duration_s, 'time')} long"
        most = f"at most {format_quantity(MAX_DURATION_S, 'time')}"
        hint = "look at the grid's spacing and at the speed, or choose some of the batches with --batches"
        raise ConfigError(Problem(what, moves.source, expected=most, hint=hint))
    return made


def _tones(moves: PlannedMoves, request: PlanRequest) -> ToneProgram:
    try:
        return tone_program(moves.plan, moves.grid, moves.motion)
    except LimitError as error:
        if request.profile is not None:
            raise
        hint = "name the machine with --profile"
        raise LimitError(error.what, error.value, error.limit, hint) from error


def _refuse_slow(rate: SampleRate, program: ToneProgram) -> None:
    """Refuse a sample rate that tones cannot be told apart at."""
    highest_hz = max(
        hz.max() for axis in (program.row, program.column) for hz in (axis.start_hz, axis.end_hz)
    )
    if rate.hz <= 2 * highest_hz:
        tones, sampled, least = (
            format_quantity(hz, "frequency", digits=6) for hz in (highest_hz, rate.hz, 2 * highest_hz)
        )
        what = f"tones up to {tones} cannot be sampled at {sampled}"
        raise ConfigError(Problem(what, rate.source, expected=f"more than {least}"))
