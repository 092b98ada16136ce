"""Simulated cards in a process of their own, as real ones are hardware of their own: for the kill tests.

They go on after the process that uses them has died, and another process can open them then. This module is
both: the driver on such a card, and the process, ``python -m tests.plugins.card_process FOLDER``.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Listener
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
from labseq_spcm_sim import (
    M4I6631,
    ErrorInfo,
    SampleSpan,
    SimulatedCard,
    SimulatedLibrary,
    install,
    registers as r,
)
from labseq_spcm_sim.card import LogEntry
from labseq_spcm_sim.modes import Buffer
from labseq_spcm_sim.setup import Number

from labseq.plugin import Context, Emergency

from .card_process_emergency import ADDRESS, Connection

START_S: Final = 60.0
"""How long the process of the cards may take to start."""
UNUSED_S: Final = 60.0
"""After so long without any connection the process of the cards ends."""


PLUGIN: Final = """
from labseq.plugin import hookimpl
from labseq_spcm.settings import SpcmSettings
from tests.plugins.card_process import TweezersOfProcess

LABSEQ_API = 1

@hookimpl
def labseq_register(registry):
    registry.mobile_tweezers("spcm_process", TweezersOfProcess, SpcmSettings)
"""
"""For a folder of plugins: ``use: spcm_process``, where this repository is in PYTHONPATH."""


class TweezersOfProcess(SpcmMobileTweezers):
    """The driver on a card of the process: ``card: simulated@FOLDER/NAME``."""

    def __init__(self, settings: SpcmSettings, context: Context) -> None:
        super().__init__(settings, context)
        self.library = LibraryOfProcess(settings, context)


class LibraryOfProcess(SimulatedLibrary):
    """The simulator's library with a card of the process."""

    def __init__(self, settings: SpcmSettings, context: Context) -> None:
        super().__init__(settings.card, context.clock, context.simulation, settings.row_channel)
        self._path = str(Path(settings.card.partition("@")[2]).absolute())
        self._script: Path | None = None

    def connect(self) -> str:
        """Make the card available, in a new process if there is none."""
        self.card = cast("SimulatedCard", ProcessCard(self._path))
        self.wire(self.card)
        return install(self.card)

    def disconnect(self) -> None:
        """Close the connection; the card goes on."""
        card = self.card
        super().disconnect()
        if isinstance(card, ProcessCard):
            card.disconnect()

    def emergency(self, script: Path, n_outputs: int) -> Emergency | None:
        """The driver's script, unchanged, on a library whose functions ask the process."""
        own = {"script": str(script), "library": "of the simulator", "card": self._path}
        return Emergency(Path(__file__).with_name("card_process_emergency.py"), own)


