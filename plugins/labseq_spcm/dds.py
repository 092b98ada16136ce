"""Mode ``dds``: the card makes the tones itself."""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from labseq.plugin import DeviceTimeoutError, ToneProgram, TransientError
from labseq_spcm.card import POLL_S, TRANSFER_TIMEOUT_S, AwgCard
from labseq_spcm.dds_program import ENTRY, TYPE_INT64, Commands, Cores, compile_commands

AMPLITUDE_STEPSIZE: Final = 64
"""Finer amplitude slopes, in fewer and larger increments: 298 / 64 per second."""
ARRIVAL_S: Final = 20e-6
COMMANDS_PER_S: Final = 10e6
"""What commands take to the card by DMA (ColdMatter/EDMSuite, on an M4i.9622)."""
PORTION: Final = 1000
"""Commands that are sent in one call, when the queue has room for them; no block has as many."""


class Dds:
    """Queues a program's blocks, of which each waits for a tick of the timer.

    Commands go to the card by DMA. Before each portion is sent the card must have room for it; the
    rest is sent while it plays. A block that comes too late is noticed, by the card's own flag.

    Args:
        card: The open card.
        cores: Which cores drive which axis.

    Attributes:
        max_wait_s: How long the card can be left alone while it plays.
        render_s: What compiling took in the last ``prepare``, on this computer's clock.
    """

    max_wait_s = POLL_S
    render_s = 0.0

    def __init__(self, card: AwgCard, cores: Cores) -> None:
        self._card = card
        self._cores = cores
        self._commands = Commands(np.empty(0, ENTRY), np.zeros(0, np.int64))
        self._n_sent = 0
        self._n_events = 0
        spcm = card.spcm
        card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_STD_DDS, "card mode")
        self._most = card.read(spcm.SPC_DDS_QUEUE_CMD_MAX)
        self._reset()

    def _reset(self) -> None:
        """Forget all commands. The connections of the cores are read back: the card snaps wrong ones."""
        card, spcm = self._card, self._card.spcm
        card.write(spcm.SPC_DDS_CMD, spcm.SPCM_DDS_CMD_RESET, "reset of the DDS")
        card.write(spcm.SPC_DDS_CORES_ON_CH1, self._cores.masks[1], "cores of output 1")
        card.set(spcm.SPC_DDS_CORES_ON_CH0, self._cores.masks[0], "cores of output 0")
        card.set(spcm.SPC_DDS_CORES_ON_CH1, self._cores.masks[1], "cores of output 1")
        card.set(spcm.SPC_DDS_DATA_TRANSFER_MODE, spcm.SPCM_DDS_DTM_DMA, "DDS transfer mode")
        card.set(spcm.SPC_DDS_AMP_RAMP_STEPSIZE, AMPLITUDE_STEPSIZE, "DDS amplitude ramp step size")

    def prepare(self, program: ToneProgram) -> float:
        """Compile, and queue as much as there is room for.

        Returns:
            Playing time in seconds.

        Raises:
            LimitError: The DDS cannot play it.
            DeviceTimeoutError: The card does not take the commands.
        """
        start_s = time.perf_counter()
        self._commands = compile_commands(self._card.name, program, self._cores)
        self.render_s = time.perf_counter() - start_s
        self._n_sent = 0
        self._reset()
        deadline_s = self._card.clock.now() + TRANSFER_TIMEOUT_S
        while not self._n_sent:
            if self._card.clock.now() > deadline_s:
                text = "the DDS takes no commands: its queue stays full"
                raise DeviceTimeoutError(self._card.name, text, TRANSFER_TIMEOUT_S)
            if not self._feed():
                self._card.clock.sleep(POLL_S)
        self._card.clock.sleep(ARRIVAL_S + self._n_sent / COMMANDS_PER_S)
        return program.total_duration_s

    def start(self, command: int) -> None:
        """Start the card; let it hear triggers only when the first block waits for one.

        Raises:
            DeviceTimeoutError: The first block did not arrive.
        """
        card, spcm = self._card, self._card.spcm
        self._n_events = card.read(spcm.SPC_DDS_TRG_COUNT)
        card.command(spcm.M2CMD_CARD_START, "start")
        deadline_s = card.clock.now() + TRANSFER_TIMEOUT_S
        while not card.read(spcm.SPC_DDS_STATUS) & spcm.SPCM_DDS_STAT_WAITING_FOR_TRG:
            if card.clock.now() > deadline_s:
                text = "the DDS waits for no trigger: its first commands have not arrived"
                raise DeviceTimeoutError(card.name, text, TRANSFER_TIMEOUT_S)
            card.clock.sleep(ARRIVAL_S)
        card.command(command & ~spcm.M2CMD_CARD_START, "trigger")

    def finished(self) -> bool:
        """Queue more while there is room, and see whether the last block took effect.

        The queue's own count reaches 0 while a block still waits; only the count of events tells.

        Raises:
            TransientError: A block came too late.
        """
        card, spcm = self._card, self._card.spcm
        self._feed()
        n_events = card.read(spcm.SPC_DDS_TRG_COUNT) - self._n_events
        if n_events >= len(self._commands.ends) - 1:
            card.command(spcm.M2CMD_CARD_STOP, "stop")
            return True
        if card.read(spcm.SPC_DDS_STATUS) & (
            spcm.SPCM_DDS_STAT_QUEUE_UNDERRUN | spcm.SPCM_DDS_STAT_QUEUE_OVERRUN
        ):
            text = f"the DDS had no commands in time, after {n_events} of {len(self._commands.ends)} blocks"
            raise TransientError(f"{text}; use fewer tones at once, or the mode replay", card.name)
        return False

    def give_up(self) -> None:
        """Empty the queue; the card plays what is left in it at the next start otherwise."""
        self._commands = Commands(np.empty(0, ENTRY), np.zeros(0, np.int64))
        self._n_sent = 0
        self._reset()

    def _feed(self) -> bool:
        """Send whole blocks while there is room; returns whether any were sent.

        This is our own back-pressure: that of ``spcm``'s DDSCommandList never waits.
        """
        card, spcm = self._card, self._card.spcm
        entries, ends = self._commands.entries, self._commands.ends
        fed = False
        while self._n_sent < len(entries):
            portion = min(PORTION, len(entries) - self._n_sent)
            if portion > self._most - card.read(spcm.SPC_DDS_QUEUE_CMD_COUNT):
                return fed
            last = int(np.searchsorted(ends, self._n_sent + portion, "right")) - 1
            commands = np.append(entries[self._n_sent : ends[last]], self._send())
            card.write_list(commands, "DDS commands")
            self._n_sent = int(ends[last])
            fed = True
        return fed

    def _send(self) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        spcm = self._card.spcm
        return np.array([(spcm.SPC_DDS_CMD, TYPE_INT64, spcm.SPCM_DDS_CMD_WRITE_TO_CARD)], ENTRY)
