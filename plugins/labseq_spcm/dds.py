"""Mode ``dds``: the card generates the tones itself, from lists of register writes."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    AxisTones,
    ConfigError,
    LimitError,
    MotionSpec,
    SiteGrid,
    ToneProgram,
    TransientError,
)
from labseq.plugin.motion import FrequencyCourse
from labseq_spcm import limits
from labseq_spcm.card import POLL_S, AwgCard
from labseq_spcm.keep_warm import KeepWarm
from labseq_spcm.play_mode import PlayMode
from labseq_spcm.settings import SpcmSettings

ENTRY: Final = np.dtype([("register", "<i4"), ("type", "<i4"), ("value", "<i8")])
"""The driver library's ``ST_LIST_PARAM``; by its type the value is an integer or a double."""
TYPE_INT64: Final = 0
TYPE_DOUBLE: Final = 1

FIXED: Final = (*range(8), *range(12, 20))
"""Cores that always belong to output 0."""
FLEXIBLE: Final = (8, 9, 10, 11)
"""Cores that belong to either output, but all to the same one."""
LONE: Final = (20,)
"""The core that always belongs to output 1."""

ARRIVAL_S: Final = 20e-6
"""Latency of commands sent by DMA (EDMSuite, on an M4i.9622)."""
BEGINNING_S: Final = 1e-3
"""A program is cut after that time: making the rest takes less, even if the computer is busy."""


@dataclass(frozen=True, slots=True)
class Cores:
    """The DDS cores that drive each axis.

    Attributes:
        row: int64 (n,), cores of the row axis.
        column: int64 (n,), cores of the column axis.
        masks: The cores of output 0 and of output 1, one bit each.
        within_hz: float64 (2,), how closely a row tone and a column tone are to follow a curved course.
    """

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    masks: tuple[int, int]
    within_hz: NDArray[np.float64]

    def idle_state(self, tones: KeepWarm | None) -> NDArray[np.float64]:
        """Frequency, its slope, amplitude and its slope of each core between programs, float64 (4, n)."""
        state = np.zeros((4, len(self.row) + len(self.column)))
        if tones is not None:
            first = [0, len(self.row)]
            state[0, first], state[2, first] = tones.hz, tones.amplitude
        return state


def steps_hz(grid: SiteGrid) -> NDArray[np.float64]:
    """Change of a tone's frequency per site, float64 (2,), in Hz: of row tones, of column tones.

    An axis with a single site takes that of the other one.
    """
    row, column = (
        float(np.abs(np.diff(hz)).mean()) if len(hz) > 1 else 0.0
        for hz in (grid.row_frequency_hz, grid.column_frequency_hz)
    )
    return np.array([row or column, column or row])


def worst_distance_m(grid: SiteGrid, motion: MotionSpec) -> float:
    """Largest distance of a tweezer from its course, in metres, in moves of a whole number of sites.

    At constant speed it is 0. Otherwise the course is played in straight steps: as many as bring the
    distance to :data:`labseq_spcm.limits.FOLLOWS_M`, but no more than the rate of commands allows if all
    tones of the motion move at once.
    """
    from labseq_spcm.kernels import BENDS

    if motion.speed_profile == "constant":
        return 0.0
    bend = BENDS[FrequencyCourse[motion.speed_profile.upper()]]
    n_commands = 2 * (motion.max_row_tones + motion.max_column_tones) + 2
    n_sites = np.arange(1, max(grid.shape) + 1)
    travel_m = n_sites * grid.spacing_m
    for_distance = np.ceil(np.sqrt(bend * travel_m / (8 * limits.FOLLOWS_M)))
    by_rate = travel_m / motion.speed_m_s * limits.DDS_COMMANDS_PER_S // n_commands
    return float((bend * travel_m / (8 * np.maximum(1, np.minimum(for_distance, by_rate)) ** 2)).max())


