"""`labseq waveform`: the waveform of one plan, without a run."""

from __future__ import annotations

import io
import math
import re
import sys
import zipfile
from codecs import BOM_UTF8
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO, Final

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from labseq.config.addresses import split_overrides
from labseq.config.document import plugin_paths
from labseq.config.plan_file import MAX_BYTES
from labseq.config.profile import load_profile
from labseq.errors import ConfigError, LimitError, Problem
from labseq.files import whole_file
from labseq.messages import clean, visible
from labseq.model import AxisTones, MotionSpec, Plan, RfSpec, SegmentKind, SiteGrid, ToneProgram
from labseq.model.motion import LOAD_OHM
from labseq.motion import Renderer, RenderPath, drive, tone_program
from labseq.motion.axes import AXES, AxisIndex
from labseq.motion.rendering import FULL_SCALE, N_CHANNELS
from labseq.session.chosen import choose, load_plugins
from labseq.session.occupancies import read_source
from labseq.session.planning import PlannedMoves, PlanRequest, plan_moves, read_plan
from labseq.text_files import is_folder, read_bytes, something_else
from labseq.units import format_quantity, parse_quantity

DEFAULT_RATE_HZ: Final = 625e6
"""Default sample rate: that of the paper's AWG."""

MAX_RATE_HZ: Final = 10e9
"""Maximum accepted sample rate, far above that of any AWG."""

PLAN_SUFFIX: Final = ".json"

_OF_SHOT: Final = "the profile in the shot's file"
_NUMBER: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_BATCHES: Final = re.compile(r"\s*(\d{1,6})\s*(?:-\s*(\d{1,6})\s*)?")


@dataclass(frozen=True, slots=True)
class SampleRate:
    """A sample rate and its origin.

    Attributes:
        hz: Samples per second and channel.
        source: Its origin, for messages; "" for the default.
        warning: A warning for the user, or "".
    """

    hz: float
    source: str = ""
    warning: str = ""


def read_moves(
    request: PlanRequest, stdin: BinaryIO | None, announce: Callable[[str], None]
) -> tuple[PlannedMoves, dict[str, Any]]:
    """Read a plan, or read an occupancy and plan for it.

    Args:
        request: Its occupancy may be a plan: a file that ends in .json, or JSON on "-".
        stdin: What "-" reads; standard input if None.
        announce: Called with the name of a module before its kernels are compiled.

    Returns:
        The checked plan, and the profile that a shot was taken with; empty if there is none.

    Raises:
        ConfigError: The request has an error.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
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
    """Find the sample rate: the given one, else the profile's, else the paper's.

    A profile has one if the plugin of its mobile tweezers has a setting ``sample_rate``.

    Args:
        text: The given one, such as "625 MHz"; None if there is none.
        request: Names the profile, if there is one.
        machine: The profile that a shot was taken with; may be empty.

    Raises:
        ConfigError: It is no frequency, not above 0, or far too high; or the profile has an error.
    """
    if text is not None:
        return _parse(text)
    if request.profile is not None:
        return _of_profile(request.profile, request.overrides)
    rate_hz = machine.get("mobile_tweezers", {}).get("sample_rate")
    return SampleRate(rate_hz, _OF_SHOT) if isinstance(rate_hz, int | float) else SampleRate(DEFAULT_RATE_HZ)


def _parse(text: str) -> SampleRate:
    option = clean(f"--sample-rate {text}")
    try:
        rate_hz = float(text) if _NUMBER.fullmatch(text) else parse_quantity(text, "frequency")
    except ValueError as error:
        raise ConfigError(Problem(visible(str(error)), option)) from error
    if not 0 < rate_hz <= MAX_RATE_HZ:
        most = format_quantity(MAX_RATE_HZ, "frequency")
        raise ConfigError(
            Problem("this is no sample rate", option, expected=f"more than 0 Hz, at most {most}")
        )
    return SampleRate(rate_hz, option)


def _of_profile(profile: str, overrides: Sequence[str]) -> SampleRate:
    """The setting ``sample_rate`` of the mobile tweezers' plugin, if it has one."""
    _, for_profile = split_overrides(overrides)
    document, spec = load_profile(profile, beside=Path(), overrides=for_profile)
    host = load_plugins(plugin_paths(document, spec.plugin_folders), max_wait_s=spec.timeouts.load)
    chosen, warning = choose(host, document, "mobile_tweezers", spec.mobile_tweezers, "full")
    rate_hz = getattr(chosen.settings, "sample_rate", None)
    warning = f"mobile_tweezers: {warning}" if warning else ""
    if isinstance(rate_hz, int | float):
        return SampleRate(rate_hz, visible(str(document.path)), warning)
    return SampleRate(DEFAULT_RATE_HZ, warning=warning)


