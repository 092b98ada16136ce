"""One simulated card behind the driver's functions: calls, errors, waits, time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, LabseqError
from labseq_spcm_sim import registers as r
from labseq_spcm_sim.machine import Machine
from labseq_spcm_sim.modes import Buffer
from labseq_spcm_sim.output import Span
from labseq_spcm_sim.setup import M4I6631, CardModel, ErrorInfo, Number, Refusal

LIST_PARAM: Final = np.dtype([("register", "<i4"), ("type", "<i4"), ("value", "<i8")])
"""One entry of a register list: 16 bytes, the value an integer or a double."""


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One write to a register, refused or not.

    Attributes:
        time_s: When, on the session's clock.
        register: Its number.
        value: What was written.
    """

    time_s: float
    register: int
    value: Number


class Log:
    """The latest register writes, in order.

    The writes of one call are stored as they came, and split only when the log is read.

    Args:
        size: How many writes are kept, about.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._n = 0
        self._calls: deque[tuple[float, Sequence[int], Sequence[Number]]] = deque()

    def add(self, time_s: float, registers: Sequence[int], values: Sequence[Number]) -> None:
        """Record the writes of one call."""
        self._calls.append((time_s, registers, values))
        self._n += len(registers)
        while self._n - len(self._calls[0][1]) >= self._size:
            self._n -= len(self._calls.popleft()[1])

    def clear(self) -> None:
        """Forget everything."""
        self._calls.clear()
        self._n = 0

    def __len__(self) -> int:
        return self._n

    def __iter__(self) -> Iterator[LogEntry]:
        for time_s, registers, values in self._calls:
            for register, value in zip(registers, values, strict=True):
                yield LogEntry(time_s, register, value)


LOOK_S: Final = 0.05
"""How often a wait checks what other threads have done."""
MIN_S: Final = 1e-9
"""Shortest wait, so that time passes in spite of rounding."""
DRIVER_VERSION: Final = (7 << 24) | (9 << 16) | 22000
"""A version that ``spcm`` accepts; the vendor has no such version."""


def real_values(entries: NDArray[np.void]) -> NDArray[np.float64]:
    """The values of a register list, float64 (n,), whether they are integers or real numbers."""
    whole = entries["value"]
    return np.where(entries["type"] == r.TYPE_DOUBLE, whole.copy().view(np.float64), whole)


def list_writes(entries: NDArray[np.void]) -> Iterator[tuple[int, Number]]:
    """The (register, value) of a register list."""
    doubles: list[bool] = (entries["type"] == r.TYPE_DOUBLE).tolist()
    whole: list[int] = entries["value"].tolist()
    real: list[float] = entries["value"].copy().view(np.float64).tolist()
    registers: list[int] = entries["register"].tolist()
    for i, register in enumerate(registers):
        yield register, real[i] if doubles[i] else whole[i]


class SimulatedCard:
    """A Spectrum M4i.6631-x8 in software, which behaves as the real one.

    It is thread-safe. Time is the session's clock: replays, transfers and waits take as
    long as they would, but only on that clock.

    Args:
        clock: The session's time.
        model: What card it is.
        serial_number: Its serial number.
        log_size: How many register writes are remembered.
        keep_history: Keep what was played until ``forget``; otherwise each start of the card drops it.

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
        log_size: int = 100_000,
        keep_history: bool = True,
    ) -> None:
        self.model = model
        self.serial_number = serial_number
        self.log = Log(log_size)
        self._clock = clock
        self._keep_history = keep_history
        self._changed = threading.Condition(threading.RLock())
        self._machine = Machine(model)
        self._error = ErrorInfo()
        self._identity: dict[int, int] = {
            r.SPC_PCISERIALNO: serial_number,
            r.SPC_GETDRVVERSION: DRIVER_VERSION,
            r.SPC_GETKERNELVERSION: DRIVER_VERSION,
            r.SPC_GETDRVTYPE: 1,
        }

    # From outside: trigger input, outputs

    def trigger(self, voltage_v: float = 3.3) -> bool:
        """A pulse from 0 V at the input Ext0, now.

        Returns:
            Whether the card accepted it as a trigger; it does not if it is not started, not
            enabled, set to another source, or set to a level that the pulse does not cross.
        """
        with self._changed:
            accepted = self._machine.pulse(voltage_v, self._advance())
            self._changed.notify_all()
            return accepted

    def played(self, channel: int) -> list[Span]:
        """The output of a channel up to now, in time's order; between the spans there is silence."""
        with self._changed:
            return self._machine.played(channel, self._advance())

    def forget(self, before_s: float) -> None:
        """Drop what was played before a time, to free memory in long runs."""
        with self._changed:
            self._advance()
            self._machine.forget(before_s)

    @property
    def memory(self) -> NDArray[np.int16]:
        """The on-board memory as far as it is set up, int16 (n_samples, n_channels), a copy."""
        with self._changed:
            self._advance()
            setup = self._machine.setup
            n_channels = len(setup.channels)
            return self._machine.memory.read(setup[r.SPC_MEMSIZE], n_channels).copy()

    @property
    def running(self) -> bool:
        """Whether it is started and has not come to its end."""
        with self._changed:
            self._advance()
            return self._machine.running

    @property
    def outputs_on(self) -> tuple[bool, bool]:
        """Whether the output relays of the two channels are closed."""
        with self._changed:
            return self._machine.amplifiers[0].enabled, self._machine.amplifiers[1].enabled

    # Functions of the driver library

    def _advance(self) -> float:
        now_s = self._clock.now()
        self._machine.advance(now_s)
        return now_s

    def _refused(self, refusal: Refusal, register: int, value: Number) -> int:
        where = f"{r.NAMES.get(register, 'register')} ({register})"
        self._error = ErrorInfo(refusal.code, register, value, f"{where}: {refusal.text}")
        return refusal.code

    def break_down(self, reason: str) -> None:
        """Lock the driver because of a fault of the simulator."""
        with self._changed:
            self._error = ErrorInfo(r.ERR_INTERNAL_ERROR, text=f"fault of the simulator: {reason}")

    def take_error(self) -> ErrorInfo:
        """The error that locks the driver, which unlocks it."""
        with self._changed:
            error, self._error = self._error, ErrorInfo()
            return error

    def write(self, register: int, value: Number) -> int:
        """Write one register; returns the vendor's error code."""
        return self.write_all([(register, value)])

    def write_all(self, writes: Iterable[tuple[int, Number]]) -> int:
        """Write registers one after the other, up to the first that is refused."""
        busy_s, waits = 0.0, 0
        with self._changed:
            if self._error.code:
                return r.ERR_LASTERR
            now_s = self._advance()
            code, n_stops = r.ERR_OK, self._machine.n_stops
            for register, value in writes:
                self.log.add(now_s, [register], [value])
                try:
                    if register == r.SPC_M2CMD:
                        self._command(int(value), now_s)
                        waits |= int(value)
                        n_stops = self._machine.n_stops
                    else:
                        busy_s = max(busy_s, self._machine.write(register, value, now_s))
                except Refusal as refusal:
                    code = self._refused(refusal, register, value)
                    break
            self._changed.notify_all()
        if busy_s:
            self._pause(busy_s)
        return code or self._wait(waits, n_stops)

    def write_list(self, entries: NDArray[np.void]) -> int:
        """Write a register list, ``LIST_PARAM`` (n,); returns the vendor's error code."""
        with self._changed:
            if self._error.code:
                return r.ERR_LASTERR
            now_s, values = self._advance(), real_values(entries)
            try:
                busy_s = self._machine.dds.write_many(entries["register"], values, now_s)
            except Refusal:  # written one by one, the wrong entry is reported
                return self.write_all(list_writes(entries))
            self.log.add(now_s, entries["register"].tolist(), values.tolist())
            self._changed.notify_all()
        if busy_s:
            self._pause(busy_s)
        return r.ERR_OK

    def read(self, register: int) -> tuple[int, Number]:
        """Read one register; returns the vendor's error code and the value."""
        with self._changed:
            if self._error.code:
                return r.ERR_LASTERR, 0
            try:
                now_s = self._advance()
                if register in self._identity:
                    return r.ERR_OK, self._identity[register]
                return r.ERR_OK, self._machine.read(register, now_s)
            except Refusal as refusal:
                return self._refused(refusal, register, 0), 0

    def define_transfer(self, buffer_type: int, direction: int, buffer: Buffer) -> int:
        """Name the buffer of the next transfer; returns the vendor's error code."""
        with self._changed:
            if self._error.code:
                return r.ERR_LASTERR
            self._advance()
            try:
                buffer.check(buffer_type, direction)
                self._machine.define_transfer(buffer)
            except Refusal as refusal:
                return self._refused(refusal, 0, buffer.n_bytes)
            return r.ERR_OK

    def invalidate(self) -> int:
        """Forget the transfer buffer; returns the vendor's error code."""
        with self._changed:
            self._machine.buffer = None
            return r.ERR_LASTERR if self._error.code else r.ERR_OK

    def _command(self, command: int, now_s: float) -> None:
        machine = self._machine
        if command & r.M2CMD_DATA_STARTDMA and command & r.M2CMD_CARD_START:
            raise Refusal(r.ERR_SEQUENCE, "the card and the transfer cannot be started together")
        if command & r.M2CMD_CARD_WRITESETUP and machine.running:
            raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
        if command & r.M2CMD_CARD_START and not self._keep_history:
            machine.forget(now_s)
        actions: dict[int, Callable[[], None]] = {
            r.M2CMD_CARD_RESET: lambda: machine.reset(now_s),
            r.M2CMD_CARD_STOP: lambda: machine.stop(now_s),
            r.M2CMD_DATA_STOPDMA: lambda: machine.stop_dma(now_s),
            r.M2CMD_DATA_STARTDMA: lambda: machine.start_dma(now_s),
            r.M2CMD_CARD_START: machine.start,
            r.M2CMD_CARD_ENABLETRIGGER: lambda: machine.enable_trigger(now_s),
            r.M2CMD_CARD_FORCETRIGGER: lambda: machine.fire(now_s),
            r.M2CMD_CARD_DISABLETRIGGER: machine.disable_trigger,
        }
        for bit, action in actions.items():
            if command & bit:
                action()

    def _pause(self, duration_s: float) -> bool:
        try:
            self._clock.sleep(max(duration_s, MIN_S))
        except LabseqError:
            return False
        return True

    def _wait(self, command: int, n_stops: int) -> int:
        """Carry out the wait commands: until the event, the timeout, or a stop by another thread."""
        timeout_s = self._machine.setup[r.SPC_TIMEOUT] / 1000
        deadline_s = self._clock.now() + timeout_s if timeout_s else None
        for bit in (r.M2CMD_DATA_WAITDMA, r.M2CMD_CARD_WAITTRIGGER, r.M2CMD_CARD_WAITREADY):
            while command & bit:
                with self._changed:
                    now_s = self._advance()
                    if self._machine.n_stops != n_stops:
                        return r.ERR_ABORT
                    if self._machine.underrun:
                        lack = Refusal(
                            r.ERR_FIFOHWOVERRUN, "underrun: the output ran out of data and stopped"
                        )
                        return self._refused(lack, r.SPC_M2CMD, command)
                    done, due_s = self._machine.awaited(bit, now_s)
                    if done:
                        break
                    if deadline_s is not None and now_s >= deadline_s:
                        return r.ERR_TIMEOUT
                    known = [time_s for time_s in (due_s, deadline_s) if time_s is not None]
                    if not known:
                        self._changed.wait(LOOK_S)
                if not self._pause(min(*known, now_s + LOOK_S) - now_s if known else 0.0):
                    return r.ERR_ABORT
        return r.ERR_OK
