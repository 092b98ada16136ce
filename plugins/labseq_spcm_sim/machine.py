"""The card behind its driver, with registers, memory, one run at a time, and its output."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from labseq_spcm_sim import registers as r
from labseq_spcm_sim.faults import Faults
from labseq_spcm_sim.modes import Buffer, Fifo, Memory, Replay, Run, Stretch
from labseq_spcm_sim.output import Amplifier, SampleSpan
from labseq_spcm_sim.sequence import REGISTERS, SequenceMemory, SequenceRun
from labseq_spcm_sim.setup import (
    AMPLITUDES,
    OUTPUTS,
    PLL_LOCK_S,
    UNKNOWN,
    CardModel,
    Number,
    Refusal,
    Setup,
    refuse,
    trigger_delay_s,
)

WAITS: Final = r.M2CMD_CARD_WAITTRIGGER | r.M2CMD_CARD_WAITREADY | r.M2CMD_DATA_WAITDMA


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
        """The samples of one channel. The amplifier adds the voltage."""
        column = self.stretch.samples[:, self.channels.index(channel)]
        return SampleSpan(self.stretch.start_s, self.sample_rate_hz, column, 0, self.stretch.n_samples, 0.0)


class Machine:
    """The state of one card. Every call gets the time. Nothing here waits.

    Args:
        model: Model of the card.
        keeps_streams: Whether samples of streams are kept, as well as of replays.
        faults: Its differences from the default.

    Attributes:
        continuous: Address of the driver's continuous buffer, whose length the model has.
    """

    def __init__(self, model: CardModel, *, keeps_streams: bool, faults: Faults = Faults()) -> None:  # noqa: B008
        self.model = model
        self._faults = faults
        self.continuous = 0
        self._keeps_streams = keeps_streams
        self.amplifiers = tuple(Amplifier(model) for _ in range(model.n_channels))
        self.samples: list[Record] = []
        self._power_on()

    def _power_on(self) -> None:
        self.setup = Setup(self.model)
        self.memory = Memory()
        self.buffer: Buffer | None = None
        self.fifo: Fifo | None = None
        self.run: Run | None = None
        self.running = False
        self.triggered = False
        self.trigger_enabled = False
        self.underrun = False
        self.free_bytes = 0
        self.busy_s = 0.0  # how much longer the last command takes

    def advance(self, now_s: float) -> None:
        """Do everything that is due, in time's order."""
        while self.memory.uploads and self.memory.uploads[0][0] <= now_s:
            done_s, data = self.memory.uploads.popleft()
            if self.run is not None:
                self.run.advance(done_s)
            self.memory.store(data)
        if self.fifo is not None:
            self.fifo.advance(now_s)
        if self.run is not None:
            self.run.advance(now_s)
            if self.run.finished or self.run.failed:
                self.underrun = self.run.failed
                self._end_run(now_s)
                self.running = self.underrun and self._faults.underrun_not_ready

    def _end_run(self, now_s: float) -> None:
        self.samples += self._run_samples(now_s)
        self.free_bytes = self.fifo.user_bytes if self.fifo else 0
        self.run = self.fifo = None
        self.running = self.trigger_enabled = False

    def _run_samples(self, now_s: float) -> list[Record]:
        stretches = self.run.played(now_s) if self.run is not None else []
        return [Record(stretch, self.setup.channels, self.setup[r.SPC_SAMPLERATE]) for stretch in stretches]

    def played(self, channel: int, now_s: float) -> list[SampleSpan]:
        """Spans that reached the connector of a channel up to now, in time's order."""
        amplifier = self.amplifiers[channel]
        parts: list[SampleSpan] = []
        for record in self.samples + self._run_samples(now_s):
            if channel in record.channels:
                parts += amplifier.cut(record.span(channel))
        return sorted(parts, key=lambda part: part.start_s)

    def forget(self, before_s: float) -> None:
        """Drop samples played before a time."""
        self.samples = [record for record in self.samples if record.span(record.channels[0]).end_s > before_s]
        if self.fifo is not None:
            self.fifo.forget(before_s)
        if isinstance(self.run, SequenceRun):
            self.run.forget(before_s)
        for amplifier in self.amplifiers:
            amplifier.forget(before_s)

    # Registers

    def write(self, register: int, value: Number, now_s: float) -> None:
        """Write a register, also a command."""
        if register == r.SPC_M2CMD:
            self._command(int(value), now_s)
        elif register == r.SPC_DATA_AVAIL_CARD_LEN:
            if self.fifo is None:
                raise Refusal(r.ERR_SEQUENCE, "no FIFO buffer is defined")
            self.fifo.hand_over(int(value))
        elif register in REGISTERS:
            self._write_sequence(register, int(value))
        else:
            self.setup.write(register, value, running=self.running)
            if register == r.SPC_CARDMODE:
                self._set_mode(int(value))
            if register in AMPLITUDES:
                self.amplifiers[AMPLITUDES[register]].set_amplitude(self.setup[register], now_s)

    def read(self, register: int) -> Number:
        """Read a register."""
        if register == r.SPC_M2STATUS:
            return self._status()
        if register == r.SPC_CHCOUNT:
            return len(self.setup.channels)
        if register == r.SPC_DATA_AVAIL_USER_LEN:
            return self.fifo.user_bytes if self.fifo else self.free_bytes
        if register in REGISTERS and register not in self.setup:
            if register == r.SPC_SEQMODE_STATUS:
                return self.run.at_output if isinstance(self.run, SequenceRun) else 0
            return self._sequence_memory.value(register)
        if register not in self.setup:
            raise Refusal(r.ERR_REG, UNKNOWN)
        return self.setup[register]

    # Sequence mode

    def _set_mode(self, mode: int) -> None:
        """Divide the memory in the mode STD_SEQUENCE, and leave it whole in the others."""
        if (mode == r.SPC_REP_STD_SEQUENCE) != isinstance(self.memory, SequenceMemory):
            is_divided = mode == r.SPC_REP_STD_SEQUENCE
            n_channels = len(self.setup.channels)
            self.memory = SequenceMemory(self.model, n_channels) if is_divided else Memory()

    @property
    def _sequence_memory(self) -> SequenceMemory:
        if not isinstance(self.memory, SequenceMemory):
            raise Refusal(r.ERR_SEQUENCE, "set the card mode SPC_REP_STD_SEQUENCE first")
        return self.memory

    def _write_sequence(self, register: int, value: int) -> None:
        """Write a register of the sequence mode. Steps in use must lead to samples that are there."""
        memory, run = self._sequence_memory, self.run
        if not isinstance(run, SequenceRun):
            memory.write(register, value, None)
            return
        number = register - r.SPC_SEQMODE_STEPMEM0
        step = memory.steps.get(number)
        memory.write(register, value, run.used)
        try:
            _ = run.used
        except Refusal:
            memory.restore(number, step)
            raise

    def _status(self) -> int:
        """The bits of SPC_M2STATUS."""
        ready = self.fifo.block_ready if self.fifo is not None else not self.memory.uploads
        return (
            (0 if self.running else r.M2STAT_CARD_READY)
            | (r.M2STAT_CARD_TRIGGER if self.triggered else 0)
            | (r.M2STAT_DATA_BLOCKREADY if ready else 0)
            | (r.M2STAT_DATA_END if ready and self.fifo is None else 0)
            | (r.M2STAT_DATA_OVERRUN if self.underrun else 0)
        )

    # Commands

    def _command(self, command: int, now_s: float) -> None:
        """Carry out a command of one or several M2CMD bits."""
        if command & WAITS:
            raise Refusal(r.ERR_FNCNOTSUPPORTED, "the simulator does not wait; read SPC_M2STATUS instead")
        if command & r.M2CMD_DATA_STARTDMA and command & r.M2CMD_CARD_START:
            raise Refusal(r.ERR_SEQUENCE, "the card and the transfer cannot be started together")
        if command & r.M2CMD_CARD_WRITESETUP and self.running:
            raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
        if command & r.M2CMD_CARD_RESET:
            self._reset(now_s)
        if command & r.M2CMD_CARD_STOP and self.running:
            self._end_run(now_s)
        if command & r.M2CMD_CARD_WRITESETUP:
            self._write_setup(now_s)
        if command & r.M2CMD_DATA_STOPDMA:
            self.stop_dma(now_s)
        if command & r.M2CMD_DATA_STARTDMA:
            self._start_dma(now_s)
        if command & r.M2CMD_CARD_START:
            self._start(now_s)
        if command & r.M2CMD_CARD_ENABLETRIGGER:
            self.trigger_enabled = self.running
        if command & r.M2CMD_CARD_FORCETRIGGER:
            self._fire(now_s)
        if command & r.M2CMD_CARD_DISABLETRIGGER:
            self.trigger_enabled = False
            if isinstance(self.run, SequenceRun):
                self.run.drop_trigger()

    def _write_setup(self, now_s: float) -> None:
        """Write the set-up to the card, so that its relays follow the registers."""
        if self.setup.write_to_card():
            self.busy_s = PLL_LOCK_S
        for register, channel in OUTPUTS.items():
            if channel < self.model.n_channels:
                self.amplifiers[channel].enable(bool(self.setup[register]), now_s)

    def _reset(self, now_s: float) -> None:
        """Set everything as after power-on, outputs off."""
        if self.running:
            self._end_run(now_s)
        for amplifier in self.amplifiers:
            amplifier.enable(on=False, now_s=now_s)
            amplifier.set_amplitude(1000, now_s)
        self._power_on()

    def _start(self, now_s: float) -> None:
        if self.running:
            raise Refusal(r.ERR_SEQUENCE, "the card runs already")
        self._write_setup(now_s)
        setup = self.setup
        n_samples, n_channels, loops = setup[r.SPC_MEMSIZE], len(setup.channels), setup[r.SPC_LOOPS]
        if setup.mode == r.SPC_REP_STD_SINGLE:
            memory = self.memory
            self.run = Replay(lambda: memory.read(n_samples, n_channels), setup[r.SPC_SAMPLERATE], loops)
        elif setup.mode == r.SPC_REP_STD_SEQUENCE:
            keeps = self._keeps_streams
            rate_hz = setup[r.SPC_SAMPLERATE]
            self.run = SequenceRun(self._sequence_memory, n_channels, rate_hz, keeps=keeps)
        elif self.fifo is None:
            raise Refusal(r.ERR_SEQUENCE, "no FIFO buffer is defined")
        else:
            self.fifo.set_length(loops * setup[r.SPC_SEGMENTSIZE])
            self.run = self.fifo
        self.running = True
        self.triggered = self.underrun = False

    def _fire(self, now_s: float) -> None:
        """A trigger from any source."""
        if self.run is not None:
            self.triggered = True
            self.run.trigger(now_s + trigger_delay_s(self.setup[r.SPC_SAMPLERATE]))

    def pulse(self, voltage_v: float, now_s: float) -> bool:
        """A pulse from 0 V at the input Ext0. Returns whether the card accepted it as a trigger."""
        on_card = self.setup.on_card
        level_v = on_card(r.SPC_TRIG_EXT0_LEVEL0) / 1000
        accepted = (
            self.trigger_enabled
            and on_card(r.SPC_TRIG_ORMASK) == r.SPC_TMASK_EXT0
            and on_card(r.SPC_TRIG_EXT0_MODE) != r.SPC_TM_NONE
            and min(0.0, voltage_v) < level_v < max(0.0, voltage_v)
        )
        if accepted:
            self._fire(now_s)
        return accepted

    # Data

    def define_transfer(self, buffer: Buffer) -> None:
        """Name the buffer of the next transfer."""
        setup = self.setup
        self.fifo = None
        self.underrun = False
        if setup.mode == r.SPC_REP_FIFO_SINGLE:
            if self.running:
                raise Refusal(r.ERR_RUNNING, "card is still running, access not possible")
            self.memory = Memory()  # the FIFO takes its place
            rate_hz, room_bytes = setup[r.SPC_SAMPLERATE], setup.on_card(r.SPC_DATA_OUTBUFSIZE)
            self.fifo = Fifo(
                buffer,
                setup.frame_bytes,
                rate_hz,
                room_bytes,
                self._speed(buffer),
                self._faults,
                keeps=self._keeps_streams,
            )
        elif buffer.n_bytes > (room := self._room_bytes):
            raise refuse(buffer.n_bytes, f"at most {room} bytes; set the size first")
        self.buffer = buffer

    @property
    def _room_bytes(self) -> int:
        """Bytes of the memory, or of the segment, that the next transfer fills."""
        if isinstance(self.memory, SequenceMemory):
            return self.memory.room_bytes
        return self.setup[r.SPC_MEMSIZE] * self.setup.frame_bytes

    def _start_dma(self, now_s: float) -> None:
        if self.buffer is None:
            raise Refusal(r.ERR_SEQUENCE, "no transfer buffer is defined")
        if self.fifo is not None:
            self.fifo.switch_dma(on=True, now_s=now_s)
            return
        if isinstance(self.memory, SequenceMemory):
            self.memory.check_unused(self.run.used if isinstance(self.run, SequenceRun) else None)
        data = self.buffer.fetch(0, self.buffer.n_bytes).copy()
        self.memory.send(now_s, data, self._speed(self.buffer))
        self.buffer = None  # it is used only once

    def _speed(self, buffer: Buffer) -> float:
        """Speed of a transfer, in bytes per second."""
        offset = buffer.address - self.continuous
        continuous = 0 <= offset < self.model.continuous_bytes
        bus = self.model.bus_bytes_per_s
        return self._faults.write_speed(buffer.notify_bytes, bus, continuous=continuous)

    @property
    def is_transferring(self) -> bool:
        """Whether the bus fetches samples from the transfer buffer."""
        return bool(self.memory.uploads) or (self.fifo is not None and self.fifo.is_transferring)

    def stop_dma(self, now_s: float) -> None:
        """Stop the transfer. Data that have not arrived are lost."""
        self.memory.drop()
        if self.fifo is not None:
            self.fifo.switch_dma(on=False, now_s=now_s)
