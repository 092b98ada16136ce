"""An open card: registers that are read back, transfers, and errors as labseq raises them.

Of the package ``spcm`` only ``Card`` and its registers are used. Its classes for channels, clock,
transfers and DDS do not check what the card really set; the README lists their faults.
"""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, DeviceError, DeviceTimeoutError
from labseq_spcm.library import Library, load_spcm

POLL_S: Final = 0.2e-3
"""Time between two reads of the card's status."""
TRANSFER_TIMEOUT_S: Final = 1.0
"""How much longer than at its slowest speed the bus may take, in seconds."""


class Buffer:
    """Memory from which the card fetches samples; it grows and is kept.

    The driver library wants it to start at a page, as ``mmap`` does.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)

    def reserve(self, n_samples: int) -> NDArray[np.int16]:
        """Room for samples of both outputs, int16 (n_samples, 2); the old content is lost."""
        n_bytes = 4 * n_samples
        if len(self._memory) < n_bytes:
            self._memory = mmap.mmap(-1, -(-n_bytes // mmap.PAGESIZE) * mmap.PAGESIZE)
        return np.frombuffer(self._memory, np.int16).reshape(-1, 2)[:n_samples]


class AwgCard:
    """An open card.

    Args:
        name: Name of the device in the profile, for messages.
        library: Where ``spcm`` and the card come from.
        clock: The session's time.

    Attributes:
        spcm: The vendor's package.
        library: Where the card comes from.

    Raises:
        DeviceError: No package or driver library, no such card, or another program holds it. Every method
            raises it if the card refuses or reads back another value than was set.
    """

    def __init__(self, name: str, library: Library, clock: Clock) -> None:
        self.name = name
        self.clock = clock
        self.spcm = spcm = load_spcm(name, library)
        self.library = library
        identifier = library.connect()
        self._card: Any = spcm.Card(identifier)
        try:
            self._card.open()
        except spcm.SpcmException as error:
            reason = self._open_error() or str(error)
            self._forget()
            hint = "see its name in Spectrum's Control Center, and close what else uses it"
            raise DeviceError(name, f"cannot open the card '{identifier}': {reason}; {hint}") from error

    def _open_error(self) -> str:
        """Why the driver library did not open the card; ``spcm`` does not ask."""
        text = ctypes.create_string_buffer(self.spcm.ERRORTEXTLEN)
        self.spcm.spcm_dwGetErrorInfo_i32(None, None, None, ctypes.byref(text))
        return text.value.decode(errors="replace")

    def _forget(self) -> None:
        """Keep ``spcm`` from closing the handle again when it collects the object, which would fail."""
        vars(self._card)["_closed"] = True
        self.library.disconnect()

    def close(self) -> None:
        """Close the card; errors of a card that is gone are ignored."""
        with suppress(self.spcm.SpcmException, self.spcm.SpcmTimeout):
            self.clear_error()
            self._card.close()
        self._forget()

    @contextmanager
    def _translated_errors(self, action: str) -> Generator[None]:
        try:
            yield
        except self.spcm.SpcmTimeout as error:
            raise DeviceTimeoutError(self.name, f"{action}: the card's driver timed out", 0.0) from error
        except self.spcm.SpcmException as error:
            raise DeviceError(self.name, f"{action}: {error}") from error

    @property
    def handle(self) -> int:
        """The handle of the driver library, as an address."""
        return ctypes.cast(self._card.handle(), ctypes.c_void_p).value or 0

    @property
    def product(self) -> str:
        """Product name, such as "M4i.6631-x8"."""
        return str(self._card.product_name())

    @property
    def serial_number(self) -> int:
        """Serial number."""
        return int(self._card.sn())

    @property
    def status(self) -> int:
        """The status bits."""
        return self.read(self.spcm.SPC_M2STATUS)

    @property
    def running(self) -> bool:
        """Whether it was started and has not come to its end."""
        return not self.status & self.spcm.M2STAT_CARD_READY

    @property
    def triggered(self) -> bool:
        """Whether a trigger has come since the start."""
        return bool(self.status & self.spcm.M2STAT_CARD_TRIGGER)

    def clear_error(self) -> str:
        """Read the pending error: until then the driver library refuses every other call."""
        return str(self._card.get_error_info())

    def read(self, register: int) -> int:
        """Read a register."""
        with self._translated_errors(f"reading register {register}"):
            return int(self._card.get_i(register))

    def write(self, register: int, value: int, name: str) -> None:
        """Write a register that cannot be read back."""
        with self._translated_errors(f"{name} = {value}"):
            self._card.set_i(register, value)

    def set(self, register: int, value: int, name: str, tolerance: int = 0) -> int:
        """Write a register and read it back: the card rounds some values and snaps others.

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

    def write_list(self, entries: NDArray[np.void], action: str) -> None:
        """Write many registers in one call; ``spcm``'s own ``register_list`` overruns its 1024 entries.

        Args:
            entries: (n,), as the driver library's ``ST_LIST_PARAM``: register, type, value.
            action: What it does, for messages.
        """
        address = ctypes.c_void_p(entries.ctypes.data)
        with self._translated_errors(action):
            self._card.set_ptr(self.spcm.SPC_REGISTER_LIST, address, entries.nbytes)

    def command(self, command: int, action: str) -> None:
        """Send a command, one or several M2CMD bits."""
        with self._translated_errors(action):
            self._card.set_i(self.spcm.SPC_M2CMD, command)

    def write_setup(self) -> None:
        """Send the settings to the card: until then, or until the start, only its driver has them."""
        self.command(self.spcm.M2CMD_CARD_WRITESETUP, "writing the set-up")

    def define_transfer(self, frames: NDArray[np.int16], notify_bytes: int = 0) -> None:
        """Name the samples of the next transfer; the array must live until the transfer is over."""
        spcm, address = self.spcm, ctypes.c_void_p(frames.ctypes.data)
        kind, direction = spcm.SPCM_BUF_DATA, spcm.SPCM_DIR_PCTOCARD
        handle = self._card.handle()
        if spcm.spcm_dwDefTransfer_i64(handle, kind, direction, notify_bytes, address, 0, frames.nbytes):
            raise DeviceError(self.name, f"naming the transfer buffer: {self.clear_error()}")

    def upload(self, frames: NDArray[np.int16], poll_s: float = POLL_S) -> None:
        """Transfer samples to the on-board memory, and wait until they have arrived."""
        self.define_transfer(frames)
        self.command(self.spcm.M2CMD_DATA_STARTDMA, "upload")
        limit_s = frames.nbytes / 0.5e9 + TRANSFER_TIMEOUT_S  # every slot for the card reaches 0.5 GB/s
        text = f"{frames.nbytes} bytes were not uploaded"
        self.wait_until(lambda: bool(self.status & self.spcm.M2STAT_DATA_END), text, limit_s, poll_s)

    def wait_until(
        self,
        is_done: Callable[[], bool],
        text: str,
        limit_s: float = TRANSFER_TIMEOUT_S,
        poll_s: float = POLL_S,
    ) -> None:
        """Wait for something that the card does by itself.

        Raises:
            DeviceTimeoutError: It takes too long; with this text.
        """
        deadline_s = self.clock.now() + limit_s
        while not is_done():
            if self.clock.now() > deadline_s:
                raise DeviceTimeoutError(self.name, text, limit_s)
            self.clock.sleep(poll_s)

    def stop(self) -> None:
        """Stop playing and transferring; no effect if it does neither."""
        spcm = self.spcm
        self.command(spcm.M2CMD_CARD_STOP | spcm.M2CMD_DATA_STOPDMA, "stop")
        if spcm.spcm_dwInvalidateBuf(self._card.handle(), spcm.SPCM_BUF_DATA):
            raise DeviceError(self.name, f"releasing the transfer buffer: {self.clear_error()}")
