"""An open card: registers that are read back, transfers, and errors as labseq raises them.

The lower part of the vendor's package ``spcm``, ``spcm_core``, has the functions and registers of the driver
library, as the manual has them. The classes on top do not check what the card really set, and import
matplotlib.
"""

from __future__ import annotations

import ctypes
import mmap
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
        library: Where ``spcm_core`` and the card come from.
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
        device_name = library.connect()
        self._handle: Any = spcm.spcm_hOpen(ctypes.create_string_buffer(device_name.encode()))
        if not self._handle:
            reason = self.clear_error()
            library.disconnect()
            hint = "see its name in Spectrum's Control Center, and close what else uses it"
            raise DeviceError(name, f"cannot open the card '{device_name}': {reason}; {hint}")

    def close(self) -> None:
        """Close the card; what it does goes on."""
        self.spcm.spcm_vClose(self._handle)
        self.library.disconnect()

    def clear_error(self) -> str:
        """Read the pending error: until then the driver library refuses every other call."""
        text = ctypes.create_string_buffer(self.spcm.ERRORTEXTLEN)
        self.spcm.spcm_dwGetErrorInfo_i32(self._handle or None, None, None, ctypes.byref(text))
        return " ".join(text.value.decode(errors="replace").split())

    def _check(self, code: int, action: str) -> None:
        """Raise the error that a function of the driver library has returned."""
        if code == self.spcm.ERR_TIMEOUT:
            raise DeviceTimeoutError(self.name, f"{action}: the card's driver timed out", 0.0)
        if code:
            raise DeviceError(self.name, f"{action}: {self.clear_error()}")

    @property
    def handle(self) -> int:
        """The handle of the driver library, as an address."""
        return ctypes.cast(self._handle, ctypes.c_void_p).value or 0

    @property
    def product(self) -> str:
        """Product name, such as "M4i.6631-x8"."""
        spcm, text = self.spcm, ctypes.create_string_buffer(32)
        code = spcm.spcm_dwGetParam_ptr(self._handle, spcm.SPC_PCITYP, text, ctypes.c_uint64(len(text)))
        self._check(code, "reading the product name")
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
    def triggered(self) -> bool:
        """Whether a trigger has come since the start."""
        return bool(self.status & self.spcm.M2STAT_CARD_TRIGGER)

    def read(self, register: int) -> int:
        """Read a register."""
        value = ctypes.c_int64()
        code = self.spcm.spcm_dwGetParam_i64(self._handle, register, ctypes.byref(value))
        self._check(code, f"reading register {register}")
        return value.value

    def write(self, register: int, value: int, name: str) -> None:
        """Write a register that cannot be read back."""
        self._check(self.spcm.spcm_dwSetParam_i64(self._handle, register, value), f"{name} = {value}")

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

    def command(self, command: int, action: str) -> None:
        """Send a command, one or several M2CMD bits."""
        self._check(self.spcm.spcm_dwSetParam_i64(self._handle, self.spcm.SPC_M2CMD, command), action)

    def write_setup(self) -> None:
        """Send the settings to the card: until then, or until the start, only its driver has them."""
        self.command(self.spcm.M2CMD_CARD_WRITESETUP, "writing the set-up")

    def define_transfer(self, frames: NDArray[np.int16], notify_bytes: int = 0) -> None:
        """Name the samples of the next transfer; the array must live until the transfer is over."""
        spcm, address = self.spcm, ctypes.c_void_p(frames.ctypes.data)
        kind, direction = spcm.SPCM_BUF_DATA, spcm.SPCM_DIR_PCTOCARD
        self._check(
            spcm.spcm_dwDefTransfer_i64(
                self._handle, kind, direction, notify_bytes, address, 0, frames.nbytes
            ),
            "naming the transfer buffer",
        )

    def upload(self, frames: NDArray[np.int16], poll_s: float = POLL_S) -> None:
        """Transfer samples to the on-board memory, and wait until they have arrived.

        Raises:
            DeviceTimeoutError: They take too long.
        """
        self.begin_upload(frames)
        self.finish_upload(frames.nbytes, poll_s)

    def begin_upload(self, frames: NDArray[np.int16]) -> None:
        """Begin to transfer samples to the on-board memory; the array must live until they have arrived."""
        self.define_transfer(frames)
        self.command(self.spcm.M2CMD_DATA_STARTDMA, "upload")

    def finish_upload(self, n_bytes: int, poll_s: float) -> None:
        """Wait until all has arrived.

        Raises:
            DeviceTimeoutError: It takes too long.
        """
        limit_s = n_bytes / 0.5e9 + TRANSFER_TIMEOUT_S  # every slot for the card reaches 0.5 GB/s
        deadline_s = self.clock.now() + limit_s
        while not self.status & self.spcm.M2STAT_DATA_END:
            if self.clock.now() > deadline_s:
                raise DeviceTimeoutError(self.name, f"{n_bytes} bytes were not uploaded", limit_s)
            self.clock.sleep(poll_s)

    def stop(self) -> None:
        """Stop playing and transferring; no effect if it does neither."""
        spcm = self.spcm
        self.command(spcm.M2CMD_CARD_STOP | spcm.M2CMD_DATA_STOPDMA, "stop")
        code = spcm.spcm_dwInvalidateBuf(self._handle, spcm.SPCM_BUF_DATA)
        self._check(code, "releasing the transfer buffer")
