"""Mobile tweezers on a Spectrum arbitrary waveform generator.

The order is the manual's. ``open`` identifies, resets and sets up the card (``set_up.py``), then its mode.
``settle`` switches the outputs, ``prepare`` transfers the data, and ``play`` starts and triggers.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.plugin import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    Emergency,
    LabseqError,
    MobileTweezers,
    ToneProgram,
    TransientError,
    format_quantity,
)
from labseq.plugin.lines import trigger_line
from labseq.plugin.motion import check_tone_program
from labseq.plugin.rendering import warm_rendering
from labseq_spcm import limits
from labseq_spcm.card import POLL_S, AwgCard, Buffer
from labseq_spcm.certificate import check_certificate, permitted
from labseq_spcm.keep_warm import keep_warm_tones
from labseq_spcm.library import choose_library, load_spcm
from labseq_spcm.play_mode import PlayMode
from labseq_spcm.play_sequence import SequenceReplay
from labseq_spcm.replay_fifo import Fifo, Replay
from labseq_spcm.set_up import (
    check_type,
    close_relays,
    identity,
    set_amplitude,
    set_up,
    switch_output,
    versions,
)
from labseq_spcm.settings import NO_TRIGGER, SpcmSettings
from labseq_spcm.stream import Stream, check_rendering

if TYPE_CHECKING:
    from labseq.plugin.first_contact import FirstContact

RAMP_STEPS: Final = 15
HOT_C: Final = 80
"""Highest temperature of both sensors, in degrees Celsius (manual, "Temperature sensors")."""
TEST_SAMPLES: Final = 1 << 16
"""Samples of both outputs, all 0, that the self test sends to the card's memory."""


