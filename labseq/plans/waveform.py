"""Makes the waveform of one plan without a run, and saves its samples."""

from __future__ import annotations

import io
import re
import sys
import zipfile
from codecs import BOM_UTF8
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from labseq.assembly.occupancies import read_source
from labseq.assembly.planning import PlannedMoves, PlanRequest, plan_moves
from labseq.assembly.plugin_choice import load_plugins
from labseq.assembly.profile import choose
from labseq.config.addresses import split_overrides
from labseq.config.document import plugin_paths
from labseq.config.profile import load_profile
from labseq.errors import ConfigError, LimitError, Problem
from labseq.files import whole_file
from labseq.messages import clean, visible
from labseq.model import Plan, SegmentKind, ToneProgram
from labseq.motion import tone_program
from labseq.motion.rendering import FULL_SCALE, N_CHANNELS, Renderer
from labseq.plans.axis_statistics import AxisStatistics, measure_axes
from labseq.plans.plan_file import MAX_BYTES, read_plan
from labseq.text_files import check_output, read_bytes
from labseq.units import format_quantity, parse_quantity

DEFAULT_RATE_HZ: Final = 625e6
"""Default sample rate, from the paper's AWG."""

MAX_RATE_HZ: Final = 10e9
"""Maximum accepted sample rate, far above any AWG's."""

PLAN_SUFFIX: Final = ".json"

_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class SampleRate:
    """Samples per second and channel, the source of the rate ("" for the default), and a warning or ""."""

    hz: float
    source: str = ""
    warning: str = ""


def read_moves(
    request: PlanRequest, stdin: BinaryIO | None, announce: Callable[[float], None]
) -> tuple[PlannedMoves, dict[str, Any]]:
    """Read a plan (a file that ends in .json, or JSON on "-"), or read an occupancy and plan for it.

    Returns:
        The checked plan, and the profile that a shot was taken with, or an empty profile.
    """
    if request.occupancy == "-":
        data = (stdin or sys.stdin.buffer).read(MAX_BYTES + 1)
        if data.removeprefix(BOM_UTF8).lstrip()[:1] == b"{":
            return read_plan(data, "standard input", request, announce=announce), {}
        source = read_source("-", request.seed, io.BytesIO(data))
    elif request.occupancy.lower().endswith(PLAN_SUFFIX):
        path = Path(request.occupancy)
        data = read_bytes(path, "a plan", (PLAN_SUFFIX,), MAX_BYTES)
        return read_plan(data, visible(str(path)), request, announce=announce), {}
    else:
        source = read_source(request.occupancy, request.seed)
    return plan_moves(request, source, announce=announce), source.machine or {}


def read_sample_rate(text: str | None, request: PlanRequest, machine: dict[str, Any]) -> SampleRate:
    """Find the sample rate from the option, else from the profile, else take that of the paper.

    A profile has one if the plugin of its mobile tweezers has a setting ``sample_rate``.

    Args:
        text: Value of the option, such as "625 MHz", or None.
        request: Names the profile, if there is one.
        machine: The profile that a shot was taken with. May be empty.
    """
    if text is not None:
        return _parse(text)
    if request.profile is not None:
        return _of_profile(request.profile, request.overrides)
    rate_hz = machine.get("mobile_tweezers", {}).get("sample_rate")
    if not isinstance(rate_hz, int | float):
        return SampleRate(DEFAULT_RATE_HZ)
    return SampleRate(rate_hz, "the profile in the shot's file")


def _parse(text: str) -> SampleRate:
    option = clean(f"--sample-rate {text}")
    try:
        rate_hz = float(text) if _NUMBER.fullmatch(text) else parse_quantity(text, "frequency")
    except ValueError as error:
        raise ConfigError(Problem(visible(str(error)), option)) from error
    if not 0 < rate_hz <= MAX_RATE_HZ:
        most = format_quantity(MAX_RATE_HZ, "frequency")
        raise ConfigError(
            Problem("this is not a sample rate", option, expected=f"more than 0 Hz, at most {most}")
        )
    return SampleRate(rate_hz, option)


def _of_profile(profile: str, overrides: Sequence[str]) -> SampleRate:
    """The setting ``sample_rate`` of the mobile tweezers' plugin, if it has one."""
    _, for_profile = split_overrides(overrides)
    document, spec = load_profile(profile, overrides=for_profile)
    host = load_plugins(plugin_paths(document, spec.plugin_folders), max_wait_s=spec.timeouts.load_s)
    chosen, warning = choose(host, document, spec, "mobile_tweezers", spec.mobile_tweezers, "full")
    rate_hz = getattr(chosen.settings, "sample_rate", None)
    warning = f"mobile_tweezers: {warning}" if warning else ""
    if isinstance(rate_hz, int | float):
        return SampleRate(rate_hz, visible(str(document.path)), warning)
    return SampleRate(DEFAULT_RATE_HZ, warning=warning)


