"""The card without its driver: registers, memory, one run at a time, and what it puts out."""

from __future__ import annotations

from typing import Final

from labseq_spcm.simulator import registers as r
from labseq_spcm.simulator.dds import Dds
from labseq_spcm.simulator.dds_values import DdsValues
from labseq_spcm.simulator.facts import CardModel, trigger_delay_s
from labseq_spcm.simulator.fifo import Fifo
from labseq_spcm.simulator.memory import Buffer, Memory
from labseq_spcm.simulator.modes import crosses, new_run
from labseq_spcm.simulator.output import Amplifier
from labseq_spcm.simulator.records import Records
from labseq_spcm.simulator.replay import Run, Sequence, Step
from labseq_spcm.simulator.rules import Number, Refusal, Setup, refuse
from labseq_spcm.simulator.store import Store

AMPLITUDES: Final = {r.SPC_AMP0: 0, r.SPC_AMP1: 1}
OUTPUTS: Final = {r.SPC_ENABLEOUT0: 0, r.SPC_ENABLEOUT1: 1}


class Machine:
    """The state of one card. Every call says what time it is; nothing here waits.

    Args:
        model: What card it is.
    """

    def __init__(self, model: CardModel) -> None:
        self.model = model
        self.amplifiers = (Amplifier(model), Amplifier(model))
        self.dds_values = DdsValues(model.n_dds_cores)
        self.dds = Dds(self.dds_values, model.dds_queue)
        self.records = Records()
        self.store = Store()
        self.n_stops = 0
        self._power_on()

    def _power_on(self) -> None:
        self.setup = Setup(self.model)
        self.memory = Memory(self.model.bus_bytes_per_s)
        self.steps: dict[int, int] = {}
        self.segment_sizes: dict[int, int] = {}
        self.buffer: Buffer | None = None
        self.fifo: Fifo | None = None
        self.run: Run | None = None
        self.running = False
        self.triggered = False
        self.trigger_enabled = False
        self.underrun = False
        self.n_triggers = 0

    @property
    def sample_rate_hz(self) -> int:
        """The sample rate that is set."""
        return self.setup[r.SPC_SAMPLERATE]

    def reset(self, now_s: float) -> None:
        """M2CMD_CARD_RESET: everything as after power-on, outputs off."""
        self.stop(now_s)
        self.dds.reset()
        for amplifier in self.amplifiers:
            amplifier.enable(on=False, now_s=now_s)
            amplifier.set_amplitude(1000, now_s)
        self._power_on()

    def advance(self, now_s: float) -> None:
        """Let everything happen that is due, in its order."""
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
        if self.run is not None:
            self.records.keep(self.run.played(now_s), self.setup.channels, self.sample_rate_hz)
        self.records.chords += self.dds.stop(now_s)
        self.run = self.fifo = None
        self.running = self.trigger_enabled = False

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
        if 0 <= register - r.SPC_SEQMODE_STEPMEM0 < self.setup[r.SPC_SEQMODE_AVAILMAXSTEPS]:
            Step.decode(int(value)).check(self.setup[r.SPC_SEQMODE_MAXSEGMENTS])
            self.steps[register - r.SPC_SEQMODE_STEPMEM0] = int(value)
        elif register == r.SPC_DATA_AVAIL_CARD_LEN:
            if self.fifo is None:
                raise Refusal(r.ERR_SEQUENCE, "no FIFO buffer is defined")
            self.fifo.hand_over(int(value))
        else:
            self.setup.write(register, value, running=self.running)
            self._after(register, now_s)
        return 0.0

    def _after(self, register: int, now_s: float) -> None:
        """What some registers do beyond keeping their value."""
        value = self.setup[register]
        if register in AMPLITUDES:
            self.amplifiers[AMPLITUDES[register]].set_amplitude(value, now_s)
        elif register in OUTPUTS:
            self.amplifiers[OUTPUTS[register]].enable(bool(value), now_s)
        elif register == r.SPC_SEQMODE_SEGMENTSIZE:
            self.segment_sizes[self.setup[r.SPC_SEQMODE_WRITESEGMENT]] = value
        elif register == r.SPC_SEQMODE_MAXSEGMENTS:
            self.memory.drop_segments()
            self.segment_sizes.clear()
            self.steps.clear()

    def read(self, register: int, now_s: float) -> Number:
        """Read a register.

        Raises:
            Refusal: There is no such register.
        """
        if r.SPC_DDS_CORE0_FREQ <= register <= r.SPC_DDS_AVAIL_PHASE_STEP:
            return self.dds.read(register)
        if 0 <= register - r.SPC_SEQMODE_STEPMEM0 < self.setup[r.SPC_SEQMODE_AVAILMAXSTEPS]:
            return self.steps.get(register - r.SPC_SEQMODE_STEPMEM0, 0)
        if register == r.SPC_M2STATUS:
            return self.status(now_s)
        live = {
            r.SPC_CHCOUNT: len(self.setup.channels),
            r.SPC_TRIGGERCOUNTER: self.n_triggers,
            r.SPC_SEQMODE_STATUS: self.run.step if isinstance(self.run, Sequence) else 0,
            r.SPC_SEQMODE_SEGMENTSIZE: self.segment_sizes.get(self.setup[r.SPC_SEQMODE_WRITESEGMENT], 0),
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
        """Take note of a transfer buffer.

        Raises:
            Refusal: It is larger than the memory or segment that it is meant for.
        """
        room = self._area_samples() * self.setup.frame_bytes
        self.fifo = None
        self.underrun = False
        if self.setup.mode == r.SPC_REP_FIFO_SINGLE:
            if self.running:
                raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
            outbuf, n_channels = self.setup[r.SPC_DATA_OUTBUFSIZE], len(self.setup.channels)
            bus = self.model.bus_bytes_per_s
            self.store.reserve(self.setup[r.SPC_LOOPS] * self.setup[r.SPC_SEGMENTSIZE] * n_channels)
            self.fifo = Fifo(buffer, n_channels, self.sample_rate_hz, outbuf, bus, self.store)
        elif buffer.offset + buffer.n_bytes > room:
            raise refuse(buffer.offset + buffer.n_bytes, f"at most {room} bytes; set the memory size first")
        self.buffer = buffer

    def _area_samples(self) -> int:
        if self.setup.mode == r.SPC_REP_STD_SEQUENCE:
            return self.segment_sizes.get(self.setup[r.SPC_SEQMODE_WRITESEGMENT], 0)
        return self.setup[r.SPC_MEMSIZE]

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
        sequence = self.setup.mode == r.SPC_REP_STD_SEQUENCE
        segment = self.setup[r.SPC_SEQMODE_WRITESEGMENT] if sequence else None
        n_samples = self._area_samples() * len(self.setup.channels)
        data = self.buffer.content()
        self.memory.send(now_s, segment, n_samples, self.buffer.offset // 2, data)
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
        self.run = new_run(self.setup, self.memory, self.steps, self.segment_sizes, self.fifo)
        if self.setup.mode == r.SPC_REP_STD_DDS:
            self.dds.start()
        self.running = True
        self.triggered = self.trigger_enabled = self.underrun = False

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
        """A trigger, whatever it came from."""
        if not self.running:
            return
        self.triggered = True
        self.n_triggers += 1
        if self.run is None:
            self.dds.trigger(now_s)
        else:
            rate_hz = self.sample_rate_hz
            self.run.trigger(now_s + trigger_delay_s(rate_hz) + self.setup[r.SPC_TRIG_DELAY] / rate_hz)

    def pulse(self, voltage_v: float, now_s: float) -> bool:
        """A pulse from 0 V at the input Ext0.

        Returns:
            Whether the card took it for a trigger.
        """
        heard = self.trigger_enabled and crosses(self.setup, voltage_v)
        if heard:
            self.fire(now_s)
        return heard

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
        self.records.forget(before_s)
        self.dds.forget(before_s)
        if self.fifo is not None:
            self.fifo.forget(before_s)
        for amplifier in self.amplifiers:
            amplifier.forget(before_s)