class SpcmMobileTweezers(MobileTweezers):
    """Plays tone programs on two outputs of an arbitrary waveform generator.

    A program is refused before anything is uploaded if it leaves an AOD's band or would clip.
    Each ``play`` needs its own ``prepare``, so that nothing is ever replayed by mistake. The output amplitude
    is the profile's ``rf.full_scale``, set once, with the outputs off. It is never changed while atoms are
    held, except to ramp them down in ``safe_state``.

    Args:
        settings: The card, and how it is used.
        context: Name, clock, simulation, and the limits of the AODs.

    Attributes:
        library: Where the card comes from. A simulated library keeps its card as ``library.card``.

    Raises:
        LimitError: The card or the amplifiers cannot do the profile's ``rf.full_scale``, the sample
            rate is too low for its bands, or a keep-warm tone is on the atoms or outside them.
        ConfigError: The mode is ``stream``, and a line triggers the card.
    """

    any_thread = True

    def __init__(self, settings: SpcmSettings, context: Context) -> None:
        self._name = context.name or "mobile_tweezers"
        if trigger_line(context.lines, "mobile_tweezers") is not None:
            if settings.mode == "stream":
                raise ConfigError(f"{self._name}: a line triggers it, but `mode: stream` {NO_TRIGGER}")
            settings = settings.model_copy(update={"trigger": "external"})
        settings, self._uncertified = permitted(settings)
        self._settings = settings
        self._context = context
        self._clock = context.clock
        self._rf = context.motion.rf
        self._amplitude_mv = limits.full_scale_mv(self._name, self._rf, settings.limits)
        self._model = settings.limits
        limits.check_sample_rate(self._name, settings.sample_rate, self._rf)
        warm = settings.keep_warm
        self._keep_warm = None if warm is None else keep_warm_tones(self._name, warm, context)
        self.library = choose_library(self._name, settings, context)
        self._card: AwgCard | None = None
        self._mode: PlayMode | None = None
        self._facts: dict[str, Any] = {}
        self._timings: dict[str, float] = {}
        self._is_settled = False
        self._duration_s: float | None = None
        self._due_s: float | None = None

    @property
    def waits_for_trigger(self) -> bool:
        """Whether an edge at Ext0 starts the programs."""
        return self._settings.trigger == "external"

    @property
    def idle_output(self) -> str:
        """The keep-warm tones."""
        tones = self._keep_warm
        if tones is None:
            return ""
        texts = (
            f"{hz / 1e6:.6g} MHz ({format_quantity(a**2 * self._rf.full_scale_power_w, 'power')})"
            for hz, a in zip(tones.hz, tones.amplitude, strict=True)
        )
        return f"keep-warm tones off the atoms: {' and '.join(texts)}"

    @property
    def settling_timeout_s(self) -> float:
        """Time for the output relays."""
        return limits.RELAY_S

    @property
    def start_delay_s(self) -> float:
        """Delay of the outputs, in the mode ``stream`` with the silence ahead of them."""
        return float(self._facts.get("trigger_delay_s", 0.0))

    @property
    def beginning_s(self) -> float:
        """A fraction of a program's length for the mode ``stream``."""
        return math.inf if self._mode is None else self._mode.beginning_s

    def warnings(self) -> list[str]:
        """Warn of a stream without a certificate, and of unsuitable or slowly rendered sample rates."""
        settings, grid = self._settings, self._context.grid
        rate = self._name, settings.sample_rate
        found = limits.reference_warnings(*rate, settings.reference_clock, grid)
        found = found or limits.rendering_warnings(*rate, grid)
        if self._uncertified:
            what = f"profile.{self._name}.mode is stream, which needs the certificate of a first contact, and"
            why = f"{self._uncertified}; `mode: {settings.mode}` is used instead"
            found.append(f"{what} {why} until 'labseq first-contact' has made one")
        return found

    def warm(self) -> None:
        """Import the vendor's package, and compile the kernels of the mode or load them from the cache.

        Raises:
            DeviceError: No package or driver library.
        """
        load_spcm(self._name, self.library)
        importlib.import_module("labseq_spcm.kernels")
        warm_rendering()
        self.library.warm()

    def check_program(self, program: ToneProgram) -> None:
        """Refuse a program that has no length, leaves an AOD's band, or clips.

        Raises:
            LimitError: It does.
        """
        check_tone_program(self._name, program, self._rf.row_band_hz, self._rf.column_band_hz)

    def open(self) -> None:
        """Open the card and set it up, outputs off. No effect if it is open.

        Raises:
            DeviceError: No package or driver library, no such card, a card of another type, another program
                holds it, it refuses a setting, or the bus or this computer is too slow for ``stream``.
            LimitError: This card cannot do the profile's ``rf.full_scale``.
            ConfigError: The certificate of the mode ``stream`` is for another card, driver or firmware.
        """
        if self._card is not None:
            return
        self._card = card = AwgCard(self._name, self.library, self._clock)
        try:
            self._model = check_type(card, self._settings)
            limits.full_scale_mv(self._name, self._rf, self._model)
            if self._settings.mode == "stream":
                check_certificate(self._settings, identity(card))
            card.n_outputs, card.outputs = self._model.n_outputs, tuple(sorted(self._settings.outputs))
            self._facts = set_up(card, self._settings, self._amplitude_mv)
            self._mode = self._new_mode(card)
        except BaseException:
            self._disconnect()
            raise

    def _new_mode(self, card: AwgCard) -> PlayMode:
        rate_hz = self._facts["sample_rate_hz"]
        if self._settings.mode == "stream":
            if not self._clock.virtual:  # virtual time waits for the rendering
                check_rendering(self._name, self._context, rate_hz, self._settings.row_index)
            stream = Stream(card, self._settings, rate_hz, self._keep_warm)
            self._facts |= {"trigger_delay_s": stream.delay_s, "bus_bytes_per_s": stream.bus_bytes_per_s}
            return stream
        if self._settings.mode == "sequence":
            sequence = SequenceReplay(card, self._settings, rate_hz, self._keep_warm)
            self._facts["trigger_delay_s"] = sequence.delay_s
            return sequence
        mode = Replay if self._settings.mode == "replay" else Fifo
        return mode(card, self._settings, rate_hz)

    def settle(self) -> None:
        """Close the output relays and let them settle, once per run, before there are atoms.

        The keep-warm tones begin, and the stream. After ``safe_state``, ``prepare`` does it again.
        """
        card, mode = self._opened()
        if close_relays(card):
            self._clock.sleep(limits.RELAY_S)
        mode.idle()
        self._is_settled = True

    def prepare(self, program: ToneProgram) -> float:
        """Render a program and transfer it to the card.

        Returns:
            Playing time in seconds, with the delay from the trigger to the output.

        Raises:
            LimitError: It has no length, leaves an AOD's band, clips, or is too much for the mode.
            DeviceError: Not open, still playing, or the card refuses.
        """
        mode = self._opened()[1]
        self._check_idle("prepare()")
        self._duration_s = None
        start_s = time.perf_counter()
        self.check_program(program)
        took_s = time.perf_counter() - start_s
        if not self._is_settled:
            self.settle()
        start_s = time.perf_counter()
        playing_s = mode.prepare(program)
        took_s += time.perf_counter() - start_s
        self._timings = {"render": mode.render_s, "upload": took_s - mode.render_s}
        self._duration_s = max(playing_s, program.total_duration_s) + self.start_delay_s
        return self._duration_s

    def prepare_beginning(self, program: ToneProgram) -> float:
        """As ``prepare``, since a stream plays silence when nothing follows."""
        return self.prepare(program)

    def timings(self) -> Mapping[str, float]:
        """Times of the last ``prepare`` on this computer's clock, for rendering and the rest (s)."""
        return self._timings

    def play(self) -> None:
        """Start the card, force or enable the trigger, and return at once.

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
        command = spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER
        if self.waits_for_trigger:
            self._due_s = math.inf
        else:
            self._due_s = self._clock.now() + duration_s
            command |= spcm.M2CMD_CARD_FORCETRIGGER
        mode.start(command)

    def append(self, program: ToneProgram) -> None:
        """Have the rest of a program follow its beginning, which plays.

        Raises:
            LimitError: It has no length, leaves an AOD's band, clips, or is too much for the mode.
            DeviceError: Not open, nothing plays, or the card refuses.
        """
        mode = self._opened()[1]
        if self._due_s is None:
            raise DeviceError(
                self._name, "append() while nothing plays; call prepare_beginning() and play() first"
            )
        self.check_program(program)
        added_s = max(mode.append(program), program.total_duration_s)
        if not self._is_settled:  # by another thread
            raise DeviceError(self._name, "stopped by safe_state() while it played")
        self._due_s += added_s

    def wait(self, timeout_s: float) -> None:
        """Wait until the program has been played to its end. Returns at once if none is playing.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``, or the trigger never came. The card is
                then in its safe state.
            TransientError: The card ran out of data, so it did not play the program.
            DeviceError: Not open, or the card refuses.
        """
        mode = self._opened()[1]
        due_s = self._due_s
        if due_s is None:
            return
        deadline_s = self._clock.now() + timeout_s
        try:
            while not mode.finished():
                now_s = self._clock.now()
                if now_s >= deadline_s:
                    raise self._timeout(mode, timeout_s)
                idle_s = max(POLL_S, due_s - now_s) if math.isfinite(due_s) else POLL_S
                self._clock.sleep(min(deadline_s - now_s, mode.max_wait_s, idle_s))
                if self._due_s is None:
                    break
        except (DeviceError, TransientError):
            if self._due_s is not None:
                self.safe_state()
                raise
        if self._due_s is None:  # by another thread, which causes the card's own errors then
            raise DeviceError(self._name, "stopped by safe_state() while it played")
        self._due_s = None

    def _timeout(self, mode: PlayMode, timeout_s: float) -> DeviceTimeoutError:
        waited = format_quantity(timeout_s, "time")
        if mode.triggered:
            text = f"still playing after {waited}"
        else:
            text = f"no trigger came within {waited}; check the cable at Ext0 and trigger_level"
        return DeviceTimeoutError(self._name, text, timeout_s)

    def safe_state(self) -> None:
        """Ramp down, stop the card, open the output relays, and drop the prepared program.

        A program that plays is ramped down by the output amplifiers, as far as they go without switching
        their relay, to a third or less of full scale on each axis.

        Raises:
            DeviceError: The card refused a step. All other steps were done.
        """
        self._duration_s = self._due_s = None
        self._is_settled = False
        card, mode = self._card, self._mode
        if card is None:
            return
        with suppress(LabseqError):
            card.clear_error()  # a pending error would block everything else
            if card.running:
                self._ramp_down(card)
        if mode is not None:
            mode.halt()
        steps: list[Callable[[], None]] = [
            card.stop,
            *(partial(switch_output, card, output, on=False) for output in range(card.n_outputs)),
            card.write_setup,
            partial(set_amplitude, card, self._amplitude_mv),
        ]
        failures = [failure for step in steps if (failure := _attempt_twice(step)) is not None]
        if failures:
            raise failures[0]

    def _ramp_down(self, card: AwgCard) -> None:
        """Lower the amplitude in steps within 0.3 ms, in the amplifier's present path."""
        relay_mv, end_mv = self._model.relay_mv, self._model.amplitude_mv[0]
        if relay_mv is not None and self._amplitude_mv > relay_mv[1]:
            end_mv = relay_mv[1] + 1
        for step in range(1, RAMP_STEPS + 1):
            self._clock.sleep(0.3e-3 / RAMP_STEPS)
            drop_mv = (self._amplitude_mv - end_mv) * step / RAMP_STEPS
            set_amplitude(card, round(self._amplitude_mv - drop_mv))

    def close(self) -> None:
        """Bring the outputs into the safe state and close the card. Legal in any state."""
        try:
            self.safe_state()
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        card, self._card, self._mode = self._card, None, None
        if card is not None:
            card.close()

    def emergency(self) -> Emergency | None:
        """A script that stops the card and disables its outputs, with the vendor's library alone."""
        script = Path(__file__).with_name("emergency.py")
        return None if self._card is None else self.library.emergency(script, self._card.n_outputs)

    def first_contact(self) -> FirstContact:
        """Steps that prove what this driver assumes about the card."""
        from labseq_spcm.first_contact import SpcmFirstContact

        return SpcmFirstContact(self._settings, self._context, self.library)

    def self_test(self) -> None:
        """Check firmware, temperatures, clock and memory, outputs off. This drops the prepared program.

        Samples are sent in the modes ``replay`` and ``sequence``. The others use the memory as a FIFO.

        Raises:
            DeviceError: Not open, still playing, or a check failed.
        """
        card, mode = self._opened()
        self._check_idle("self_test()")
        self._duration_s, self._is_settled = None, False
        mode.halt()
        card.stop()
        spcm = card.spcm
        # type 2 is the firmware with which a card starts if its own cannot be loaded
        if card.read(spcm.SPCM_FW_CTRL_ACTIVE) >> 28 == 2:
            text = "the card runs its recovery firmware; restart the computer, or update the firmware"
            raise DeviceError(self._name, f"{text} with Spectrum's Control Center")
        sensors = (("base card", spcm.SPC_MON_TC_BASE_CTRL), ("amplifier", spcm.SPC_MON_TC_MODULE_1))
        for place, register in sensors:
            temperature_c = card.read(register)
            if temperature_c > HOT_C:
                text = f"the {place} is at {temperature_c} degrees Celsius, above the limit of {HOT_C}"
                raise DeviceError(self._name, f"{text}; check the fans")
        rates_hz = card.read(spcm.SPC_SAMPLERATE), self._facts["sample_rate_hz"]
        if rates_hz[0] != rates_hz[1]:
            actual, expected = (format_quantity(hz, "frequency") for hz in rates_hz)
            raise DeviceError(self._name, f"the sample rate is {actual}, but it was set to {expected}")
        frames = Buffer().reserve(TEST_SAMPLES)
        frames[:] = 0
        mode.check_memory(frames)

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions of the package, the drivers and the card's firmware."""
        return versions(self._opened()[0])

    def describe(self) -> Mapping[str, Any]:
        """Settings, and once opened also the card and every value that it read back."""
        facts = dict(self._facts)
        if isinstance(self._mode, Stream):
            facts["silent_underruns"] = self._mode.n_underruns
        if isinstance(self._mode, Stream | SequenceReplay):
            facts["delayed_batches"] = self._mode.n_pauses
        settings = self._settings.model_dump(mode="json")
        if self._uncertified:
            facts["not_streamed_because"] = self._uncertified
        return {**settings, "model": self._model.name, **facts}

    def _opened(self) -> tuple[AwgCard, PlayMode]:
        if self._card is None or self._mode is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._card, self._mode

    def _check_idle(self, call: str) -> None:
        if self._due_s is not None:
            raise DeviceError(self._name, f"{call} while a program plays; call wait() first")


def _attempt_twice(step: Callable[[], None]) -> LabseqError | None:
    """Do something, twice if an earlier error still blocked the driver library, and return the failure."""
    with suppress(LabseqError):
        step()
        return None
    try:
        step()
    except LabseqError as failure:
        return failure
    return None