class ProcessCard:
    """A card of the process. It has the methods of a ``SimulatedCard``.

    A transfer by DMA becomes a copy through a pipe, at some 1 GB/s, when samples are handed over.

    Args:
        path: Path of the card.
    """

    model = M4I6631

    def __init__(self, path: str) -> None:
        self._ask = _connected(path)
        self._buffer: Buffer | None = None
        self._n_handed = 0
        self._is_fifo = False
        self._fault = ErrorInfo()

    def acquire(self) -> bool:
        """Open it; False if another process has it open."""
        return bool(self._ask("acquire"))

    def release(self) -> None:
        """Close it; it goes on with what it does."""
        self._ask("release")

    def disconnect(self) -> None:
        """Close the connection."""
        self._ask.close()

    def write(self, register: int, value: Number) -> int:
        """Write one register; samples that a command hands over go first."""
        if register == r.SPC_DATA_AVAIL_CARD_LEN:
            self._hand_over(int(value))
        elif register == r.SPC_M2CMD and int(value) & r.M2CMD_DATA_STARTDMA and not self._is_fifo:
            self._hand_over(self._buffer.n_bytes if self._buffer else 0)
        return int(self._ask("write_all", [(register, value)]))

    def _hand_over(self, n_bytes: int) -> None:
        if self._buffer is not None and 0 < n_bytes <= self._buffer.n_bytes:
            start = self._n_handed % self._buffer.n_bytes
            self._ask("fill", start, self._buffer.fetch(start, n_bytes).tobytes())
            self._n_handed += n_bytes

    def read(self, register: int) -> tuple[int, Number]:
        """Read one register: the error code and the value."""
        code, value = self._ask("read", register)
        return code, value

    def define_transfer(self, kind: int, direction: int, offset: int, buffer: Buffer) -> int:
        """Name the buffer of the next transfer."""
        self._buffer, self._n_handed = buffer, 0
        place = buffer.address % mmap.PAGESIZE, buffer.n_bytes, buffer.notify_bytes
        code, self._is_fifo = self._ask("define_transfer", kind, direction, offset, *place)
        return int(code)

    def invalidate(self) -> int:
        """Forget the transfer buffer."""
        self._buffer = None
        return int(self._ask("invalidate"))

    def take_error(self) -> ErrorInfo:
        """The error that locks the driver, which unlocks it."""
        fault, self._fault = self._fault, ErrorInfo()
        return fault if fault.code else ErrorInfo(*self._ask("take_error"))

    def break_down(self, reason: str) -> None:
        """The process of the card does not answer, or has failed."""
        self._fault = ErrorInfo(r.ERR_INTERNAL_ERROR, text=f"fault of the simulator: {reason}")

    def trigger_at(self, time_s: float) -> None:
        """A pulse at the input Ext0 at a time of the computer's clock; lost if the card is gone."""
        with suppress(OSError, EOFError):
            self._ask("trigger_at", time_s)

    def played(self, channel: int) -> list[SampleSpan]:
        """The output of a channel up to now; see ``SimulatedCard.played``."""
        return list(self._ask("played", channel))

    def forget(self, before_s: float) -> None:
        """Drop what was played before a time."""
        self._ask("forget", before_s)


def _connected(card: str) -> Connection:
    """A connection to a card, in a new process if there is none."""
    with suppress(OSError, ValueError):
        return Connection(card)
    folder = Path(card).parent
    folder.mkdir(parents=True, exist_ok=True)
    nothing = subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(folder)],
        cwd=Path(__file__).parents[2],
        stdin=nothing,
        stdout=nothing,
        stderr=nothing,
        start_new_session=True,
    )
    threading.Thread(target=process.wait, daemon=True).start()  # its exit code is taken when it ends
    deadline_s = time.monotonic() + START_S
    while process.returncode is None and time.monotonic() < deadline_s:
        with suppress(OSError, ValueError):
            return Connection(card)
        time.sleep(5e-3)
    raise TimeoutError(f"the process of the card '{card}' does not start")


# The process of the cards


class _RealTime:
    """The computer's clock, as a session's in real time."""

    virtual = False

    def now(self) -> float:
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)

    def check(self) -> None:
        pass


