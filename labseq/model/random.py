"""Random numbers that come out the same, whenever a shot is repeated or resumed."""

from __future__ import annotations

import zlib

import numpy as np


class RandomStream:
    """The random numbers of one consumer (the simulation, a device).

    Shot k in its attempt-th try draws from ``SeedSequence(seed, spawn_key=(k,
    attempt))``, whatever happened before; the machine's own disorder comes from
    the seed alone. Consumers other than the simulation get streams of their own,
    told apart by name, so that adding one does not change the others' draws.

    Args:
        seed: The run's seed.
        name: Name of the consumer; "" is the simulation.
    """

    def __init__(self, seed: int, name: str = "") -> None:
        self.seed = seed
        self.name = name
        self._key = (zlib.crc32(name.encode()),) if name else ()
        self._shot = self.machine()

    def machine(self) -> np.random.Generator:
        """A fresh generator for what does not change from shot to shot."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=self._key))

    def begin_shot(self, shot_index: int, attempt: int) -> None:
        """Start the numbers of a shot; the sequencer calls it."""
        key = (shot_index, attempt, *self._key)
        self._shot = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    @property
    def shot(self) -> np.random.Generator:
        """The generator of the current shot."""
        return self._shot
