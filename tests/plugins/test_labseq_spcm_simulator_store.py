"""Memory for what was streamed to the simulated Spectrum card."""

from __future__ import annotations

import numpy as np
from labseq_spcm.simulator.store import AREA, Store


def test_gives_as_much_as_is_asked_for() -> None:
    store = Store()
    assert [len(store.take(n)) for n in (1, 1000, AREA, AREA + 1)] == [1, 1000, AREA, AREA + 1]


def test_what_is_still_looked_at_keeps_its_values() -> None:
    store = Store()
    taken = [store.take(AREA // 2) for _ in range(8)]
    for k, part in enumerate(taken):
        part.fill(k)
    assert [np.unique(part).tolist() for part in taken] == [[k] for k in range(8)]


def test_a_part_of_it_is_enough_to_keep_it() -> None:
    store = Store()
    seen = store.take(AREA)[10:20]
    seen.fill(7)
    store.take(AREA).fill(1)
    store.take(AREA).fill(1)
    assert seen.tolist() == [7] * 10


def test_memory_that_nobody_looks_at_is_used_again() -> None:
    store = Store()
    addresses = {store.take(AREA).ctypes.data for _ in range(20)}
    assert len(addresses) <= 2


def test_memory_that_was_reserved_is_not_asked_for_again() -> None:
    store = Store()
    store.reserve(3 * AREA)
    reserved = {area.ctypes.data for area in store._free}
    taken = [store.take(AREA) for _ in range(3)]
    assert {part.ctypes.data for part in taken} == reserved