def read_batches(text: str | None, plan: Plan) -> range:
    """Read a selection of batches, which must not cut a chain of linked batches.

    Args:
        text: "2" or "1-3", counted from 0, or None for all.

    Returns:
        Their indices, from 0.

    Example:
        >>> read_batches("0-1", Plan.from_batches([([(0, 0)], [(0, 3)])] * 3))
        range(0, 2)
    """
    n = plan.n_batches
    if text is None:
        return range(n)
    option = clean(f"--batches {text}")
    expected = f"a number from 0 to {n - 1}, or a range such as 0-{n - 1}" if n > 1 else "0, the only batch"
    match = re.fullmatch(r"\s*(\d{1,6})\s*(?:-\s*(\d{1,6})\s*)?", text)
    if match is None:
        raise ConfigError(Problem("these are not batches", option, expected=expected))
    first, last = int(match[1]), int(match[2] or match[1])
    if not first <= last < n:
        raise ConfigError(Problem("there are no such batches", option, expected=expected))
    begins, ends = first, last
    while plan.linked[begins]:
        begins -= 1
    while ends + 1 < n and plan.linked[ends + 1]:
        ends += 1
    if (begins, ends) != (first, last):
        what = "this separates linked batches, between which the tweezers stay on"
        raise ConfigError(Problem(what, option, expected=f"--batches {begins}-{ends}"))
    return range(first, last + 1)


MAX_DURATION_S: Final = 60.0
"""Maximum playing time, far longer than any cycle. A longer time is a mistake and would take hours."""


@dataclass(frozen=True, slots=True)
class WaveformRequest:
    """The arguments of ``labseq waveform``, as text.

    Attributes:
        plan: The request for a plan. Its occupancy may also be a plan, as in :func:`read_moves`.
        batches: "2" or "1-3", from 0, or None for all.
        sample_rate: A frequency, or None for that of the profile.
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
        renderer: Renders the samples.
        batches: The selected batches, indices from 0.
        segments: Their segments, with the pause before each batch.
        warnings: Warnings for the user.
    """

    moves: PlannedMoves
    program: ToneProgram
    renderer: Renderer
    batches: range
    segments: range
    warnings: tuple[str, ...] = ()

    @property
    def samples(self) -> range:
        """The selected samples, counted from the start of the program."""
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
        return 2 * N_CHANNELS * len(self.samples)

    @property
    def _part(self) -> slice:
        return slice(self.segments.start, self.segments.stop)

    def statistics(self) -> tuple[AxisStatistics, AxisStatistics]:
        """Render everything once, and return the statistics of the row and the column axis."""
        return measure_axes(self.program, self.renderer, self.segments, self.moves.grid, self.moves.motion)


def plan_waveform(
    request: WaveformRequest,
    stdin: BinaryIO | None = None,
    *,
    announce: Callable[[float], None] = lambda _: None,
) -> PlannedWaveform:
    """Read or make a plan, check it as a run does, and convert it to tones.

    Args:
        request: The plan, its batches and the sample rate.
        stdin: Stream that "-" reads, or None for standard input.
        announce: Called before kernels are compiled, with roughly how long that takes in seconds.

    Raises:
        ConfigError: The request has an error, or there is nothing to play.
        PluginLoadError: A named plugin failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
        LimitError: The tones break a limit of AOD or amplifier.
    """
    from labseq.kernels.kernel import announcing

    moves, machine = read_moves(request.plan, stdin, announce)
    rate = read_sample_rate(request.sample_rate, request.plan, machine)
    if moves.plan.n_batches == 0:
        hint = "choose an occupancy and a target that need moves"
        raise ConfigError(
            Problem("there is nothing to play because the plan has no batches", moves.source, hint=hint)
        )
    batches = read_batches(request.batches, moves.plan)
    with announcing(announce):
        program = _tones(moves, request.plan)
        _refuse_slow(rate, program)
        renderer = Renderer(program, rate.hz)
    segments = [i for i in range(program.n_segments) if program.batch[i] in batches]
    played = range(segments[0], segments[-1] + 1)
    waveform = PlannedWaveform(moves, program, renderer, batches, played, tuple(filter(None, [rate.warning])))
    if not waveform.tones_on_s * rate.hz >= 1:
        what = f"there is nothing to play because tones are on for {waveform.tones_on_s} s"
        raise ConfigError(Problem(what, moves.source))
    if waveform.duration_s > MAX_DURATION_S:
        what = f"the waveform is {format_quantity(waveform.duration_s, 'time')} long"
        most = f"at most {format_quantity(MAX_DURATION_S, 'time')}"
        hint = "check the grid's spacing and the speed, or choose some of the batches with --batches"
        raise ConfigError(Problem(what, moves.source, expected=most, hint=hint))
    return waveform


