"""An open card, whose registers are read back, with its transfers and labseq's errors.

It uses ``spcm_core``, the lower part of the vendor's package ``spcm``, with the functions and registers of
the driver library as the manual has them. The classes on top do not check the card's real settings, and they
import matplotlib.
"""

from __future__ import annotations

import ctypes
import mmap
import threading
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, DeviceError, DeviceTimeoutError
from labseq.plugin.native import new_timer
from labseq_spcm.kernels import give, take
from labseq_spcm.library import Library, load_spcm

POLL_S: Final = 0.2e-3
"""Time between two reads of the card's status."""
TRANSFER_TIMEOUT_S: Final = 1.0
"""How much longer than at its slowest speed the bus may take, in seconds."""

NOT_LOCKED: Final = (
    "; connect the clock that reference_clock names (peak to peak 1 to 3 V as a sine, 0.3 to 3 V as a square "
    "wave), or leave reference_clock out"
)
"""Remedy where the card's PLL does not lock (levels from the manual, technical data, clock)."""


class Buffer:
    """Memory from which the card fetches samples. It grows and is kept.

    The driver library wants it to start at a page, as ``mmap`` does.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)

    def reserve(self, n_samples: int) -> NDArray[np.int16]:
        """Room for samples of both outputs, int16 (n_samples, 2). The old content is lost."""
        n_bytes = 4 * n_samples
        if len(self._memory) < n_bytes:
            self._memory = mmap.mmap(-1, -(-n_bytes // mmap.PAGESIZE) * mmap.PAGESIZE)
        return np.frombuffer(self._memory, np.int16).reshape(-1, 2)[:n_samples]


class CallLock:
    """One call of the driver library at a time, by Python's threads and by a compiled loop.

    Attributes:
        word: int64 (1,), 1 during a call. A loop in a thread of its own takes it for each of its calls by
            :func:`labseq_spcm.kernels.take`. A step that the simulated card calls within a call does not.
    """

    def __init__(self) -> None:
        self.word = np.zeros(1, np.int64)
        self._threads = threading.RLock()
        self._depth, self._timer = 0, new_timer()

    def __enter__(self) -> None:
        self._threads.acquire()
        self._depth += 1
        if self._depth == 1:
            take(self.word.ctypes.data, self._timer)

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            give(self.word.ctypes.data)
        self._threads.release()


class AwgCard:
    """An open card. Its methods may be called from several threads.

    Args:
        name: Name of the device in the profile, for messages.
        library: Where ``spcm_core`` and the card come from.
        clock: The session's time.

    Attributes:
        spcm: The vendor's package.
        library: Where the card comes from.
        n_outputs: How many outputs the card has.
        outputs: The outputs in use, in ascending order.
        lock: For calls of the driver library.

    Raises:
        DeviceError: No package or driver library, no such card, or another program holds it. Every method
            raises it if the card refuses or reads back another value than was set.
    """

    def __init__(self, name: str, library: Library, clock: Clock) -> None:
        self.name = name
        self.clock = clock
        self.spcm = spcm = load_spcm(name, library)
        self.library = library
        self.lock = CallLock()
        self.n_outputs = 2
        self.outputs: tuple[int, ...] = (0, 1)
        device_name = library.connect()
        # every slot for the card reaches 0.5 GB/s, and a NETBOX has Gigabit Ethernet
        self._slowest_bytes_per_s = 50e6 if device_name.upper().startswith("TCPIP") else 0.5e9
        self._handle: Any = spcm.spcm_hOpen(ctypes.create_string_buffer(device_name.encode()))
        if not self._handle:
            reason = self.clear_error()
            library.disconnect()
            hint = "look up its name in Spectrum's Control Center, and close other programs that use it"
            raise DeviceError(name, f"cannot open the card '{device_name}': {reason}; {hint}")

    def close(self) -> None:
        """Close the card, which goes on playing."""
        with self.lock:
            self.spcm.spcm_vClose(self._handle)
        self.library.disconnect()

    def clear_error(self, code: int = 0) -> str:
        """Read the pending error, which the driver library requires before any other call.

        Args:
            code: Return value of the refused function, named if the library has no text for it.
        """
        spcm = self.spcm
        buffer = ctypes.create_string_buffer(spcm.ERRORTEXTLEN)
        with self.lock:
            pending = spcm.spcm_dwGetErrorInfo_i32(self._handle or None, None, None, ctypes.byref(buffer))
        text = " ".join(buffer.value.decode(errors="replace").split())
        return text or self._error_name(code or pending)

    def _error_name(self, code: int) -> str:
        """The vendor's name and number of an error."""
        errors = (name for name, value in vars(self.spcm).items() if value == code and name[:4] == "ERR_")
        return f"{next(errors, 'error')} ({code:#x})"

    def _call(self, action: str, function: Callable[..., int], *arguments: Any) -> None:
        """Call a function of the driver library, and raise the error that it returns.

        Args:
            action: Name of the action, for messages.
            function: Function of ``spcm_core``.
            arguments: Its arguments after the handle.
        """
        with self.lock:  # until the error is read, the library refuses what other threads call
            code = function(self._handle, *arguments)
            reason = self.clear_error(code) if code not in (0, self.spcm.ERR_TIMEOUT) else ""
        if code == self.spcm.ERR_TIMEOUT:
            raise DeviceTimeoutError(self.name, f"{action}: the card's driver timed out", 0.0)
        if code:
            hint = NOT_LOCKED if code == self.spcm.ERR_CLOCKNOTLOCKED else ""
            raise DeviceError(self.name, f"{action}: {reason}{hint}")

    @property
    def handle(self) -> int:
        """The handle of the driver library, as an address."""
        return ctypes.cast(self._handle, ctypes.c_void_p).value or 0

    @property
    def product(self) -> str:
        """Product name, such as "M4i.6631-x8"."""
        spcm, text = self.spcm, ctypes.create_string_buffer(32)
        room = ctypes.c_uint64(len(text))
        self._call("reading the product name", spcm.spcm_dwGetParam_ptr, spcm.SPC_PCITYP, text, room)
        return text.value.decode(errors="replace")

    @property
    def serial_number(self) -> int:
        """Serial number."""
        return self.read(self.spcm.SPC_PCISERIALNO)

    @property
    def status(self) -> int:
        """The status bits."""
        return self.read(self.spcm.SPC_M2STATUS)

    @property
    def running(self) -> bool:
        """Whether it was started and has not come to its end."""
        return not self.status & self.spcm.M2STAT_CARD_READY

    @property
    def ran_dry(self) -> bool:
        """Whether a stream ended for want of samples. The manual does not say that the card is ready then."""
        return bool(self.status & self.spcm.M2STAT_DATA_OVERRUN)

    @property
    def triggered(self) -> bool:
        """Whether a trigger has come since the start."""
        return bool(self.status & self.spcm.M2STAT_CARD_TRIGGER)

    def read(self, register: int) -> int:
        """Read a register."""
        value = ctypes.c_int64()
        get = self.spcm.spcm_dwGetParam_i64
        self._call(f"reading register {register}", get, register, ctypes.byref(value))
        return value.value

    def write(self, register: int, value: int, name: str) -> None:
        """Write a register that cannot be read back."""
        self._call(f"{name} = {value}", self.spcm.spcm_dwSetParam_i64, register, value)

    def set(self, register: int, value: int, name: str, tolerance: int = 0) -> int:
        """Write a register and read it back, since the card rounds some values and snaps others.

        Args:
            register: Its number.
            value: The value to set.
            name: Its name, for messages.
            tolerance: By how much the card may round.

        Returns:
            The value that the card reads.
        """
        self.write(register, value, name)
        actual = self.read(register)
        if abs(actual - value) > tolerance:
            raise DeviceError(self.name, f"{name} was set to {value}, and the card reads {actual}")
        return actual

    def command(self, command: int, action: str) -> None:
        """Send a command, one or several M2CMD bits."""
        self._call(action, self.spcm.spcm_dwSetParam_i64, self.spcm.SPC_M2CMD, command)

    def write_setup(self) -> None:
        """Send the settings to the card. Before that, or the start, only its driver has them."""
        self.command(self.spcm.M2CMD_CARD_WRITESETUP, "writing the set-up")

    def define_transfer(self, frames: NDArray[np.int16], notify_bytes: int = 0) -> None:
        """Name the samples of the next transfer. The array must live until the transfer is over."""
        spcm, address = self.spcm, ctypes.c_void_p(frames.ctypes.data)
        kind, direction = spcm.SPCM_BUF_DATA, spcm.SPCM_DIR_PCTOCARD
        buffer = kind, direction, notify_bytes, address, 0, frames.nbytes
        self._call("naming the transfer buffer", spcm.spcm_dwDefTransfer_i64, *buffer)

    def wait_for_transfer(self, handed_bytes: int) -> None:
        """Wait until a stream's transfer has reported its first block, as M2CMD_DATA_WAITDMA does.

        The command is not used, because it cannot be interrupted.

        Args:
            handed_bytes: Bytes that the card may fetch, for the message.

        Raises:
            DeviceTimeoutError: It has not within ``TRANSFER_TIMEOUT_S``.
        """
        deadline_s = self.clock.now() + TRANSFER_TIMEOUT_S
        while not self.status & self.spcm.M2STAT_DATA_BLOCKREADY:
            if self.clock.now() > deadline_s:
                fetched = self.read(self.spcm.SPC_DATA_AVAIL_USER_LEN)
                raise self.not_fetched(fetched, handed_bytes)
            self.clock.sleep(POLL_S)

    def not_fetched(self, fetched_bytes: int, expected_bytes: int) -> DeviceTimeoutError:
        """The error of a stream that cannot be started."""
        text = f"the card fetched {fetched_bytes} of {expected_bytes} bytes, and was not started"
        hint = "use `mode: sequence`, and check the card's bus in Spectrum's Control Center"
        return DeviceTimeoutError(self.name, f"{text}; {hint}", TRANSFER_TIMEOUT_S)

    def upload(self, frames: NDArray[np.int16], poll_s: float = POLL_S) -> float:
        """Transfer samples to the on-board memory, and wait until they have arrived.

        Returns:
            Time that this took, in seconds, without naming the buffer, which pins its pages.

        Raises:
            DeviceTimeoutError: They take too long.
        """
        start_s = self.begin_upload(frames)
        self.finish_upload(frames.nbytes, poll_s)
        return self.clock.now() - start_s

    def begin_upload(self, frames: NDArray[np.int16]) -> float:
        """Begin to transfer samples to the on-board memory. The array must live until they have arrived.

        Returns:
            When it began, without the naming of the buffer.
        """
        self.define_transfer(frames)
        start_s = self.clock.now()
        self.command(self.spcm.M2CMD_DATA_STARTDMA, "upload")
        return start_s

    def finish_upload(self, n_bytes: int, poll_s: float) -> None:
        """Wait until all has arrived.

        Raises:
            DeviceTimeoutError: It takes too long.
        """
        limit_s = n_bytes / self._slowest_bytes_per_s + TRANSFER_TIMEOUT_S
        deadline_s = self.clock.now() + limit_s
        while not self.status & self.spcm.M2STAT_DATA_END:
            if self.clock.now() > deadline_s:
                raise DeviceTimeoutError(self.name, f"{n_bytes} bytes were not uploaded", limit_s)
            self.clock.sleep(poll_s)

    def stop(self) -> None:
        """Stop playing and transferring. No effect if the card does neither."""
        spcm = self.spcm
        self.command(spcm.M2CMD_CARD_STOP | spcm.M2CMD_DATA_STOPDMA, "stop")
        self._call("releasing the transfer buffer", spcm.spcm_dwInvalidateBuf, spcm.SPCM_BUF_DATA)
