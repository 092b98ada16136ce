"""One simulated card behind the driver's functions, with calls, errors and time."""

from __future__ import annotations

import mmap
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, StopRequested
from labseq_spcm_sim import registers as r
from labseq_spcm_sim.faults import COPY_BYTES_PER_S, Faults
from labseq_spcm_sim.machine import Machine
from labseq_spcm_sim.modes import Buffer
from labseq_spcm_sim.output import SampleSpan
from labseq_spcm_sim.setup import M4I6631, CardModel, ErrorInfo, Number, Refusal

DRIVER_VERSION: Final = (7 << 24) | (9 << 16) | 22000
"""A version that ``spcm_core`` accepts. The vendor has no such version."""
LOG_SIZE: Final = 100_000
EDGE_V: Final = 3.3
"""Height of an LVTTL pulse at Ext0."""


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One write to a register, refused or not.

    Attributes:
        time_s: Time of the write, on the session's clock.
        register: Its number.
        value: Value that was written.
    """

    time_s: float
    register: int
    value: Number


class SimulatedCard:
    """A Spectrum M4i.6631-x8 in software, which behaves as the real one.

    It is thread-safe. Replays and transfers take as long as on a real card, but only on the session's clock.

    Args:
        clock: The session's time.
        model: Model of the card.
        serial_number: Its serial number.
        keep_history: Keep played samples until ``forget``. Otherwise each start of the card drops them, and
            nothing of a stream is kept.
        faults: Its differences from the default.

    Attributes:
        log: The latest register writes, in order.

    Example:
        >>> from labseq.testing.fakes import FakeClock
        >>> card = SimulatedCard(FakeClock())
        >>> card.write(r.SPC_AMP0, 9000), card.read(r.SPC_AMP0)
        (257, (16, 0))
        >>> card.take_error().text, card.read(r.SPC_AMP0)
        ('SPC_AMP0 (30010): value 9000 not allowed; expected 80 to 2000', (0, 1000))
    """

    def __init__(
        self,
        clock: Clock,
        *,
        model: CardModel = M4I6631,
        serial_number: int = 12345,
        keep_history: bool = True,
        faults: Faults = Faults(),  # noqa: B008 - frozen
    ) -> None:
        self.model = model
        self.log: deque[LogEntry] = deque(maxlen=LOG_SIZE)
        self._clock = clock
        self._keep_history = keep_history
        self._lock = threading.RLock()
        self._machine = Machine(model, keeps_streams=keep_history, faults=faults)
        self._faults = faults
        self._continuous: mmap.mmap | None = None
        self._error = ErrorInfo()
        self._edges_s: list[float] = []
        self._step: Callable[[], float | None] | None = None
        self._step_s = self._held_up_s = 0.0
        self._within_step_s: float | None = None
        self._is_open = False
        self._identity: dict[int, int] = {
            r.SPC_PCISERIALNO: serial_number,
            r.SPC_GETDRVVERSION: DRIVER_VERSION,
            r.SPC_GETKERNELVERSION: DRIVER_VERSION,
            r.SPC_GETDRVTYPE: 1,
        }

    # From outside: trigger input, outputs

    def trigger(self, voltage_v: float = EDGE_V) -> bool:
        """A pulse from 0 V at the input Ext0, now.

        Returns:
            Whether the card accepted it as a trigger. It does not if it is not started, not enabled, set to
            another source, or set to a level that the pulse does not cross.
        """
        with self._lock:
            return self._machine.pulse(voltage_v, self._advance())

    def trigger_at(self, time_s: float) -> None:
        """A pulse of 3.3 V at the input Ext0 at a time, now or later."""
        with self._lock:
            self._edges_s.append(time_s)
            self._edges_s.sort()

    def call(self, step: Callable[[], float | None] | None) -> None:
        """Call a step of the driver's whenever it is due, as a thread would, for virtual clocks.

        Args:
            step: Returns after how many seconds it is due again, None if never. None stops the steps.
        """
        with self._lock:
            now_s = self._now() if step is None else self._advance()  # everything due until now first
            self._step, self._step_s = step, max(now_s, self._held_up_s)

    def hold_up(self, duration_s: float) -> None:
        """Call no step for some time from now on, as if the computer were busy with something else."""
        with self._lock:
            self._step_s = self._held_up_s = self._advance() + duration_s

    def played(self, channel: int) -> list[SampleSpan]:
        """The output of a channel up to now, in time's order. Between the spans there is silence."""
        with self._lock:
            return self._machine.played(channel, self._advance())

    def forget(self, before_s: float) -> None:
        """Drop samples played before a time, to free memory in long runs."""
        with self._lock:
            self._advance()
            self._machine.forget(before_s)

    @property
    def memory(self) -> NDArray[np.int16]:
        """The on-board memory as far as it is set up, int16 (n_samples, n_channels), a copy."""
        with self._lock:
            self._advance()
            setup = self._machine.setup
            return self._machine.memory.read(setup[r.SPC_MEMSIZE], len(setup.channels)).copy()

    @property
    def levels(self) -> tuple[float, float]:
        """Bytes of a stream that wait in the computer, and on the card with its output FIFO."""
        with self._lock:
            self._advance()
            fifo = self._machine.fifo
            return (0.0, 0.0) if fifo is None else fifo.levels

    @property
    def running(self) -> bool:
        """Whether it is started and has not come to its end."""
        with self._lock:
            self._advance()
            return self._machine.running

    @property
    def outputs_on(self) -> tuple[bool, ...]:
        """Whether the output relay of each channel is closed."""
        with self._lock:
            return tuple(amplifier.enabled for amplifier in self._machine.amplifiers)

    # Functions of the driver library, most of which return the vendor's error code

    def acquire(self) -> bool:
        """Open it for its only owner. False if it has one."""
        with self._lock:
            is_free, self._is_open = not self._is_open, True
            return is_free

    def release(self) -> None:
        """Close the card. Transfers end, everything else continues."""
        with self._lock:
            self._machine.stop_dma(self._advance())
            self._machine.buffer = None
            self._is_open = False

    @property
    def step_time_s(self) -> float:
        """The time of the step that is being called, else the clock's."""
        return self._now()

    def _now(self) -> float:
        return self._clock.now() if self._within_step_s is None else self._within_step_s

    def _do_steps(self, now_s: float) -> None:
        """Call the steps that are due by now, each at its time."""
        while self._step is not None and self._step_s <= now_s:
            self._within_step_s = self._step_s
            try:
                pause_s = self._step()
            finally:
                self._within_step_s = None
            if pause_s is None:
                self._step = None
            else:
                self._step_s += pause_s

    def _advance(self) -> float:
        now_s = self._now()
        if self._within_step_s is None:
            self._do_steps(now_s)
        while self._edges_s and self._edges_s[0] <= now_s:
            edge_s = self._edges_s.pop(0)
            self._machine.advance(edge_s)
            self._machine.pulse(EDGE_V, edge_s)
        self._machine.advance(now_s)
        return now_s

    def _refused(self, refusal: Refusal, register: int, value: Number) -> int:
        where = f"{r.NAMES.get(register, 'register')} ({register})"
        self._error = ErrorInfo(refusal.code, register, value, f"{where}: {refusal.text}")
        return refusal.code

    def break_down(self, reason: str) -> None:
        """Lock the driver because of a fault of the simulator."""
        with self._lock:
            self._error = ErrorInfo(r.ERR_INTERNAL_ERROR, text=f"fault of the simulator: {reason}")

    def take_error(self) -> ErrorInfo:
        """The error that locks the driver, which unlocks it."""
        with self._lock:
            error, self._error = self._error, ErrorInfo()
            return error

    def write(self, register: int, value: Number) -> int:
        """Write one register."""
        if register == r.SPC_DATA_AVAIL_CARD_LEN and self._faults.copies_samples:
            self._take(int(value) / COPY_BYTES_PER_S)
        return self.write_all([(register, value)])

    def _take(self, duration_s: float) -> None:
        """Take the time that a call takes."""
        with suppress(StopRequested):  # nothing may pass through C, so the caller's next wait raises it
            self._clock.sleep(duration_s)

    def write_all(self, writes: Iterable[tuple[int, Number]]) -> int:
        """Write registers one after the other, up to the first that is refused."""
        code = self._write_all(writes)
        busy_s, self._machine.busy_s = self._machine.busy_s, 0.0
        if busy_s:
            with suppress(StopRequested):  # nothing may pass through C, so the caller's next wait raises it
                self._clock.sleep(busy_s)
        return code

    def _write_all(self, writes: Iterable[tuple[int, Number]]) -> int:
        with self._lock:
            if self._error.code:
                return r.ERR_LASTERR
            now_s = self._advance()
            for register, value in writes:
                self.log.append(LogEntry(now_s, register, value))
                if register == r.SPC_M2CMD and int(value) & r.M2CMD_CARD_START and not self._keep_history:
                    self._machine.forget(now_s)
                try:
                    self._machine.write(register, value, now_s)
                except Refusal as refusal:
                    return self._refused(refusal, register, value)
            return r.ERR_OK

    def read(self, register: int) -> tuple[int, Number]:
        """Read one register. Returns the error code and the value."""
        with self._lock:
            if self._error.code:
                return r.ERR_LASTERR, 0
            self._advance()
            try:
                if register in self._identity:
                    return r.ERR_OK, self._identity[register]
                return r.ERR_OK, self._machine.read(register)
            except Refusal as refusal:
                return self._refused(refusal, register, 0), 0

    def define_transfer(self, kind: int, direction: int, offset: int, buffer: Buffer) -> int:
        """Name the buffer of the next transfer."""
        self._take(self._faults.pinning_s)
        with self._lock:
            if self._error.code:
                return r.ERR_LASTERR
            self._advance()
            try:
                buffer.check(kind, direction, offset)
                self._machine.define_transfer(buffer)
            except Refusal as refusal:
                return self._refused(refusal, 0, buffer.n_bytes)
            return r.ERR_OK

    def continuous_buffer(self) -> tuple[int, int]:
        """Address and length of the driver's continuous buffer, 0 and 0 if none was set up."""
        n_bytes = self.model.continuous_bytes
        if n_bytes and self._continuous is None:
            self._continuous = mmap.mmap(-1, n_bytes)
            self._machine.continuous = np.frombuffer(self._continuous, np.uint8).ctypes.data
        return self._machine.continuous, n_bytes

    def invalidate(self) -> int:
        """Forget the transfer buffer. By the manual, a command must stop the transfer before."""
        with self._lock:
            if self._error.code:
                return r.ERR_LASTERR
            self._advance()
            if self._machine.is_transferring:
                return self._refused(Refusal(r.ERR_SEQUENCE, "the buffer is in use"), r.SPC_M2CMD, 0)
            self._machine.buffer = None
            return r.ERR_OK
