"""Steps of the first contact that measure the transfer to the card, its speed, positions and ends."""

from __future__ import annotations

import statistics
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import DeviceError
from labseq.plugin.native import n_cores
from labseq_spcm.first_contact_bench import Bench, Transfer
from labseq_spcm.limits import FRAME_BYTES

UNITS: Final = {
    **dict.fromkeys(("user", "continuous"), ("bytes", "bytes_per_s")),
    **dict.fromkeys(("status_playing", "status_dry"), ("bits",)),
    **dict.fromkeys(
        ("after_def_transfer", "after_hand_over", "after_startdma", "after_fetching"), ("bytes",)
    ),
    **dict.fromkeys(("notify_size", "card_buffer"), ("bytes",)),
    "sample_rate": ("hz",),
}
"""Units that the names of the results leave out."""
PAGE: Final = 4096
NOTIFY_BYTES: Final = (PAGE << 2, PAGE << 4, PAGE << 7, PAGE << 9, PAGE << 10)
"""The notify sizes of the manual's table, 16 KiB to 4 MiB."""
N_LAGS: Final = 100
"""Number of blocks whose report is waited for."""
FOLLOWED_S: Final = 0.1
"""How long the position is followed while the card plays."""
SUSTAINED_S: Final = 1.0
"""How long the card plays at the driver's sample rate."""
POLL_S: Final = 20e-6
"""Time between two looks, on a virtual clock, during steps of many milliseconds."""


def write_speed(bench: Bench) -> dict[str, Any]:
    """Write to the card's memory at several notify sizes, from a user's and from the driver's buffer.

    Returns:
        "user" and "continuous", pairs of notify size in bytes and speed in bytes per second. "continuous" is
        empty if there is no such buffer.
    """
    sizes = sorted({*NOTIFY_BYTES, bench.settings.notify_size})
    buffers = {"user": bench.silence(24 << 20), "continuous": bench.continuous()}
    return {
        name: [] if frames is None else [(size, _speed(bench, frames, size)) for size in sizes]
        for name, frames in buffers.items()
    }


