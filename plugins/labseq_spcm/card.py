"""The card as the driver sees it: registers that are read back, and errors in labseq's words."""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Clock, DeviceError, DeviceTimeoutError

POLL_S: Final = 0.2e-3
"""How often a wait looks at the card."""
TRANSFER_TIMEOUT_S: Final = 1.0
"""How long the bus may take beyond its slowest speed."""
SLOW_BUS: Final = 0.5e9
"""Bytes per second that every slot for the card reaches."""


class Buffer:
    """Memory that the card fetches samples from; it grows and is kept.

    The driver wants it to start at a page; ``mmap`` sees to that.
    """

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self.frames = self._view()

    def _view(self) -> NDArray[np.int16]:
        return np.frombuffer(self._memory, np.int16).reshape(-1, 2)

    def reserve(self, n_samples: int) -> NDArray[np.int16]:
        """Room for samples of both outputs, int16 (n_samples, 2); what stood there is lost."""
        if len(self.frames) < n_samples:
            self._memory = mmap.mmap(-1, -(-4 * n_samples // mmap.PAGESIZE) * mmap.PAGESIZE)
            self.frames = self._view()
        return self.frames[:n_samples]


class AwgCard:
    """An open card.

    All goes through ``spcm.Card``'s registers. Its classes for channels, clock, transfer and DDS
    are left alone: they do not check what was really set, and see the README for their faults.

    Args:
        name: Name of the device in the profile, for messages.
        spcm: The vendor's package.
        identifier: Device name in the vendor's driver.
        clock: The session's time.

    Raises:
        DeviceError: There is no such card, or another program holds it.
    """

    def __init__(self, name: str, spcm: Any, identifier: str, clock: Clock) -> None:
        self.name = name
        self.spcm = spcm
        self.clock = clock
        self._card: Any = spcm.Card(identifier)
        try:
            self._card.open()
        except spcm.SpcmException as error:
            reason = self._why_not() or str(error)
            self._forget()
            hint = "see its name in Spectrum's Control Center, and close what else uses it"
            raise DeviceError(name, f"cannot open the card '{identifier}': {reason}; {hint}") from error

    def _why_not(self) -> str:
        """What the driver says about a card that it did not open; ``spcm`` does not ask for it."""
        text = ctypes.create_string_buffer(self.spcm.ERRORTEXTLEN)
        self.spcm.spcm_dwGetErrorInfo_i32(None, None, None, ctypes.byref(text))
        return text.value.decode(errors="replace")

    def _forget(self) -> None:
        """Tell ``spcm`` that the handle is gone: its own close() leaves that to a second, failing one."""
        vars(self._card)["_closed"] = True

    def close(self) -> None:
        """Close the card; the error of a card that is gone does not matter any more."""
        with suppress(self.spcm.SpcmException, self.spcm.SpcmTimeout):
            self.clear_error()
            self._card.close()
        self._forget()

    @contextmanager
    def _translated_errors(self, what: str) -> Generator[None]:
        try:
            yield
        except self.spcm.SpcmTimeout as error:
            raise DeviceTimeoutError(self.name, f"{what}: the card's driver timed out", 0.0) from error
        except self.spcm.SpcmException as error:
            raise DeviceError(self.name, f"{what}: {error}") from error

    @property
    def product(self) -> str:
        """Product name, such as "M4i.6631-x8"."""
        return str(self._card.product_name())

    @property
    def serial_number(self) -> int:
        """Serial number."""
        return int(self._card.sn())

    def clear_error(self) -> str:
        """Unlock the driver: after an error it refuses every call until somebody has asked what it was."""
        return str(self._card.get_error_info())

    def read(self, register: int) -> int:
        """Read a register.

        Raises:
            DeviceError: The card refuses.
        """
        with self._translated_errors(f"reading register {register}"):
            return int(self._card.get_i(register))

    def read_real(self, register: int) -> float:
        """Read a register that holds a real number.

        Raises:
            DeviceError: The card refuses.
        """
        with self._translated_errors(f"reading register {register}"):
            return float(self._card.get_d(register))

    def write(self, register: int, value: int, what: str) -> None:
        """Write a register that cannot be read back.

        Raises:
            DeviceError: The card refuses.
        """
        with self._translated_errors(f"{what} = {value}"):
            self._card.set_i(register, value)

    def set(self, register: int, value: int, what: str, tolerance: int = 0) -> int:
        """Write a register and read it back: the card rounds some values and snaps others.

        Args:
            register: Its number.
            value: What it shall hold.
            what: Its name, for messages.
            tolerance: By how much the card may round.

        Returns:
            What it holds.

        Raises:
            DeviceError: The card refuses, or holds something else.
        """
        self.write(register, value, what)
        found = self.read(register)
        if abs(found - value) > tolerance:
            raise DeviceError(self.name, f"{what} was set to {value}, and the card reads {found}")
        return found

    def write_list(self, entries: NDArray[np.void], what: str) -> None:
        """Write many registers in one call.

        ``spcm``'s own ``register_list`` writes past its 1024 entries.

        Args:
            entries: (n,), as the driver's ``ST_LIST_PARAM``: register, type, value.
            what: What it does, for messages.

        Raises:
            DeviceError: The card refuses one; those before it are written.
        """
        address = ctypes.c_void_p(entries.ctypes.data)
        with self._translated_errors(what):
            self._card.set_ptr(self.spcm.SPC_REGISTER_LIST, address, entries.nbytes)

    def command(self, command: int, what: str) -> None:
        """Give a command.

        Raises:
            DeviceError: The card refuses.
        """
        with self._translated_errors(what):
            self._card.set_i(self.spcm.SPC_M2CMD, command)

    @property
    def status(self) -> int:
        """The status bits."""
        return self.read(self.spcm.SPC_M2STATUS)

    @property
    def running(self) -> bool:
        """Whether it was started and has not come to its end."""
        return not self.status & self.spcm.M2STAT_CARD_READY

    def define_transfer(self, frames: NDArray[np.int16], notify_bytes: int = 0) -> None:
        """Name the samples of the next transfer; they must stay where they are until it is over.

        Raises:
            DeviceError: The card refuses.
        """
        spcm = self.spcm
        address = ctypes.c_void_p(frames.ctypes.data)
        code = spcm.spcm_dwDefTransfer_i64(
            self._card.handle(),
            spcm.SPCM_BUF_DATA,
            spcm.SPCM_DIR_PCTOCARD,
            notify_bytes,
            address,
            0,
            frames.nbytes,
        )
        if code:
            raise DeviceError(self.name, f"naming the transfer buffer: {self.clear_error()}")

    def upload(self, frames: NDArray[np.int16]) -> None:
        """Transfer samples to the on-board memory, and wait until they are there.

        Raises:
            DeviceError: The card refuses.
            DeviceTimeoutError: The bus is too slow.
        """
        self.define_transfer(frames)
        self.command(self.spcm.M2CMD_DATA_STARTDMA, "upload")
        limit_s = frames.nbytes / SLOW_BUS + TRANSFER_TIMEOUT_S
        deadline_s = self.clock.now() + limit_s
        while not self.status & self.spcm.M2STAT_DATA_END:
            if self.clock.now() > deadline_s:
                raise DeviceTimeoutError(self.name, f"{frames.nbytes} bytes were not uploaded", limit_s)
            self.clock.sleep(POLL_S)

    def stop(self) -> None:
        """Stop playing and transferring; no effect if it does neither.

        Raises:
            DeviceError: The card refuses.
        """
        spcm = self.spcm
        self.command(spcm.M2CMD_CARD_STOP | spcm.M2CMD_DATA_STOPDMA, "stop")
        code = spcm.spcm_dwInvalidateBuf(self._card.handle(), spcm.SPCM_BUF_DATA)
        if code:
            raise DeviceError(self.name, f"giving the transfer buffer back: {self.clear_error()}")

    def set_all(self, values: Iterable[tuple[int, int, str]]) -> None:
        """Write registers, reading each back.

        Args:
            values: Register, value, name for messages.

        Raises:
            DeviceError: The card refuses one, or holds something else.
        """
        for register, value, what in values:
            self.set(register, value, what)