def choose_cores(name: str, settings: SpcmSettings, motion: MotionSpec, grid: SiteGrid) -> Cores:
    """Assign the cores to the outputs.

    Raises:
        ConfigError: The profile allows more tones than the outputs have cores.
    """
    row = settings.row_channel
    n_tones = [motion.max_row_tones, motion.max_column_tones]
    n_first, n_second = n_tones if row == 0 else n_tones[::-1]
    for first, second in (FIXED, FLEXIBLE + LONE), (tuple(sorted(FIXED + FLEXIBLE)), LONE):
        if n_first <= len(first) and n_second <= len(second):
            cores = np.array(first), np.array(second)
            masks = sum(1 << core for core in first), sum(1 << core for core in second)
            within_hz = steps_hz(grid) * limits.FOLLOWS_M / grid.spacing_m
            return Cores(cores[row], cores[1 - row], masks, within_hz)
    names = ("max_row_tones", "max_column_tones")
    first_name, second_name = names if row == 0 else names[::-1]
    raise ConfigError(
        f"{name}: {names[0]} is {n_tones[0]} and {names[1]} {n_tones[1]}, but the card's DDS has 20 + 1 or"
        f" 16 + 5 tones on outputs 0 and 1; set {first_name} and {second_name} to at most 16 and 5, or to 20"
        " and 1"
    )


@dataclass(frozen=True, slots=True)
class Commands:
    """A program as DDS commands.

    Attributes:
        entries: ``ENTRY`` (n,), the commands.
        ends: int64 (n_blocks,), index after each block. All commands of a block take effect together.
    """

    entries: NDArray[np.void]
    ends: NDArray[np.int64]

    def without_end(self) -> Commands:
        """Without the last block, which switches the timer off: more blocks follow."""
        return Commands(self.entries[: self.ends[-2]], self.ends[:-1])

    def followed_by(self, rest: Commands) -> Commands:
        """These commands, then those of the rest of the program."""
        entries = np.concatenate([self.entries, rest.entries])
        return Commands(entries, np.concatenate([self.ends, len(self.entries) + rest.ends]))


def compile_commands(
    name: str, program: ToneProgram, cores: Cores, keep_warm: KeepWarm | None = None
) -> Commands:
    """Compile a program into DDS commands.

    Args:
        name: Name of the device, for messages.
        program: A program that passed :func:`labseq.plugin.motion.check_tone_program`.
        cores: The cores of each axis.
        keep_warm: The tones before and after the program; None for silence.

    Raises:
        LimitError: It has more tones than cores, a segment that is too short for the DDS's timer,
            or a slope that is too steep.
    """
    from labseq_spcm import kernels

    row, column = _tones(program.row), _tones(program.column)
    tones, both = np.hstack([row, column]), np.concatenate([cores.row, cores.column])
    offsets = np.stack([program.row.offsets, program.column.offsets + np.int32(row.shape[1])])
    n_steps = _most_steps(program, cores)
    n_most = 5 * n_steps * tones.shape[1] + 200 * (program.n_segments + 1)
    registers, values = np.empty(n_most, np.int32), np.empty(n_most)
    ends = np.empty(n_steps * program.n_segments + 2, np.int64)
    n_blocks = kernels.compile_program(
        program.duration_s, program.course, offsets, tones, both, len(cores.row),
        cores.idle_state(keep_warm), cores.within_hz, n_steps, registers, values, ends,
    )  # fmt: skip
    if n_blocks == kernels.TOO_MANY:
        raise _too_many_tones(name, program, cores, int(ends[0]))
    if n_blocks == kernels.TOO_SHORT:
        segment = int(ends[0])
        quantity = f"{name}: duration of a segment in batch {program.batch[segment]}"
        limit = "83.2 ns, the DDS's shortest time"
        raise LimitError(quantity, f"{program.duration_s[segment]:.4g} s", limit)
    ends = ends[:n_blocks]
    registers, values = registers[: ends[-1]], values[: ends[-1]]
    _check_slope(name, registers, values)
    entries = np.empty(len(registers), ENTRY)
    entries["register"] = registers
    is_integer = (registers == kernels.SOURCE) | (registers == kernels.COMMAND)
    entries["type"] = np.where(is_integer, TYPE_INT64, TYPE_DOUBLE)
    entries["value"] = np.where(is_integer, values.astype(np.int64), values.view(np.int64))
    return Commands(entries, ends)


def _most_steps(program: ToneProgram, cores: Cores) -> int:
    """The most steps that a segment of a program needs."""
    from labseq_spcm.kernels import BENDS, RAMP_STEPS

    if not program.course.any():
        return RAMP_STEPS
    longest = max(
        float(np.abs(axis.end_hz - axis.start_hz).max(initial=0.0)) / hz
        for axis, hz in zip((program.row, program.column), cores.within_hz, strict=True)
    )
    return max(RAMP_STEPS, math.ceil(math.sqrt(max(BENDS) / 8 * longest)))


def _tones(axis: AxisTones) -> NDArray[np.float64]:
    turns = axis.phase_rad / (2 * np.pi)
    return np.stack([axis.start_hz, axis.end_hz, axis.start_amplitude, axis.end_amplitude, turns])