def read_batches(text: str | None, plan: Plan) -> range:
    """Read a selection of batches; a chain of linked batches must not be cut.

    Args:
        text: "2" or "1-3", counted from 1; None for all.
        plan: The plan.

    Returns:
        Their indices, from 0.

    Raises:
        ConfigError: It is no selection, there are no such batches, or it cuts a chain.

    Example:
        >>> read_batches("1-2", Plan.from_batches([([(0, 0)], [(0, 3)])] * 3))
        range(0, 2)
    """
    n = plan.n_batches
    if text is None:
        return range(n)
    option = clean(f"--batches {text}")
    there_are = f"a number from 1 to {n}, or two of them as in 1-{n}" if n > 1 else "1, the only one"
    match = _BATCHES.fullmatch(text)
    if match is None:
        raise ConfigError(Problem("these are no batches", option, expected=there_are))
    first, last = int(match[1]), int(match[2] or match[1])
    if not 1 <= first <= last <= n:
        raise ConfigError(Problem("there are no such batches", option, expected=there_are))
    begins, ends = first, last
    while plan.linked[begins - 1]:
        begins -= 1
    while ends < n and plan.linked[ends]:
        ends += 1
    if (begins, ends) != (first, last):
        what = "linked batches are cut, between which the tweezers stay on"
        raise ConfigError(Problem(what, option, expected=f"--batches {begins}-{ends}"))
    return range(first - 1, last)


CHUNK: Final = 1 << 18
"""Samples per chunk of the analysis: 2 MB in float64."""

BOTH: Final[tuple[AxisIndex, AxisIndex]] = (0, 1)
PATHS: Final = (RenderPath.COMB, RenderPath.BLENDED, RenderPath.DIRECT)


@dataclass(frozen=True, slots=True)
class AxisStatistics:
    """Tones, voltages and powers of one axis.

    Attributes:
        name: "row" or "column".
        max_tones: Maximum number of tones at once.
        lowest_hz: Lowest frequency of a tone.
        highest_hz: Highest frequency of a tone.
        band_hz: Lowest and highest frequency of the AOD.
        amplitude_sum: Highest sum of amplitudes, as a fraction of full scale.
        snapped_m: Maximum distance by which a tone was moved onto a comb, in the atom plane.
        peak_v: Highest voltage of a sample, across 50 Ohm, as full scale is given.
        peak_batch: Index of the batch with this sample.
        crest_factor: Highest peak over r.m.s. of the samples of a segment of transport, where
            nothing is ramped; None if all are 0.
        crest_batch: Index of the batch with this crest factor.
        mean_power_w: Mean power into 50 Ohm while tones are on.
        highest_power_w: Highest short-term mean power, from the tones' amplitudes.
        gain_db: Power gain of the amplifier between output and AOD.
        path_share: Name of each render path -> its share of the samples with tones on.
    """

    name: str
    max_tones: int
    lowest_hz: float
    highest_hz: float
    band_hz: tuple[float, float]
    amplitude_sum: float
    snapped_m: float
    peak_v: float
    peak_batch: int
    crest_factor: float | None
    crest_batch: int
    mean_power_w: float
    highest_power_w: float
    gain_db: float
    path_share: Mapping[str, float]

    @property
    def gain(self) -> float:
        """Power gain as a factor."""
        return 10 ** (self.gain_db / 10)

    @property
    def aod_peak_v(self) -> float:
        """Highest voltage behind the amplifier, across 50 Ohm."""
        return self.peak_v * math.sqrt(self.gain)

    @property
    def aod_mean_power_w(self) -> float:
        """Mean power at the AOD while tones are on."""
        return self.mean_power_w * self.gain

    @property
    def aod_highest_power_w(self) -> float:
        """Highest short-term mean power at the AOD."""
        return self.highest_power_w * self.gain

    def as_dict(self) -> dict[str, Any]:
        """Everything, SI, JSON-ready."""
        return {
            "max_tones": self.max_tones,
            "frequency_hz": [self.lowest_hz, self.highest_hz],
            "band_hz": list(self.band_hz),
            "amplitude_sum": self.amplitude_sum,
            "snapped_m": self.snapped_m,
            "peak_v": self.peak_v,
            "peak_batch": self.peak_batch,
            "aod_peak_v": self.aod_peak_v,
            "crest_factor": self.crest_factor,
            "crest_batch": self.crest_batch,
            "mean_power_w": self.mean_power_w,
            "highest_power_w": self.highest_power_w,
            "aod_mean_power_w": self.aod_mean_power_w,
            "aod_highest_power_w": self.aod_highest_power_w,
            "path_share": dict(self.path_share),
        }