def _speed(bench: Bench, frames: NDArray[np.int16], notify_bytes: int) -> float:
    """Speed from two amounts, so that the fixed time of a transfer drops out, the fastest of five."""
    large = frames.nbytes // notify_bytes * notify_bytes
    small = max(notify_bytes, large // 5 // notify_bytes * notify_bytes)
    if large <= small:
        return 0.0
    took_s = [min(_write_s(bench, frames, notify_bytes, n) for _ in range(5)) for n in (small, large)]
    return (large - small) / max(1e-9, took_s[1] - took_s[0])


def _write_s(bench: Bench, frames: NDArray[np.int16], notify_bytes: int, n_bytes: int) -> float:
    transfer = bench.transfer(frames, notify_bytes, 1 << 26)
    transfer.hand_over(n_bytes)
    transfer.start_dma()
    took_s = bench.until(lambda: transfer.reported >= n_bytes, 5.0, f"writing {n_bytes} bytes", POLL_S)
    bench.card.stop()
    return took_s


def positions(bench: Bench) -> dict[str, Any]:
    """Read SPC_DATA_AVAIL_USER_LEN before, during and after a hand-over, and how much fits on the card.

    Returns:
        Bytes that are free for the user after each call, bytes that the card fetches before the start, and
        how long a hand-over takes per byte.
    """
    buffer_bytes = bench.settings.card_buffer
    frames = bench.silence(max(16 << 20, 8 * buffer_bytes))
    transfer = bench.transfer(frames, PAGE, buffer_bytes)
    free = {"after_def_transfer": transfer.user_bytes}
    one_s = bench.timed(lambda: transfer.hand_over(PAGE))
    free["after_hand_over"] = transfer.user_bytes
    transfer.start_dma()
    free["after_startdma"] = transfer.user_bytes
    transfer.settled()
    free["after_fetching"] = transfer.user_bytes
    rest = frames.nbytes - PAGE
    rest_s = bench.timed(lambda: transfer.hand_over(rest))
    fetched = transfer.settled()
    bench.card.stop()
    return {
        "buffer_bytes": frames.nbytes,
        "user_len_bytes": free,
        "card_buffer_bytes": buffer_bytes,
        "fetched_before_start_bytes": fetched,
        "hand_over_s_per_byte": max(0.0, rest_s - one_s) / rest,
    }


def lag(bench: Bench) -> dict[str, Any]:
    """How late the card reports its fetches, at rest, with a busy computer, and while it plays.

    Each figure is the time of the last look that did not show the report yet, so a computer that is busy with
    something else makes it smaller, not larger.

    Returns:
        Medians and worst cases in seconds. "playing_spread_s" is the variation of the report while the card
        plays, "rate_error" the relative difference of its clock from the computer's.
    """
    idle_s = _report_lags(bench)
    spread_s, rate_error = _playing(bench)
    with _busy_computer():
        busy_s = _report_lags(bench)
    worst_s = max(*idle_s, *busy_s)
    return {
        "idle_median_s": statistics.median(idle_s),
        "idle_worst_s": max(idle_s),
        "busy_median_s": statistics.median(busy_s),
        "busy_worst_s": max(busy_s),
        "playing_spread_s": spread_s,
        "rate_error": rate_error,
        "worst_s": max(worst_s, statistics.median(idle_s) + spread_s),
    }


def _report_lags(bench: Bench) -> list[float]:
    """From the end of the transfer of one page to its report, in seconds.

    The transfer itself is known from how much longer eight pages take than one.
    """
    transfer = bench.transfer(bench.silence(16 << 20), PAGE, 16 << 20)
    transfer.hand_over(PAGE)
    transfer.start_dma()
    transfer.settled()

    def reported_s(n_pages: int) -> float:
        transfer.hand_over(n_pages * PAGE)
        expected = transfer.handed
        report = "the report of a fetched page"
        return bench.last_missed(lambda: transfer.reported >= expected, 1.0, report)

    one_s, eight_s = ([reported_s(n) for _ in range(N_LAGS)] for n in (1, 8))
    bench.card.stop()
    page_s = max(0.0, min(eight_s) - min(one_s)) / 7
    return [max(0.0, took_s - page_s) for took_s in one_s]


def _playing(bench: Bench) -> tuple[float, float]:
    """Follow the position of a playing card. Returns the variation of its report (s) and its rate error."""
    block = bench.settings.notify_size
    transfer = bench.transfer(bench.silence(16 << 20), block, bench.settings.card_buffer)
    transfer.hand_over(transfer.frames.nbytes)
    transfer.start_dma()
    transfer.settled()
    transfer.play()
    rate = bench.card.read(bench.card.spcm.SPC_SAMPLERATE) * FRAME_BYTES
    start_s = missed_s = bench.now()
    seen, last = list[tuple[float, float]](), transfer.reported
    while (now_s := bench.now()) - start_s < FOLLOWED_S:
        user_bytes, looked_s = transfer.user_bytes, bench.now()
        count = transfer.fetched(user_bytes)
        transfer.feed(user_bytes)
        if count != last:  # the next block was not reported at the look before, and this one is now
            seen.append((missed_s - (last + block) / rate, looked_s - count / rate))
        missed_s, last = now_s, count
        bench.look_again(5e-6)
    bench.card.stop()
    if len(seen) < 16:
        text = f"the card reported {len(seen)} positions while it played for {FOLLOWED_S:g} s"
        raise DeviceError(bench.name, text)
    at_least_s, at_most_s = np.array(
        seen[len(seen) // 8 :]
    ).T  # the first blocks fill the FIFO behind the memory
    early, late = np.array_split(at_most_s, 2)
    drift = (late.min() - early.min()) / (FOLLOWED_S / 2)
    return max(0.0, float(at_least_s.max() - at_most_s.min())), float(-drift)


@contextmanager
def _busy_computer() -> Generator[None]:
    """Copy memory on every core within the block."""
    ended = threading.Event()

    def copy() -> None:
        source = np.ones(1 << 21)
        out = np.empty_like(source)
        while not ended.is_set():
            np.copyto(out, source)

    threads = [threading.Thread(target=copy, daemon=True) for _ in range(n_cores())]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def sustained(bench: Bench) -> dict[str, Any]:
    """Play silence at the driver's sample rate, with its block sizes, and keep the card supplied.

    Returns:
        How long it played, in seconds, and whether it ran dry.
    """
    block = bench.settings.notify_size
    buffer_bytes = bench.settings.card_buffer
    transfer = bench.transfer(bench.silence(64 << 20), block, buffer_bytes, at_full_rate=True)
    transfer.hand_over(transfer.frames.nbytes)
    transfer.start_dma()
    transfer.settled()
    transfer.play()
    card, spcm = bench.card, bench.card.spcm
    start_s = bench.now()
    ran_dry = False
    while not ran_dry and bench.now() - start_s < SUSTAINED_S:
        bench.look_again(5 * POLL_S)
        ran_dry = bool(card.status & (spcm.M2STAT_DATA_OVERRUN | spcm.M2STAT_CARD_READY))
        if not ran_dry:
            transfer.feed(transfer.user_bytes)
    played_s = bench.now() - start_s
    card.stop()
    return {"sample_rate_hz": bench.settings.sample_rate, "played_s": played_s, "ran_dry": ran_dry}


def starve(bench: Bench) -> dict[str, Any]:
    """Let the card run dry on purpose, with its outputs off, and start it again.

    Returns:
        The status bits before and after, which of OVERRUN and READY it has and how long after the last
        sample, the answer to the next hand-over, and whether and how fast it plays again.
    """
    block = bench.settings.notify_size
    transfer = bench.transfer(bench.silence(1 << 20), block, bench.settings.card_buffer)
    transfer.hand_over(transfer.frames.nbytes)
    transfer.start_dma()
    transfer.settled()
    transfer.play()
    card, spcm = bench.card, bench.card.spcm
    rate = card.read(spcm.SPC_SAMPLERATE) * FRAME_BYTES
    running, ended = card.status, spcm.M2STAT_DATA_OVERRUN | spcm.M2STAT_CARD_READY
    dry = "the end of a card that runs dry"
    took_s = bench.until(lambda: bool(card.status & ended), 1.0, dry)
    bench.pause(10e-3)  # the second bit may come a little later
    status = card.status
    answer = _answer(transfer)
    user_bytes = bench.read_if_known(spcm.SPC_DATA_AVAIL_USER_LEN)
    again = Transfer(bench, transfer.frames, block)
    recovery_s = bench.timed(lambda: _begin_again(bench, again))
    again.settled()
    recovery_s += bench.timed(again.play)
    bench.pause(50e-6)
    recovers = card.running and not card.status & spcm.M2STAT_DATA_OVERRUN
    card.stop()
    return {
        "status_playing": running,
        "status_dry": status,
        "overrun": bool(status & spcm.M2STAT_DATA_OVERRUN),
        "ready": bool(status & spcm.M2STAT_CARD_READY),
        "noticed_after_s": took_s - transfer.frames.nbytes / rate,
        "hand_over_answer": answer,
        "user_len_bytes": user_bytes,
        "recovers": recovers,
        "recovery_s": recovery_s,
    }


def _answer(transfer: Transfer) -> str:
    """The library's answer to samples for a card that ran dry, "" if it takes them."""
    try:
        transfer.hand_over(transfer.notify_bytes)
    except DeviceError as error:
        return error.message
    return ""


def _begin_again(bench: Bench, transfer: Transfer) -> None:
    bench.card.stop()
    bench.card.define_transfer(transfer.frames, transfer.notify_bytes)
    transfer.hand_over(transfer.frames.nbytes)
    transfer.start_dma()