def _check_slope(name: str, registers: NDArray[np.int32], values: NDArray[np.float64]) -> None:
    from labseq_spcm.kernels import FREQUENCY_SLOPE

    steepest = float(np.abs(values[registers // 1000 * 1000 == FREQUENCY_SLOPE]).max(initial=0.0))
    if steepest > limits.DDS_FREQUENCY_SLOPE:
        limit = f"{limits.DDS_FREQUENCY_SLOPE:.4g}"
        raise LimitError(f"{name}: slope of a tone's frequency", f"{steepest:.4g} per second", limit)


def _too_many_tones(name: str, program: ToneProgram, cores: Cores, segment: int) -> LimitError:
    n_row, n_column = (
        int(axis.offsets[segment + 1] - axis.offsets[segment]) for axis in (program.row, program.column)
    )
    quantity = f"{name}: row and column tones in batch {program.batch[segment]}"
    limit = f"{len(cores.row)} and {len(cores.column)}, the DDS's cores on these outputs"
    return LimitError(quantity, f"{n_row} and {n_column}", limit, "lower max_row_tones and max_column_tones")


class Dds(PlayMode):
    """Mode ``dds``: queues a program's blocks, of which each waits for a tick of the timer.

    Commands go to the card by DMA. Before each portion is sent the queue must have room for it; the
    rest is sent while the program plays. The card sets a flag if a block comes too late.
    With keep-warm tones the card runs between programs too: the first block of a program ends them,
    and its last but one brings them back.

    Args:
        card: The open card.
        cores: The cores of each axis.
        keep_warm: The tones between programs; None for silence.
    """

    max_wait_s = POLL_S
    beginning_s = BEGINNING_S

    def __init__(self, card: AwgCard, cores: Cores, keep_warm: KeepWarm | None) -> None:
        super().__init__(card)
        self._cores = cores
        self._keep_warm = keep_warm
        self._is_idle = False
        self._commands = Commands(np.empty(0, ENTRY), np.zeros(0, np.int64))
        self._continues = False
        self._n_sent = 0
        self._n_events = 0
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_STD_DDS, "card mode")
        card.write_setup()  # the DDS takes nothing before
        self._queue_length = card.read(spcm.SPC_DDS_QUEUE_CMD_MAX)
        self._reset()

    def _reset(self) -> None:
        """Forget all commands. The connections of the cores are read back: the card snaps wrong ones."""
        card, spcm = self._card, self._card.spcm
        card.write(spcm.SPC_DDS_CMD, spcm.SPCM_DDS_CMD_RESET, "reset of the DDS")
        card.write(spcm.SPC_DDS_CORES_ON_CH1, self._cores.masks[1], "cores of output 1")
        card.set(spcm.SPC_DDS_CORES_ON_CH0, self._cores.masks[0], "cores of output 0")
        card.set(spcm.SPC_DDS_CORES_ON_CH1, self._cores.masks[1], "cores of output 1")
        card.set(spcm.SPC_DDS_DATA_TRANSFER_MODE, spcm.SPCM_DDS_DTM_DMA, "DDS transfer mode")
        # amplitude slopes become finer, 298 / 64 per second, with fewer and larger increments
        card.set(spcm.SPC_DDS_AMP_RAMP_STEPSIZE, 64, "DDS amplitude ramp step size")

    def prepare(self, program: ToneProgram, *, continues: bool = False) -> float:
        """Compile a program, and queue its first commands; returns its playing time in seconds."""
        start_s = time.perf_counter()
        commands = compile_commands(self._card.name, program, self._cores, self._keep_warm)
        self._commands = commands.without_end() if continues else commands
        self._continues = continues
        self.render_s = time.perf_counter() - start_s
        self._n_sent = 0
        if not (self._is_idle and self._card.running):
            self.idle()
        self._is_idle = False
        self._card.wait_until(self._feed_once, "the DDS takes no commands: its queue stays full")
        self._card.clock.sleep(ARRIVAL_S + self._n_sent / limits.DDS_COMMANDS_PER_S)
        return program.total_duration_s

    def append(self, program: ToneProgram) -> float:
        """Compile the rest of a program, and queue as much of it as there is room for."""
        rest = compile_commands(self._card.name, program, self._cores, self._keep_warm)
        self._commands, self._continues = self._commands.followed_by(rest), False
        self._feed()
        return program.total_duration_s

    def idle(self) -> None:
        """Stop, forget all commands, and start the keep-warm tones if there are any."""
        from labseq_spcm import kernels

        card, spcm = self._card, self._card.spcm
        card.stop()
        self._reset()
        if self._keep_warm is None:
            return
        entries = [(kernels.SOURCE, TYPE_INT64, kernels.FROM_CARD)]
        for axis, cores in enumerate((self._cores.row, self._cores.column)):
            for register, value in (
                (kernels.FREQUENCY, self._keep_warm.hz[axis]),
                (kernels.AMPLITUDE, self._keep_warm.amplitude[axis]),
            ):
                bits = int(np.float64(value).view(np.int64))
                entries.append((register + int(cores[0]), TYPE_DOUBLE, bits))
        commands = kernels.AT_TRIGGER, spcm.SPCM_DDS_CMD_WRITE_TO_CARD
        entries += [(kernels.COMMAND, TYPE_INT64, command) for command in commands]
        card.write_list(np.array(entries, ENTRY), "keep-warm tones")
        card.clock.sleep(ARRIVAL_S)
        self._start_triggered(spcm.M2CMD_CARD_ENABLETRIGGER | spcm.M2CMD_CARD_FORCETRIGGER)
        card.command(spcm.M2CMD_CARD_DISABLETRIGGER, "disabling the trigger")
        self._is_idle = True

    def _start_triggered(self, command: int) -> None:
        """Start the card if it stands still; enable triggers only when the first block waits for one."""
        card, spcm = self._card, self._card.spcm
        if not card.running:
            card.command(spcm.M2CMD_CARD_START, "start")
        card.wait_until(
            lambda: bool(card.read(spcm.SPC_DDS_STATUS) & spcm.SPCM_DDS_STAT_WAITING_FOR_TRG),
            "the DDS waits for no trigger: its first commands have not arrived",
            poll_s=ARRIVAL_S,
        )
        card.command(command & ~spcm.M2CMD_CARD_START, "trigger")

    def start(self, command: int) -> None:
        """Start the program, and queue as much of it as there is room for."""
        self._n_events = self._card.read(self._card.spcm.SPC_DDS_TRG_COUNT)
        self._start_triggered(command)
        self._feed()

    def triggered(self) -> bool:
        """Whether the program has begun."""
        if self._keep_warm is None:
            return self._card.triggered
        return self._card.read(self._card.spcm.SPC_DDS_TRG_COUNT) > self._n_events

    def finished(self) -> bool:
        """Queue more while there is room; whether the last block took effect.

        The number of queued commands is 0 while a block still waits, so the events are counted. The card's
        count leaves out the first after a reset, which is the start of the keep-warm tones.
        """
        card, spcm = self._card, self._card.spcm
        self._feed()
        n_events = card.read(spcm.SPC_DDS_TRG_COUNT) - self._n_events
        if not self._continues and n_events >= len(self._commands.ends) - (self._keep_warm is None):
            self._is_idle = self._keep_warm is not None
            command = spcm.M2CMD_CARD_DISABLETRIGGER if self._is_idle else spcm.M2CMD_CARD_STOP
            card.command(command, "end of the program")
            return True
        too_late = spcm.SPCM_DDS_STAT_QUEUE_UNDERRUN | spcm.SPCM_DDS_STAT_QUEUE_OVERRUN
        if card.read(spcm.SPC_DDS_STATUS) & too_late:
            text = f"the DDS had no commands in time, after {n_events} of {len(self._commands.ends)} blocks"
            raise TransientError(f"{text}; use fewer tones at once, or the mode replay", card.name)
        return False

    def _feed(self) -> None:
        """Send whole blocks while the queue has room."""
        while self._feed_once():
            pass

    def _feed_once(self) -> bool:
        """Send some whole blocks if the queue has room; returns whether any were sent.

        ``spcm``'s own DDSCommandList never waits for room.
        """
        card, spcm = self._card, self._card.spcm
        entries, ends = self._commands.entries, self._commands.ends
        portion = min(1000, len(entries) - self._n_sent)  # no block has as many
        if not portion or portion > self._queue_length - card.read(spcm.SPC_DDS_QUEUE_CMD_COUNT):
            return False
        last = int(np.searchsorted(ends, self._n_sent + portion, "right")) - 1
        send = np.array([(spcm.SPC_DDS_CMD, TYPE_INT64, spcm.SPCM_DDS_CMD_WRITE_TO_CARD)], ENTRY)
        card.write_list(np.append(entries[self._n_sent : ends[last]], send), "DDS commands")
        self._n_sent = int(ends[last])
        return True