def measure(
    program: ToneProgram, renderer: Renderer, segments: range, grid: SiteGrid, motion: MotionSpec
) -> tuple[AxisStatistics, AxisStatistics]:
    """Compute the statistics of the samples of some segments, chunk by chunk, one thread per axis.

    Args:
        program: The tone program.
        renderer: The renderer.
        segments: Indices of its segments; at least one has tones.
        grid: The grid of sites of the program.
        motion: How the tweezers move.

    Returns:
        The row axis and the column axis.
    """

    def of_axis(axis: AxisIndex) -> AxisStatistics:
        return _measure_axis(axis, program, renderer, segments, grid, motion)

    with ThreadPoolExecutor(len(BOTH)) as threads:
        row, column = threads.map(of_axis, BOTH)
    return row, column


def _measure_axis(
    axis: AxisIndex,
    program: ToneProgram,
    renderer: Renderer,
    segments: range,
    grid: SiteGrid,
    motion: MotionSpec,
) -> AxisStatistics:
    tones, rf = (program.row, program.column)[axis], motion.rf
    part = slice(tones.offsets[segments.start], tones.offsets[segments.stop])
    hz = np.concatenate([tones.start_hz[part], tones.end_hz[part]])
    amplitude_sum, squares = _greatest(tones, segments)
    on = [i for i in segments if program.kind[i] != SegmentKind.IDLE]
    n_samples = np.diff(renderer.first_sample)[on]
    peaks, energies = _scan(axis, renderer, on)
    volts = rf.full_scale_v / FULL_SCALE
    rms_v = volts * math.sqrt(energies.sum() / n_samples.sum())
    carries = (program.kind[on] == SegmentKind.TRANSPORT) & (energies > 0.0)
    crests = np.sqrt(np.where(carries, peaks**2 * n_samples / np.where(carries, energies, 1.0), 0.0))
    loudest, sharpest = int(peaks.argmax()), int(crests.argmax())
    shares = {p.name.lower(): n_samples[renderer.path[axis, on] == p].sum() for p in PATHS}
    return AxisStatistics(
        name=AXES[axis],
        max_tones=int(np.diff(tones.offsets)[on].max()),
        lowest_hz=float(hz.min()),
        highest_hz=float(hz.max()),
        band_hz=(rf.row_band_hz, rf.column_band_hz)[axis],
        amplitude_sum=amplitude_sum,
        snapped_m=float(np.abs(drive(grid, motion, axis).comb_error_m).max(initial=0.0)),
        peak_v=float(volts * peaks[loudest]),
        peak_batch=int(program.batch[on[loudest]]),
        crest_factor=float(crests[sharpest]) if carries.any() else None,
        crest_batch=int(program.batch[on[sharpest]]),
        mean_power_w=rms_v**2 / LOAD_OHM,
        highest_power_w=squares * _full_scale_power_w(rf),
        gain_db=rf.amplifier_gain_db,
        path_share={name: float(n / n_samples.sum()) for name, n in shares.items()},
    )


