"""The card behind its driver: registers, memory, one run at a time, and what it plays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from labseq_spcm_sim import registers as r
from labseq_spcm_sim.dds import CoreOutputs, Dds, DdsValues
from labseq_spcm_sim.modes import Buffer, Fifo, Memory, Replay, Run, Store, Stretch
from labseq_spcm_sim.output import Amplifier, SampleSpan, Span
from labseq_spcm_sim.setup import CardModel, Number, Refusal, Setup, refuse, trigger_delay_s


@dataclass(frozen=True, slots=True)
class Record:
    """Samples that were played, with the set-up at that time.

    Attributes:
        stretch: The samples.
        channels: The channels that were active, in the order of the columns.
        sample_rate_hz: The sample rate.
    """

    stretch: Stretch
    channels: Sequence[int]
    sample_rate_hz: float

    def span(self, channel: int) -> SampleSpan:
        """The samples of one channel; the amplifier adds the voltage."""
        column = self.stretch.samples[:, self.channels.index(channel)]
        return SampleSpan(self.stretch.start_s, self.sample_rate_hz, column, 0, self.stretch.n_samples, 0.0)


AMPLITUDES: Final = {r.SPC_AMP0: 0, r.SPC_AMP1: 1}
OUTPUTS: Final = {r.SPC_ENABLEOUT0: 0, r.SPC_ENABLEOUT1: 1}


class Machine:
    """The state of one card. Every call gets the time; nothing here waits.

    Args:
        model: What card it is.
    """

    def __init__(self, model: CardModel) -> None:
        self.model = model
        self.amplifiers = (Amplifier(model), Amplifier(model))
        self.dds_values = DdsValues(model.n_dds_cores)
        self.dds = Dds(self.dds_values, model.dds_queue)
        self.samples: list[Record] = []
        self.tones: list[CoreOutputs] = []
        self.store = Store()
        self.n_stops = 0
        self._power_on()

    def _power_on(self) -> None:
        self.setup = Setup(self.model)
        self.memory = Memory(self.model.bus_bytes_per_s)
        self.buffer: Buffer | None = None
        self.fifo: Fifo | None = None
        self.run: Run | None = None
        self.running = False
        self.triggered = False
        self.trigger_enabled = False
        self.underrun = False
        self.n_triggers = 0

    def reset(self, now_s: float) -> None:
        """M2CMD_CARD_RESET: everything as after power-on, outputs off."""
        self.stop(now_s)
        self.dds.reset()
        for amplifier in self.amplifiers:
            amplifier.enable(on=False, now_s=now_s)
            amplifier.set_amplitude(1000, now_s)
        self._power_on()

    def advance(self, now_s: float) -> None:
        """Do everything that is due, in time's order."""
        while self.memory.uploads and self.memory.uploads[0].done_s <= now_s:
            upload = self.memory.uploads.popleft()
            if self.run is not None:
                self.run.advance(upload.done_s)
            self.memory.store(upload)
        self.dds.advance(now_s)
        if self.fifo is not None:
            self.fifo.advance(now_s)
        if self.run is not None:
            self.run.advance(now_s)
            if self.run.finished or self.run.failed:
                self.underrun = self.run.failed
                self._end_run(now_s)

    def _end_run(self, now_s: float) -> None:
        self.samples += self._run_samples(now_s)
        self.tones += self.dds.stop(now_s)
        self.run = self.fifo = None
        self.running = self.trigger_enabled = False

    def _run_samples(self, now_s: float) -> list[Record]:
        stretches = self.run.played(now_s) if self.run is not None else []
        return [Record(stretch, self.setup.channels, self.setup[r.SPC_SAMPLERATE]) for stretch in stretches]

    def played(self, channel: int, now_s: float) -> list[Span]:
        """What reached the connector of a channel up to now, in time's order."""
        amplifier = self.amplifiers[channel]
        parts: list[Span] = []
        for record in self.samples + self._run_samples(now_s):
            if channel in record.channels:
                parts += amplifier.cut(record.span(channel))
        for outputs in self.tones + self.dds.played(now_s):
            for span in outputs.spans(channel):
                parts += amplifier.cut(span)
        return sorted(parts, key=lambda part: part.start_s)

    # Registers

    def write(self, register: int, value: Number, now_s: float) -> float:
        """Write a set-up register or a DDS command.

        Returns:
            Seconds that the call takes.

        Raises:
            Refusal: The card does not take it.
        """
        if r.SPC_DDS_CORE0_FREQ <= register <= r.SPC_DDS_AVAIL_PHASE_STEP:
            return self.dds.write(register, value, now_s)
        if register == r.SPC_DATA_AVAIL_CARD_LEN:
            if self.fifo is None:
                raise Refusal(r.ERR_SEQUENCE, "no FIFO buffer is defined")
            self.fifo.hand_over(int(value))
        else:
            self.setup.write(register, value, running=self.running)
            self._after(register, now_s)
        return 0.0

    def _after(self, register: int, now_s: float) -> None:
        """The side effects of some registers."""
        value = self.setup[register]
        if register in AMPLITUDES:
            self.amplifiers[AMPLITUDES[register]].set_amplitude(value, now_s)
        elif register in OUTPUTS:
            self.amplifiers[OUTPUTS[register]].enable(bool(value), now_s)

    def read(self, register: int, now_s: float) -> Number:
        """Read a register.

        Raises:
            Refusal: There is no such register.
        """
        if r.SPC_DDS_CORE0_FREQ <= register <= r.SPC_DDS_AVAIL_PHASE_STEP:
            return self.dds.read(register)
        if register == r.SPC_M2STATUS:
            return self.status(now_s)
        live = {
            r.SPC_CHCOUNT: len(self.setup.channels),
            r.SPC_TRIGGERCOUNTER: self.n_triggers,
            r.SPC_DATA_AVAIL_USER_LEN: self.fifo.user_bytes if self.fifo else 0,
            r.SPC_DATA_AVAIL_USER_POS: self.fifo.user_position if self.fifo else 0,
            r.SPC_FILLSIZEPROMILLE: self.fifo.fill_promille if self.fifo else 0,
        }
        if register in live:
            return live[register]
        if register not in self.setup:
            raise Refusal(r.ERR_REG, "the simulator does not know this register")
        return self.setup[register]

    def status(self, now_s: float) -> int:
        """The bits of SPC_M2STATUS."""
        ready = self.fifo.block_ready if self.fifo is not None else self.memory.done_s <= now_s
        return (
            (0 if self.running else r.M2STAT_CARD_READY)
            | (r.M2STAT_CARD_TRIGGER if self.triggered else 0)
            | (r.M2STAT_DATA_BLOCKREADY if ready else 0)
            | (r.M2STAT_DATA_END if ready and self.fifo is None else 0)
            | (r.M2STAT_DATA_OVERRUN if self.underrun else 0)
        )

    # Data

    def define_transfer(self, buffer: Buffer) -> None:
        """Name the buffer of the next transfer.

        Raises:
            Refusal: It is larger than the memory that is set up, or the FIFO is running.
        """
        self.fifo = None
        self.underrun = False
        if self.setup.mode == r.SPC_REP_FIFO_SINGLE:
            if self.running:
                raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
            n_channels, bus = len(self.setup.channels), self.model.bus_bytes_per_s
            rate_hz, outbuf = self.setup[r.SPC_SAMPLERATE], self.setup[r.SPC_DATA_OUTBUFSIZE]
            self.store.reserve(self.setup[r.SPC_LOOPS] * self.setup[r.SPC_SEGMENTSIZE] * n_channels)
            self.fifo = Fifo(buffer, n_channels, rate_hz, outbuf, bus, self.store)
        else:
            room = self.setup[r.SPC_MEMSIZE] * self.setup.frame_bytes
            if buffer.offset + buffer.n_bytes > room:
                asked = buffer.offset + buffer.n_bytes
                raise refuse(asked, f"at most {room} bytes; set the memory size first")
        self.buffer = buffer

    def start_dma(self, now_s: float) -> None:
        """M2CMD_DATA_STARTDMA.

        Raises:
            Refusal: No buffer is defined; one is used only once.
        """
        if self.buffer is None:
            raise Refusal(r.ERR_SEQUENCE, "no transfer buffer is defined")
        if self.fifo is not None:
            self.fifo.start_dma(now_s)
            return
        n_samples = self.setup[r.SPC_MEMSIZE] * len(self.setup.channels)
        self.memory.send(now_s, n_samples, self.buffer.offset // 2, self.buffer.content())
        self.buffer = None

    def stop_dma(self, now_s: float) -> None:
        """M2CMD_DATA_STOPDMA: what has not arrived is lost."""
        self.memory.uploads.clear()
        if self.fifo is not None:
            self.fifo.stop_dma(now_s)

    # Runs

    def start(self) -> None:
        """M2CMD_CARD_START.

        Raises:
            Refusal: It runs, or the FIFO has no buffer.
        """
        if self.running:
            raise Refusal(r.ERR_SEQUENCE, "the card runs already")
        self.run = self._new_run()
        if self.setup.mode == r.SPC_REP_STD_DDS:
            self.dds.start()
        self.running = True
        self.triggered = self.trigger_enabled = self.underrun = False

    def _new_run(self) -> Run | None:
        """The samples that are to be played; None in DDS mode."""
        setup = self.setup
        n_samples, n_channels, loops = setup[r.SPC_MEMSIZE], len(setup.channels), setup[r.SPC_LOOPS]
        if setup.mode == r.SPC_REP_STD_DDS:
            return None
        if setup.mode == r.SPC_REP_STD_SINGLE:
            return Replay(lambda: self.memory.read(n_samples, n_channels), setup[r.SPC_SAMPLERATE], loops)
        if self.fifo is None:
            raise Refusal(r.ERR_SEQUENCE, "no FIFO buffer is defined")
        self.fifo.set_length(loops * setup[r.SPC_SEGMENTSIZE])
        return self.fifo

    def stop(self, now_s: float) -> None:
        """M2CMD_CARD_STOP; no effect if it does not run."""
        self.n_stops += 1
        self.advance(now_s)
        if self.running:
            self._end_run(now_s)

    def enable_trigger(self, now_s: float) -> None:
        """M2CMD_CARD_ENABLETRIGGER; with the software trigger it is there at once."""
        self.trigger_enabled = self.running
        if self.running and self.setup[r.SPC_TRIG_ORMASK] == r.SPC_TMASK_SOFTWARE:
            if self.setup.mode == r.SPC_REP_STD_DDS:
                self.triggered = True
                self.dds.run_free(now_s)
                self.dds.advance(now_s)
            else:
                self.fire(now_s)

    def fire(self, now_s: float) -> None:
        """A trigger from any source."""
        if not self.running:
            return
        self.triggered = True
        self.n_triggers += 1
        if self.run is None:
            self.dds.trigger(now_s)
        else:
            rate_hz = self.setup[r.SPC_SAMPLERATE]
            self.run.trigger(now_s + trigger_delay_s(rate_hz) + self.setup[r.SPC_TRIG_DELAY] / rate_hz)

    def pulse(self, voltage_v: float, now_s: float) -> bool:
        """A pulse from 0 V at the input Ext0.

        Returns:
            Whether the card accepted it as a trigger.
        """
        setup, level_v = self.setup, self.setup[r.SPC_TRIG_EXT0_LEVEL0] / 1000
        accepted = (
            self.trigger_enabled
            and setup[r.SPC_TRIG_ORMASK] == r.SPC_TMASK_EXT0
            and setup[r.SPC_TRIG_EXT0_MODE] != r.SPC_TM_NONE
            and min(0.0, voltage_v) < level_v < max(0.0, voltage_v)
        )
        if accepted:
            self.fire(now_s)
        return accepted

    def disable_trigger(self) -> None:
        """M2CMD_CARD_DISABLETRIGGER."""
        self.trigger_enabled = False

    def awaited(self, command: int, now_s: float) -> tuple[bool, float | None]:
        """Whether a wait command would return now, and else when it will, if that is known."""
        if command == r.M2CMD_CARD_WAITTRIGGER:
            return self.triggered or not self.running, None
        if command == r.M2CMD_CARD_WAITREADY:
            return not self.running, self.run.ends_s() if self.run is not None else None
        if self.fifo is not None:
            return self.fifo.block_ready, self.fifo.block_s()
        return self.memory.done_s <= now_s or not self.memory.uploads, self.memory.done_s

    def forget(self, before_s: float) -> None:
        """Drop what was played before a time."""
        self.samples = [record for record in self.samples if record.span(record.channels[0]).end_s > before_s]
        self.tones = [outputs for outputs in self.tones if outputs.end_s > before_s]
        self.dds.forget(before_s)
        if self.fifo is not None:
            self.fifo.forget(before_s)
        for amplifier in self.amplifiers:
            amplifier.forget(before_s)
