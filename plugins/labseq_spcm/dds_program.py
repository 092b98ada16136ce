"""Tone programs in the words of the card's DDS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import AxisTones, ConfigError, LimitError, MotionSpec, ToneProgram
from labseq_spcm import limits
from labseq_spcm.settings import SpcmSettings

ENTRY: Final = np.dtype([("register", "<i4"), ("type", "<i4"), ("value", "<i8")])
"""The driver's ``ST_LIST_PARAM``; the value is an integer or, by its type, a double."""
TYPE_INT64: Final = 0
TYPE_DOUBLE: Final = 1

FIXED: Final = (*range(8), *range(12, 20))
"""Cores of output 0."""
FLEXIBLE: Final = (8, 9, 10, 11)
"""Cores of either output, but all of the same."""
LONE: Final = (20,)
"""The core of output 1."""


@dataclass(frozen=True, slots=True)
class Cores:
    """Which cores drive which axis.

    Attributes:
        row: Cores of the row axis.
        column: Cores of the column axis.
        masks: The same by output, as the card wants it.
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    masks: tuple[int, int]


def choose_cores(name: str, settings: SpcmSettings, motion: MotionSpec) -> Cores:
    """Share the cores out to the outputs.

    Raises:
        ConfigError: The profile allows more tones than the outputs have cores.
    """
    most = [motion.max_row_tones, motion.max_column_tones]
    if settings.row_channel == 1:
        most.reverse()
    shared = [(FIXED, FLEXIBLE + LONE), (tuple(sorted(FIXED + FLEXIBLE)), LONE)]
    for first, second in shared:
        if most[0] <= len(first) and most[1] <= len(second):
            cores = np.array(first), np.array(second)
            masks = sum(1 << core for core in first), sum(1 << core for core in second)
            row = settings.row_channel
            return Cores(cores[row], cores[1 - row], masks)
    axes = ("max_row_tones", "max_column_tones")
    first, second = axes if settings.row_channel == 0 else axes[::-1]
    asked = f"{axes[0]} is {motion.max_row_tones} and {axes[1]} {motion.max_column_tones}"
    has = "the card's DDS has 20 + 1 or 16 + 5 tones on outputs 0 and 1"
    hint = f"set {first} and {second} to at most 16 and 5, or to 20 and 1"
    raise ConfigError(f"{name}: {asked}, but {has}; {hint}")


@dataclass(frozen=True, slots=True)
class Commands:
    """A program for the DDS.

    Attributes:
        entries: ``ENTRY`` (n,): the commands.
        ends: int64 (n_blocks,): where each block ends among them. A block takes effect at once.
    """

    entries: NDArray[np.void]
    ends: NDArray[np.int64]


def compile_commands(name: str, program: ToneProgram, cores: Cores) -> Commands:
    """Put a program into commands.

    Args:
        name: Name of the device, for messages.
        program: Values within limits, see :func:`labseq_spcm.limits.refuse_excess`.
        cores: Which cores there are.

    Raises:
        LimitError: It has more tones than cores, a segment that is too short for the DDS's timer,
            or a ramp that is too steep.
    """
    from labseq_spcm import _kernels_dds as kernels
    from labseq_spcm._kernels_dds_steps import COURSE_STEPS

    row, column = _tones(program.row), _tones(program.column)
    n_most = 5 * COURSE_STEPS * (row.shape[1] + column.shape[1]) + 200 * (program.n_segments + 1)
    registers, values = np.empty(n_most, np.int32), np.empty(n_most)
    ends = np.empty(COURSE_STEPS * program.n_segments + 2, np.int64)
    axes = (program.row.offsets, row, cores.row, program.column.offsets, column, cores.column)
    n_blocks = kernels.compile_program(program.duration_s, program.course, *axes, registers, values, ends)
    if n_blocks < 0:
        raise _refusal(name, program, cores, int(ends[0]), too_many=n_blocks == kernels.TOO_MANY)
    ends = ends[:n_blocks]
    registers, values = registers[: ends[-1]], values[: ends[-1]]
    kind = registers // 1000 * 1000
    slopes = (
        ("frequency", kernels.FREQUENCY_SLOPE, limits.DDS_FREQUENCY_SLOPE),
        ("amplitude", kernels.AMPLITUDE_SLOPE, limits.DDS_AMPLITUDE_SLOPE),
    )
    for what, register, most in slopes:
        steepest = float(np.abs(values[kind == register]).max(initial=0.0))
        if steepest > most:
            raise LimitError(f"{name}: slope of a tone's {what}", f"{steepest:.4g} per second", f"{most:.4g}")
    entries = np.empty(len(registers), ENTRY)
    entries["register"] = registers
    whole = (registers == kernels.SOURCE) | (registers == kernels.COMMAND)
    entries["type"] = np.where(whole, TYPE_INT64, TYPE_DOUBLE)
    entries["value"] = np.where(whole, values.astype(np.int64), values.view(np.int64))
    return Commands(entries, ends)


def _tones(axis: AxisTones) -> NDArray[np.float64]:
    turns = axis.phase_rad / (2 * np.pi)
    return np.stack([axis.start_hz, axis.end_hz, axis.start_amplitude, axis.end_amplitude, turns])


def _refusal(name: str, program: ToneProgram, cores: Cores, segment: int, *, too_many: bool) -> LimitError:
    batch = f"batch {program.batch[segment]}"
    if not too_many:
        value, limit = f"{program.duration_s[segment]:.4g} s", "83.2 ns, the DDS's shortest time"
        return LimitError(f"{name}: duration of a segment in {batch}", value, limit)
    n_row, n_column = (
        int(axis.offsets[segment + 1] - axis.offsets[segment]) for axis in (program.row, program.column)
    )
    what = f"{name}: row and column tones in {batch}"
    limit = f"{len(cores.row)} and {len(cores.column)}, the DDS's cores on these outputs"
    return LimitError(what, f"{n_row} and {n_column}", limit, "lower max_row_tones and max_column_tones")