def _scan(
    axis: AxisIndex, renderer: Renderer, segments: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest absolute sample of each segment, and the sum of their squares."""
    samples, values = np.empty(CHUNK, np.int16), np.empty(CHUNK, np.float64)
    peaks, energies = np.zeros(len(segments)), np.zeros(len(segments))
    for k, i in enumerate(segments):
        first, stop = (int(n) for n in renderer.first_sample[i : i + 2])
        for start in range(first, stop, CHUNK):
            n = min(CHUNK, stop - start)
            renderer.write(axis, start, samples[:n])
            values[:n] = samples[:n]
            peaks[k] = max(peaks[k], values[:n].max(), -values[:n].min())
            energies[k] += values[:n] @ values[:n]
    return peaks, energies


def _greatest(tones: AxisTones, segments: range) -> tuple[float, float]:
    """Highest sum of amplitudes in some segments, and of their squares, which is linear in time."""
    from labseq.motion.tone_kernels import greatest_sum

    values = np.stack(
        [tones.start_hz, tones.end_hz, tones.start_amplitude, tones.end_amplitude, tones.phase_rad]
    )
    squares = np.cumsum(np.square([tones.start_amplitude, tones.end_amplitude]), axis=1)
    sums = np.diff(np.concatenate([np.zeros((2, 1)), squares], axis=1)[:, tones.offsets], axis=1)
    bounds = [tones.offsets[i : i + 2].tolist() for i in segments]
    amplitude = max(greatest_sum(values, first, last, 0.0) for first, last in bounds)
    return float(amplitude), float(sums[:, segments.start : segments.stop].max())


def _full_scale_power_w(rf: RfSpec) -> float:
    """Mean power of one tone at full scale at the output, into 50 Ohm."""
    return rf.full_scale_v**2 / (2 * LOAD_OHM)


FRAME_BYTES: Final = 4
"""Size of a sample of both channels."""

MAX_DURATION_S: Final = 60.0
"""Maximum playing time, far longer than any cycle; a longer one is a mistake and would take hours."""


@dataclass(frozen=True, slots=True)
class WaveformRequest:
    """The arguments of ``labseq waveform``, as text.

    Attributes:
        plan: The request for a plan; or a plan, if its occupancy is a file that ends in
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
        return FRAME_BYTES * len(self.samples)

    @property
    def _part(self) -> slice:
        return slice(self.segments.start, self.segments.stop)

    def statistics(self) -> tuple[AxisStatistics, AxisStatistics]:
        """Render everything once, and return the statistics of the row and the column axis."""
        return measure(self.program, self.renderer, self.segments, self.moves.grid, self.moves.motion)

    def as_dict(self) -> dict[str, Any]:
        """Everything except the statistics, SI, JSON-ready; indices of batches count from 0."""
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
    """Read or make a plan, check it as a run does, and convert it to tones.

    Args:
        request: The arguments.
        stdin: What "-" reads; standard input if None.
        announce: Called with the name of a module before its kernels are compiled.

    Raises:
        ConfigError: The request has an error, or there is nothing to play.
        PluginLoadError: A plugin that is named failed to load.
        PlanError: The planner failed, or its plan breaks a rule.
        LimitError: The tones break a limit of AOD or amplifier.
    """
    from labseq.kernel import announcing

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


SUFFIX: Final = ".npz"
FILE_CHUNK: Final = 1 << 20
"""Number of samples that are rendered and written together."""


def check_samples_file(path: Path) -> None:
    """Check name and folder of a file of samples before anything is planned.

    Raises:
        ConfigError: It has another ending than .npz, its folder does not exist, or the path
            is not an ordinary file.
    """
    name, expected = visible(str(path)), f"a file that ends in {SUFFIX}"
    if path.suffix.lower() != SUFFIX:
        raise ConfigError(Problem("this is no name of an NPZ file", name, expected=expected))
    if not is_folder(path.parent):
        folder = visible(str(path.parent))
        raise ConfigError(Problem("there is no such folder", folder, expected="one that exists"))
    if what := something_else(path):
        raise ConfigError(Problem(what, name, expected=expected))


def save_samples(path: Path, waveform: PlannedWaveform) -> None:
    """Write the samples to a file, which appears only when it is complete.

    ``numpy.load`` then gives ``samples``, int16 (2, n), channel 0 for the row axis, and, counted
    in samples, where its batches and segments start; see :func:`arrays_of`. The samples are
    rendered and written piece by piece. Nothing is compressed: samples hardly can be.

    Args:
        path: The file; an older one of that name is replaced.
        waveform: The waveform.

    Raises:
        ConfigError: It cannot be written, for example to a full disk; or :func:`check_samples_file`
            refuses it.
    """
    check_samples_file(path)
    try:
        with whole_file(path) as file:
            _write(file, waveform)
    except OSError as error:
        what = f"the samples cannot be written: {error.strerror or error}"
        expected = f"{waveform.n_bytes / 1e6:.1f} MB of room and the right to write there"
        raise ConfigError(Problem(what, visible(str(path)), expected=expected)) from error


def arrays_of(waveform: PlannedWaveform) -> Mapping[str, NDArray[Any]]:
    """Everything except the samples; indices of batches count from 0.

    Returns:
        Name -> array: ``sample_rate_hz``; ``volts_per_sample``, float64 (2,), volts across 50 Ohm of
        a sample of 1; ``batch``, int32 (n_batches,), the batches; ``batch_start``, int64, first
        sample of each that has tones; ``segment_batch``, ``segment_kind`` (0 pause, 1 pick-up,
        2 transport, 3 drop-off) and ``segment_start`` of each segment.
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