class _Opened:
    """What one connection may do with a card: as its owner, or as an instrument at its connectors."""

    def __init__(self, card: SimulatedCard) -> None:
        self._card = card
        self._owns = False
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self._shift = 0

    def acquire(self) -> bool:
        self._owns = self._owns or self._card.acquire()
        return self._owns

    def release(self) -> None:
        """By the owner, or by the system when it has died."""
        if self._owns:
            self._owns = False
            self._card.release()

    def write_all(self, writes: list[tuple[int, Number]]) -> int:
        return self._card.write_all(writes) if self._owns else r.ERR_INVALIDHANDLE

    def read(self, register: int) -> tuple[int, Number]:
        return self._card.read(register) if self._owns else (r.ERR_INVALIDHANDLE, 0)

    def define_transfer(
        self, kind: int, direction: int, offset: int, shift: int, n_bytes: int, notify: int
    ) -> tuple[int, bool]:
        """A buffer as the owner's, as much off the start of a page."""
        self._memory = mmap.mmap(-1, max(1, shift + n_bytes))
        address = ctypes.addressof(ctypes.c_char.from_buffer(self._memory)) + shift
        self._shift = shift
        code = self._card.define_transfer(kind, direction, offset, Buffer(address, n_bytes, notify))
        return code, self._card._machine.fifo is not None

    def fill(self, start: int, data: bytes) -> None:
        """Samples of the owner's buffer, from byte ``start`` on and around its end."""
        memory = np.frombuffer(self._memory, np.uint8)[self._shift :]
        new = np.frombuffer(data, np.uint8)
        head = min(len(new), len(memory) - start)
        memory[start : start + head] = new[:head]
        memory[: len(new) - head] = new[head:]

    def invalidate(self) -> int:
        return self._card.invalidate()

    def take_error(self) -> tuple[int, int, Number, str]:
        error = self._card.take_error()
        return error.code, error.register, error.value, error.text

    # Instruments: they need not own the card

    def played(self, channel: int) -> list[SampleSpan]:
        return self._card.played(channel)

    def forget(self, before_s: float) -> None:
        self._card.forget(before_s)

    def state(self) -> tuple[bool, tuple[bool, ...]]:
        """Whether it runs, and whether its output relays are closed."""
        return self._card.running, self._card.outputs_on

    def log(self) -> list[LogEntry]:
        return list(self._card.log)

    def trigger(self, voltage_v: float) -> bool:
        return self._card.trigger(voltage_v)

    def trigger_at(self, time_s: float) -> None:
        self._card.trigger_at(time_s)


class _Computer:
    """The cards of one folder."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / ADDRESS
        self._cards: dict[str, SimulatedCard] = {}
        self._lock = threading.Lock()
        self._n_connections, self._used_s = 0, time.monotonic()
        self._off = threading.Event()

    def serve(self) -> None:
        """Take connections until the cards have not been needed for some time."""
        key = secrets.token_bytes(16)
        place = tempfile.mkdtemp(prefix="labseq-") if os.name != "nt" else ""
        with Listener(f"{place}/cards" if place else None, authkey=key) as listener:
            part = self._file.with_name(f"{ADDRESS}.{os.getpid()}")
            part.touch(0o600)
            part.write_text(json.dumps({"address": listener.address, "key": key.hex()}), "utf-8")
            part.replace(self._file)
            threading.Thread(target=self._accept, args=(listener,), daemon=True).start()
            while self._n_connections or time.monotonic() - self._used_s < UNUSED_S:
                if self._off.wait(1.0):
                    break
            self._file.unlink(missing_ok=True)
        shutil.rmtree(place, ignore_errors=True)

    def _accept(self, listener: Listener) -> None:
        while True:
            with suppress(OSError, EOFError, Exception):
                connection = listener.accept()
                threading.Thread(target=self._answer, args=(connection,), daemon=True).start()

    def _answer(self, connection: Any) -> None:
        """Answer one connection until its other end is closed."""
        with self._lock:
            self._n_connections += 1
        opened: _Opened | None = None
        with suppress(EOFError, OSError):
            name = connection.recv()
            with self._lock:
                card = self._cards.setdefault(name, SimulatedCard(_RealTime()))
            opened = _Opened(card)
            while True:
                method, arguments = connection.recv()
                if method == "power_off":
                    self._off.set()
                    connection.send((True, None))
                    continue
                try:
                    connection.send((True, getattr(opened, method)(*arguments)))
                except Exception as error:  # noqa: BLE001 - the caller reports it
                    connection.send((False, repr(error)))
        if opened is not None:
            opened.release()
        with self._lock:
            self._n_connections -= 1
            self._used_s = time.monotonic()


if __name__ == "__main__":
    _Computer(Path(sys.argv[1])).serve()
