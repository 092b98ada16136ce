"""The card while it is opened for a first contact, with a stopwatch and transfers of silence."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import Context, DeviceError, DeviceTimeoutError, Emergency, MobileTweezers
from labseq_spcm import limits
from labseq_spcm.card import AwgCard, Buffer
from labseq_spcm.library import Library
from labseq_spcm.models import ANY
from labseq_spcm.set_up import NEXT_OUTPUT, check_type, identity, set_up, switch_output
from labseq_spcm.settings import SpcmSettings

LOWEST_MV: Final = ANY.amplitude_mv[0]
"""The only amplitude of a first contact, except in the step that tries the safe ramp."""
Driver = TypeVar("Driver", bound=MobileTweezers)


class Bench:
    """One card, opened without the driver, which might refuse it.

    Args:
        settings: The settings of the driver.
        context: Name, clock, and the limits of the AODs.
        library: Where the card comes from.
    """

    def __init__(self, settings: SpcmSettings, context: Context, library: Library) -> None:
        self.name = context.name or "mobile_tweezers"
        self.settings, self.context, self.library = settings, context, library
        self._clock = context.clock
        self._card: AwgCard | None = None
        self._n_outputs = 2
        self._is_lent = False
        self._borrower: MobileTweezers | None = None

    @property
    def card(self) -> AwgCard:
        """The open card.

        Raises:
            DeviceError: It is not open.
        """
        if self._card is None:
            raise DeviceError(self.name, "not open; call open() first")
        return self._card

    def open(self) -> Mapping[str, str]:
        """Open the card, and return serial number, model, driver and firmware."""
        if self._card is None:
            card = self._card = AwgCard(self.name, self.library, self._clock)
            try:
                card.n_outputs = self._n_outputs = check_type(card, self.settings).n_outputs
                card.outputs = tuple(sorted(self.settings.outputs))
            except BaseException:
                self.close()
                raise
        return identity(self.card)

    def emergency(self, script: Path) -> Emergency | None:
        """A script that another process can run on the card, None for a card that dies with this process."""
        return self.library.emergency(script, self._n_outputs)

    def close(self) -> None:
        """Close the card, which goes on playing."""
        card, self._card = self._card, None
        if card is not None:
            card.close()

    @contextmanager
    def lent(self) -> Generator[None]:
        """Leave the card to another process, which the block must end. Then call :meth:`open_again`."""
        self.close()
        self._is_lent = True
        yield

    @contextmanager
    def lent_to(self, driver: Driver) -> Generator[Driver]:
        """Leave the card to the driver within the block."""
        self.close()
        self._borrower = driver
        try:
            yield driver
        finally:
            driver.close()
        self._borrower = None
        self.open()

    def open_again(self, within_s: float = 5.0) -> None:
        """Open the card as soon as the system has closed it for the other process.

        Raises:
            DeviceError: It cannot be opened in time, with the last reason.
        """
        until_s = self.now() + within_s
        while True:
            try:
                self.open()
            except DeviceError:
                if self.now() > until_s:
                    raise
                self.pause(1e-3)
            else:
                self._is_lent = False
                return

    def safe_state(self) -> None:
        """Stop, open the relays, and reset, all of it even after a refused step.

        Raises:
            DeviceError: The card refused its reset, or is not off after it.
        """
        if self._borrower is not None:  # a step was interrupted while the driver had the card
            self._borrower.safe_state()
        if self._is_lent:  # a step was interrupted while another process had the card
            self.open_again()
        if (card := self._card) is None:
            return
        with suppress(DeviceError):
            card.clear_error()  # an earlier call may have locked the library
        for step in (
            card.stop,
            *(partial(switch_output, card, output, on=False) for output in range(card.n_outputs)),
            card.write_setup,
        ):
            with suppress(DeviceError):  # a card whose clock has not locked refuses its set-up
                step()
        card.command(card.spcm.M2CMD_CARD_RESET, "reset")  # which disables the outputs in any case
        relay = card.spcm.SPC_ENABLEOUT0
        enabled = [output for output in range(card.n_outputs) if card.read(relay + NEXT_OUTPUT * output)]
        if enabled or card.running:
            raise DeviceError(self.name, f"after its reset the card runs, or its outputs {enabled} are on")

    def fresh(self) -> AwgCard:
        """The card after a reset, set up as the driver does it, with the lowest amplitude and open relays."""
        own_clock = self.settings.model_copy(update={"reference_clock": None})  # one step tries the reference
        set_up(self.card, own_clock, LOWEST_MV)
        return self.card

    # Time

    def now(self) -> float:
        """Time in seconds, on a real clock with the finest resolution of the computer."""
        return self._clock.now() if self._clock.virtual else time.perf_counter()

    def pause(self, duration_s: float) -> None:
        """Wait, unless a stop is requested."""
        self._clock.sleep(duration_s)

    def look_again(self, poll_s: float = 2e-6) -> None:
        """Pass the time between two looks at a register. On a real clock the read takes long enough."""
        if self._clock.virtual:
            self._clock.sleep(poll_s)
        else:
            self._clock.check()

    def timed(self, call: Callable[[], object]) -> float:
        """How long a call takes, in seconds."""
        start_s = self.now()
        call()
        return self.now() - start_s

    def until(self, condition: Callable[[], bool], limit_s: float, what: str, poll_s: float = 2e-6) -> float:
        """Wait for a condition, looking all the time, and return how long that took, in seconds.

        Raises:
            DeviceTimeoutError: It is not met within the limit. The message contains ``what``.
        """
        start_s = self.now()
        while not condition():
            if self.now() - start_s > limit_s:
                raise DeviceTimeoutError(self.name, f"{what}: nothing within {limit_s:g} s", limit_s)
            self.look_again(poll_s)
        return self.now() - start_s

    def last_missed(self, condition: Callable[[], bool], limit_s: float, what: str) -> float:
        """Wait for a condition, and return the time of the last look that did not find it, in seconds.

        The look that finds it may come much later, because the computer was busy with something else.
        """
        missed_s, start_s = list[float](), self.now()

        def is_met() -> bool:
            looked_s = self.now()
            met = condition()
            if not met:
                missed_s.append(looked_s)
            return met

        self.until(is_met, limit_s, what)
        return missed_s[-1] - start_s if missed_s else 0.0

    # The card

    def read_if_known(self, register: int) -> int | None:
        """A register, None if this card or its driver does not know it."""
        try:
            return self.card.read(register)
        except DeviceError:
            return None

    def read_real_if_known(self, register: int) -> float | None:
        """A register of a real number, None if this card or its driver does not know it."""
        value, handle = ctypes.c_double(), ctypes.c_void_p(self.card.handle)
        if self.card.spcm.spcm_dwGetParam_d64(handle, register, ctypes.byref(value)):
            self.card.clear_error()
            return None
        return value.value

    def transfer(
        self, frames: NDArray[np.int16], notify_bytes: int, card_bytes: int, *, at_full_rate: bool = False
    ) -> Transfer:
        """The card, fresh, in the mode REP_FIFO_SINGLE without an end, and its buffer named.

        Args:
            frames: The ring, int16 (n, 2).
            notify_bytes: Bytes after which the card reports.
            card_bytes: Size of the card's buffer.
            at_full_rate: Whether it plays at the driver's sample rate, not at the card's lowest one, which
                every bus can supply.
        """
        card, spcm = self.fresh(), self.card.spcm
        if not at_full_rate:
            card.set(spcm.SPC_SAMPLERATE, card.read(spcm.SPC_MIINST_MINADCLOCK), "sample rate in Hz", 8)
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_FIFO_SINGLE, "card mode")
        card.set(spcm.SPC_LOOPS, 0, "loops")
        card.set(spcm.SPC_DATA_OUTBUFSIZE, card_bytes, "size of the card's buffer in bytes")
        card.write_setup()
        card.define_transfer(frames, notify_bytes)
        new = Transfer(self, frames, notify_bytes)
        new.is_new_free = new.user_bytes > 0
        return new

    def silence(self, n_bytes: int) -> NDArray[np.int16]:
        """A buffer of zeros whose pages are in memory, int16 (n, 2)."""
        frames = Buffer().reserve(n_bytes // limits.FRAME_BYTES)
        frames[:] = 0
        return frames

    def continuous(self) -> NDArray[np.int16] | None:
        """The driver's own continuous buffer, if one was set up in Spectrum's Control Center."""
        spcm, card = self.card.spcm, self.card
        address, n_bytes = ctypes.c_void_p(), ctypes.c_uint64()
        handle = ctypes.c_void_p(card.handle)
        code = spcm.spcm_dwGetContBuf_i64(
            handle, spcm.SPCM_BUF_DATA, ctypes.byref(address), ctypes.byref(n_bytes)
        )
        if code:
            card.clear_error()
        if code or not address.value or not n_bytes.value:
            return None
        memory: Any = (ctypes.c_int16 * (n_bytes.value // 2)).from_address(address.value)
        return np.ctypeslib.as_array(memory).reshape(-1, 2)


class Transfer:
    """Samples on their way to the card, handed over and fetched as far as the card reports.

    Args:
        bench: The card.
        frames: The ring, int16 (n, 2).
        notify_bytes: Bytes after which the card reports.

    Attributes:
        handed: Bytes handed over so far.
        is_new_free: Whether a new buffer counts as free for the user. By the manual it counts as full, so
            that only the fetched bytes are free until the whole buffer has been handed over.
    """

    is_new_free = False

    def __init__(self, bench: Bench, frames: NDArray[np.int16], notify_bytes: int) -> None:
        self._bench, self._card, self.frames = bench, bench.card, frames
        self.notify_bytes = notify_bytes
        self.handed = 0

    @property
    def user_bytes(self) -> int:
        """Bytes that the card says are free for the user."""
        return self._card.read(self._card.spcm.SPC_DATA_AVAIL_USER_LEN)

    @property
    def reported(self) -> int:
        """Bytes that the card reports as fetched."""
        return self.fetched(self.user_bytes)

    def fetched(self, user_bytes: int) -> int:
        """Bytes that are fetched when so many are free for the user."""
        behind = self.handed - self.frames.nbytes
        return user_bytes + (behind if self.is_new_free else max(0, behind))

    def start_dma(self) -> None:
        """Let the card fetch the samples that are handed over."""
        self._card.command(self._card.spcm.M2CMD_DATA_STARTDMA, "transfer")

    def hand_over(self, n_bytes: int) -> None:
        """Hand over the next bytes of the ring."""
        self._card.write(self._card.spcm.SPC_DATA_AVAIL_CARD_LEN, n_bytes, "handing samples over")
        self.handed += n_bytes

    def feed(self, user_bytes: int) -> None:
        """Hand over all whole blocks that are free."""
        if free := user_bytes // self.notify_bytes * self.notify_bytes:
            self.hand_over(free)

    def play(self) -> None:
        """Start the outputs."""
        spcm = self._card.spcm
        start = spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER | spcm.M2CMD_CARD_FORCETRIGGER
        self._card.command(start, "start")

    def settled(self, still_s: float = 20e-3) -> int:
        """Wait until the card reports nothing new for some time, and return the bytes that it reported."""
        count = self.reported
        since_s = self._bench.now()
        while self._bench.now() - since_s < still_s:
            self._bench.pause(1e-3)
            if (reported := self.reported) != count:
                count, since_s = reported, self._bench.now()
        return count