def _tones(moves: PlannedMoves, request: PlanRequest) -> ToneProgram:
    try:
        return tone_program(moves.plan, moves.grid, moves.motion)
    except LimitError as error:
        if request.profile is not None:
            raise
        hint = "name the machine with --profile"
        raise LimitError(error.what, error.value, error.limit, hint) from error


def _refuse_slow(rate: SampleRate, program: ToneProgram) -> None:
    """Raise for a sample rate at which tones cannot be distinguished."""
    highest_hz = max(
        hz.max() for axis in (program.row, program.column) for hz in (axis.start_hz, axis.end_hz)
    )
    if rate.hz <= 2 * highest_hz:
        tones, sampled, least = (
            format_quantity(hz, "frequency", digits=6) for hz in (highest_hz, rate.hz, 2 * highest_hz)
        )
        what = f"tones up to {tones} cannot be sampled at {sampled}"
        raise ConfigError(Problem(what, rate.source, expected=f"more than {least}"))


FILE_CHUNK: Final = 1 << 20
"""Number of samples that are rendered and written at a time."""


def check_samples_file(path: Path) -> None:
    """Check name and folder of a file of samples before anything is planned.

    Raises:
        ConfigError: The name does not end in .npz, its folder does not exist, or the path is not an ordinary
            file.
    """
    check_output(path, "an NPZ file", ".npz")


def save_samples(path: Path, waveform: PlannedWaveform) -> None:
    """Write the samples to a file, which appears only when it is complete.

    ``numpy.load`` then gives ``samples``, int16 (2, n), channel 0 for the row axis, and the starts of batches
    and segments in samples, as in :func:`arrays_of`. The samples are rendered and written piece by piece,
    without compression because samples hardly compress.

    Args:
        path: The file. It replaces an older file.

    Raises:
        ConfigError: It cannot be written, for example to a full disk, or :func:`check_samples_file` refuses
            it.
    """
    check_samples_file(path)
    try:
        with whole_file(path) as file:
            _write(file, waveform)
    except OSError as error:
        what = f"the samples cannot be written: {error.strerror or error}"
        expected = f"{waveform.n_bytes / 1e6:.1f} MB of room and permission to write there"
        raise ConfigError(Problem(what, visible(str(path)), expected=expected)) from error


def arrays_of(waveform: PlannedWaveform) -> dict[str, NDArray[Any]]:
    """Everything except the samples. Indices of batches count from 0.

    Returns:
        Arrays by name. ``volts_per_sample``, float64 (2,), is the voltage across 50 Ohm of a sample of 1.
        ``batch``, int32 (n_batches,), are the batches. ``batch_start``, int64, is the first sample of each
        batch that has tones. Each segment has a ``segment_batch``, ``segment_kind`` (0 pause, 1 pick-up, 2
        transport, 3 drop-off) and ``segment_start``. ``sample_rate_hz`` is the sample rate.
    """
    program, segments, batches = waveform.program, waveform.segments, waveform.batches
    part = slice(segments.start, segments.stop)
    kind, batch = program.kind[part], program.batch[part]
    start = waveform.renderer.first_sample[part] - waveform.samples.start
    on = np.flatnonzero(kind != SegmentKind.IDLE)
    volts = waveform.moves.motion.rf.full_scale_v / FULL_SCALE
    return {
        "sample_rate_hz": np.array(waveform.renderer.sample_rate_hz),
        "volts_per_sample": np.full(N_CHANNELS, volts),
        "batch": np.array(batches, np.int32),
        "batch_start": start[on[np.searchsorted(batch[on], batches)]],
        "segment_batch": batch,
        "segment_kind": kind,
        "segment_start": start,
    }


def _write(file: IO[bytes], waveform: PlannedWaveform) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, values in arrays_of(waveform).items():
            with archive.open(f"{name}.npy", "w") as member:
                npy.write_array(member, values, allow_pickle=False)
        with archive.open("samples.npy", "w", force_zip64=True) as member:
            _write_samples(member, waveform)


def _write_samples(member: IO[bytes], waveform: PlannedWaveform) -> None:
    samples = waveform.samples
    shape = N_CHANNELS, len(samples)
    npy.write_array_header_1_0(member, {"descr": "<i2", "fortran_order": False, "shape": shape})
    out = np.empty(FILE_CHUNK, np.int16)
    for channel in range(N_CHANNELS):
        for start in range(samples.start, samples.stop, FILE_CHUNK):
            piece = out[: min(FILE_CHUNK, samples.stop - start)]
            waveform.renderer.write(channel, start, piece)
            member.write(piece.astype("<i2", copy=False).data)
