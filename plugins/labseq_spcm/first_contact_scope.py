"""Steps of the first contact that need an oscilloscope, which shows the outputs.

The user sets the oscilloscope before a step, and reads it afterwards, when the outputs are off.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DeviceTimeoutError, Plan
from labseq.plugin.first_contact import Reading
from labseq.plugin.motion import tone_program
from labseq_spcm import limits
from labseq_spcm.first_contact_bench import Bench
from labseq_spcm.first_contact_card import second_process
from labseq_spcm.first_contact_child import TONE_SAMPLES
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.set_up import close_relays, switch_output

N_SWITCHED: Final = 5
SWITCHED_S: Final = 0.2
"""How often, and for how long, the relays close."""
RELAYS: Final = (
    Reading("step_v", "the largest step at an output when a relay switches", "voltage", 0.0, 5.0),
    Reading("settling_s", "how long an output takes to settle after it", "time", 0.0, 1.0),
)

N_BURSTS: Final = 20
BURST_PAUSE_S: Final = 10e-3
OVERWRITE: Final = (
    Reading("bursts", f"the number of bursts, of {N_BURSTS} that were written", "fraction", 0, N_BURSTS),
    Reading("shortest_s", "the length of the shortest burst", "time", 0.0, 10e-3),
)

TRIGGERED_S: Final = 10.0
PULSE_SAMPLES: Final = 3200
TRIGGER: Final = (
    Reading("delay_s", "the delay from the edge at Ext0 to the first sample", "time", 0.0, 1e-3),
    Reading("jitter_s", "its peak-to-peak jitter", "time", 0.0, 1e-3),
)
KILL: Final = (Reading("tone_s", "how long the tone lasted in all", "time", 0.0, 10.0),)
RAMP: Final = (
    Reading("ramp_s", "how long the amplitude takes to fall before the tones end", "time", 0.0, 10e-3),
    Reading("last_v", "the peak voltage just before they end", "voltage", 0.0, 3.0),
)


def tone(n_samples: int) -> NDArray[np.int16]:
    """A tone of eight periods on both outputs, which can be repeated, int16 (n_samples, 2).

    It begins at full scale, so that an oscilloscope shows its first sample as an edge.
    """
    turns = 8 * np.arange(n_samples) / n_samples
    return np.repeat(np.rint(32767 * np.cos(2 * np.pi * turns)).astype(np.int16)[:, np.newaxis], 2, axis=1)


def relay_steps(bench: Bench) -> dict[str, Any]:
    """Close and open the relays of both outputs, without a tone."""
    bench.fresh()
    for _ in range(N_SWITCHED):
        close_relays(bench.card)
        bench.pause(SWITCHED_S)
        for channel in bench.card.outputs:
            switch_output(bench.card, channel, on=False)
        bench.card.write_setup()
        bench.pause(SWITCHED_S)
    return {"switched": N_SWITCHED}


def overwrite(bench: Bench) -> dict[str, Any]:
    """Write bursts over silence that was handed over and not fetched yet, as the mode ``stream`` does.

    Returns:
        How many of the bursts were written in time, their length, and how far ahead of the reported position,
        in seconds.
    """
    settings = bench.settings
    block = settings.notify_size // limits.FRAME_BYTES
    frames = bench.silence(16 << 20)
    transfer = bench.transfer(frames, settings.notify_size, settings.card_buffer, at_full_rate=True)
    rate_hz = bench.card.read(bench.card.spcm.SPC_SAMPLERATE)
    on_card = (settings.card_buffer + limits.OUTPUT_FIFO_BYTES) / limits.FRAME_BYTES
    ahead = max(2, int((settings.look_ahead_s(rate_hz) * rate_hz - on_card) / block))
    burst, ring = tone(block), frames.reshape(-1, block, 2)
    transfer.hand_over(frames.nbytes)
    transfer.start_dma()
    transfer.settled()
    close_relays(bench.card)
    bench.pause(limits.RELAY_S)
    transfer.play()
    next_s, places, n_in_time = bench.now() + BURST_PAUSE_S, list[int](), 0
    while len(places) < N_BURSTS or bench.now() < next_s:
        bench.look_again(20e-6)
        user_bytes = transfer.user_bytes
        fetched = transfer.fetched(user_bytes) // settings.notify_size
        if places and fetched > places[-1]:  # silent again before the block is handed over once more, as
            ring[places[-1] % len(ring)] = 0  # a card that copied it then would play it a round later
        transfer.feed(user_bytes)
        if len(places) < N_BURSTS and bench.now() >= next_s:
            next_s += BURST_PAUSE_S
            places.append(fetched + ahead)
            ring[places[-1] % len(ring)] = burst
            # the computer may have done something else meanwhile
            n_in_time += transfer.reported // settings.notify_size < places[-1] - 1
    bench.card.stop()
    return {"in_time": n_in_time, "burst_s": block / rate_hz, "ahead_s": ahead * block / rate_hz}


def trigger(bench: Bench) -> dict[str, Any]:
    """Play a short pulse at each edge at Ext0, for ten seconds.

    Returns:
        How often it played, and the delay that the manual gives, in seconds.
    """
    bench.settings, settings = bench.settings.model_copy(update={"trigger": "external"}), bench.settings
    try:
        card, spcm = bench.fresh(), bench.card.spcm
    finally:
        bench.settings = settings
    card.set(spcm.SPC_MEMSIZE, PULSE_SAMPLES, "memory size")
    frames = bench.silence(PULSE_SAMPLES * limits.FRAME_BYTES)
    frames[:] = tone(PULSE_SAMPLES)
    card.upload(frames)
    close_relays(card)
    bench.pause(limits.RELAY_S)
    n_played, until_s = 0, bench.now() + TRIGGERED_S
    while bench.now() < until_s:
        card.command(spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER, "start")
        while card.running and bench.now() < until_s:
            bench.look_again(100e-6)
        n_played += not card.running
    if not n_played:
        hint = "check the generator, the cable at Ext0, trigger_level and trigger_50_ohm"
        raise DeviceTimeoutError(bench.name, f"no trigger came; {hint}", TRIGGERED_S)
    rate_hz = card.read(spcm.SPC_SAMPLERATE)
    return {"played": n_played, "manual_delay_s": limits.trigger_delay_s(rate_hz)}


def killed(bench: Bench) -> dict[str, Any]:
    """Leave a tone in the memory, and kill the process that plays it (see ``second_process``)."""
    card, spcm = bench.fresh(), bench.card.spcm
    card.set(spcm.SPC_MEMSIZE, TONE_SAMPLES, "memory size")
    frames = bench.silence(TONE_SAMPLES * limits.FRAME_BYTES)
    frames[:] = tone(TONE_SAMPLES)
    card.upload(frames)
    return second_process(bench, with_tone=True)


def ramp(bench: Bench) -> dict[str, Any]:
    """Play a program with the driver, at the profile's full scale, and have it make the card safe.

    Returns:
        The amplitude, in volts, and how long the driver's ``safe_state`` took, in seconds.
    """
    settings = bench.settings.model_copy(update={"mode": "replay", "trigger": "software", "keep_warm": None})
    grid, motion = bench.context.grid, bench.context.motion
    site, next_site = np.array([(0, 0)]), np.array([(0, min(1, grid.n_cols - 1))])
    moves = Plan.from_batches([(site, next_site), (next_site, site)] * 20)
    with bench.lent_to(SpcmMobileTweezers(settings, bench.context)) as driver:
        driver.library = bench.library
        driver.warm()
        driver.open()
        driver.prepare(tone_program(moves, grid, motion))
        driver.play()
        bench.pause(3e-3)
        took_s = bench.timed(driver.safe_state)
    return {"full_scale_v": motion.rf.full_scale_v, "safe_state_s": took_s}
