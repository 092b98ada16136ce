"""Mobile tweezers on a Spectrum M4i.66xx."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from labseq.plugin import (
    Context,
    DeviceError,
    DeviceTimeoutError,
    ReceivesOutput,
    ToneProgram,
    TransientError,
    format_quantity,
    warm_rendering,
)
from labseq_spcm import limits
from labseq_spcm.card import POLL_S, AwgCard
from labseq_spcm.dds import Dds
from labseq_spcm.dds_program import choose_cores
from labseq_spcm.fifo import Fifo
from labseq_spcm.library import load_spcm
from labseq_spcm.replay import Replay
from labseq_spcm.safety import make_safe
from labseq_spcm.self_test import check_card
from labseq_spcm.settings import SIMULATED, SpcmSettings
from labseq_spcm.setup import output_registers, set_up

if TYPE_CHECKING:
    from labseq_spcm.simulator import SimulatedCard


class PlayMode(Protocol):
    """How a program gets to the outputs.

    Attributes:
        max_wait_s: How long the card can now be left alone while it plays; 0: not at all.
        render_s: What rendering took in the last ``prepare``, on this computer's clock.
    """

    max_wait_s: float
    render_s: float

    def prepare(self, program: ToneProgram) -> float:
        """Bring a program onto the card; returns the playing time in seconds."""
        ...

    def start(self, command: int) -> None:
        """Start the card with this command, and then whatever else there is to do."""
        ...

    def finished(self) -> bool:
        """Whether it was played to its end; called again and again, it keeps the card supplied."""
        ...

    def give_up(self) -> None:
        """The card was stopped: forget the program."""
        ...


class SpcmMobileTweezers:
    """Plays tone programs on two outputs of an arbitrary waveform generator.

    A program is refused before anything is uploaded if it leaves an AOD's band or would clip.
    Each ``play`` needs a ``prepare`` of its own, so that nothing is ever replayed by mistake. The
    output's amplitude is the profile's ``rf.full_scale``, set once, with the outputs off: it is
    never changed while atoms are held, except to ramp them down in ``safe_state``.

    Args:
        settings: The card, and how it is used.
        context: Name, clock, and what drives the AODs.

    Attributes:
        simulated_card: The simulated card, while it is open; None for a real one.

    Raises:
        LimitError: The card or the amplifiers cannot do the profile's ``rf.full_scale``, or the sample
            rate is too low for its bands.
        ConfigError: The mode is ``dds``, and the profile allows more tones than it has.
    """

    def __init__(self, settings: SpcmSettings, context: Context) -> None:
        self._name = context.name or "mobile_tweezers"
        self._settings = settings
        self._clock = context.clock
        self._rf = context.motion.rf
        self._amplitude_mv = limits.amplitude_mv(self._name, self._rf)
        if settings.mode != "dds":
            limits.check_rate(self._name, settings.sample_rate, self._rf)
        dds = settings.mode == "dds"
        self._cores = choose_cores(self._name, settings, context.motion) if dds else None
        self._card: AwgCard | None = None
        self._mode: PlayMode | None = None
        self._facts: dict[str, Any] = {}
        self._timings: dict[str, float] = {}
        self._world = context.simulation
        self._identifier = settings.card
        self._is_simulated = settings.card.startswith(SIMULATED)
        self._duration_s: float | None = None
        self._due_s: float | None = None
        self.simulated_card: SimulatedCard | None = None

    def open(self) -> None:
        """Open the card and set it up, outputs off; no effect if it is open.

        Raises:
            DeviceError: No package or driver library, no such card, another program holds it, it
                is of another type, or it does not take a setting.
        """
        if self._card is not None:
            return
        try:
            spcm = load_spcm(self._name, simulated=self._is_simulated)
            self._insert_simulated_card()
            self._card = AwgCard(self._name, spcm, self._identifier, self._clock)
            self._facts = set_up(self._card, self._settings, self._amplitude_mv)
            self._clock.sleep(limits.RELAY_S)
            self._mode = self._new_mode(self._card)
        except BaseException:
            self._disconnect()
            raise

    def _new_mode(self, card: AwgCard) -> PlayMode:
        if self._cores is not None:
            return Dds(card, self._cores)
        mode = Replay if self._settings.mode == "replay" else Fifo
        return mode(card, self._settings, self._facts["sample_rate_hz"])

    def _insert_simulated_card(self) -> None:
        if self._settings.card == SIMULATED:
            from labseq_spcm.simulator import SimulatedCard, install
            from labseq_spcm.world import CardOutputs

            self.simulated_card = SimulatedCard(self._clock)
            self._identifier = install(self.simulated_card)
            if isinstance(self._world, ReceivesOutput):
                outputs = CardOutputs(self.simulated_card, self._settings.row_channel)
                self._world.connect_outputs("mobile_tweezers", outputs)

    def close(self) -> None:
        """Make the outputs harmless and let the card go; legal in any state."""
        try:
            self.safe_state()
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        card, self._card, self._mode = self._card, None, None
        if card is not None:
            card.close()
        if self.simulated_card is not None:
            from labseq_spcm.simulator import uninstall

            uninstall(self._identifier)
            self.simulated_card = None

    def warm(self) -> None:
        """Import the vendor's package, and compile the kernels of the mode or load them from the cache.

        Raises:
            DeviceError: No package or driver library.
        """
        load_spcm(self._name, simulated=self._is_simulated)
        if self._settings.mode == "dds":
            importlib.import_module("labseq_spcm._kernels_dds")
        else:
            importlib.import_module("labseq_spcm._kernels")
            warm_rendering()
        if self._settings.card == SIMULATED and isinstance(self._world, ReceivesOutput):
            self._world.warm()

    def prepare(self, program: ToneProgram) -> float:
        """Render a program and bring it onto the card.

        Returns:
            Playing time in seconds, the trigger's way to the output included.

        Raises:
            LimitError: It has no length, leaves an AOD's band, clips, or is too much for the mode.
            DeviceError: Not open, still playing, or the card refuses.
        """
        card, mode = self._opened()
        self._check_idle("prepare()")
        self._duration_s = None
        limits.refuse_excess(self._name, program, self._rf)
        card.stop()
        if self.simulated_card is not None and not isinstance(self._world, ReceivesOutput):
            self.simulated_card.forget(self._clock.now())
        start_s = time.perf_counter()
        playing_s = mode.prepare(program)
        took_s = time.perf_counter() - start_s
        self._timings = {"render": mode.render_s, "upload": took_s - mode.render_s}
        duration_s = max(playing_s, program.total_duration_s) + float(self._facts["trigger_delay_s"])
        self._duration_s = duration_s
        return duration_s

    def timings(self) -> Mapping[str, float]:
        """What rendering, and all else of the last ``prepare``, took on this computer's clock, in seconds."""
        return self._timings

    def play(self) -> None:
        """Start the card, and give the trigger or arm it; returns at once.

        Raises:
            DeviceError: Nothing was prepared since the last ``play``, still playing, or the card refuses.
        """
        card, mode = self._opened()
        self._check_idle("play()")
        if self._duration_s is None:
            text = "play() without a prepared program; call prepare() before each play()"
            raise DeviceError(self._name, text)
        duration_s, self._duration_s = self._duration_s, None
        spcm = card.spcm
        for register in output_registers(spcm):
            card.set(register, 1, "output")
        command = spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER
        external = self._settings.trigger == "external"
        self._due_s = math.inf if external else self._clock.now() + duration_s
        mode.start(command if external else command | spcm.M2CMD_CARD_FORCETRIGGER)

    def wait(self, timeout_s: float) -> None:
        """Wait until the program has been played to its end; at once if none is playing.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``, or the trigger never came; the
                card is then in its safe state.
            TransientError: The card ran out of data: what it played is not the program.
            DeviceError: Not open, or the card refuses.
        """
        _, mode = self._opened()
        due_s = self._due_s
        if due_s is None:
            return
        deadline_s = self._clock.now() + timeout_s
        try:
            while not mode.finished():
                now_s = self._clock.now()
                if now_s >= deadline_s:
                    raise self._late(timeout_s)
                idle_s = max(POLL_S, due_s - now_s) if math.isfinite(due_s) else POLL_S
                self._clock.sleep(min(deadline_s - now_s, mode.max_wait_s, idle_s))
                if self._due_s is None:
                    raise DeviceError(self._name, "stopped by safe_state() while it played")
        except (DeviceError, TransientError):
            self.safe_state()
            raise
        self._due_s = None

    def _late(self, timeout_s: float) -> DeviceTimeoutError:
        card, _ = self._opened()
        waited = format_quantity(timeout_s, "time")
        if card.status & card.spcm.M2STAT_CARD_TRIGGER:
            text = f"still playing after {waited}"
        else:
            text = f"no trigger came within {waited}; look at the cable at Ext0 and at trigger_level"
        return DeviceTimeoutError(self._name, text, timeout_s)

    def safe_state(self) -> None:
        """Ramp down, stop the card, open the output relays; the prepared program is dropped.

        What plays is ramped down by the output amplifiers, as far as they go without switching
        their relay: to a third or less of full scale on each axis.

        Raises:
            DeviceError: The card refused something; all the rest was done nevertheless.
        """
        self._duration_s = self._due_s = None
        card, mode = self._card, self._mode
        if card is None:
            return
        make_safe(card, self._amplitude_mv, mode.give_up if mode is not None else lambda: None)

    def self_test(self) -> None:
        """See whether the card is cool, and its clock and memory are right; the prepared program is dropped.

        Raises:
            DeviceError: Not open, still playing, or something is wrong.
        """
        card, _ = self._opened()
        self._check_idle("self_test()")
        self._duration_s = None
        check_card(card, self._settings, self._facts["sample_rate_hz"])

    def describe(self) -> Mapping[str, Any]:
        """Settings; once opened, also the card and every value that it read back."""
        return {"model": "Spectrum M4i.66xx", **self._settings.model_dump(mode="json"), **self._facts}

    def _opened(self) -> tuple[AwgCard, PlayMode]:
        if self._card is None or self._mode is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._card, self._mode

    def _check_idle(self, call: str) -> None:
        if self._due_s is not None:
            raise DeviceError(self._name, f"{call} while a program plays; call wait() first")
