"""Which program is in which slot of the box."""

from __future__ import annotations

from collections import OrderedDict

from labseq_ttl.protocol import SLOTS, Edge


class Slots:
    """The programs that the box knows; the one that was not used for the longest time gives way."""

    def __init__(self) -> None:
        self._slot_of: OrderedDict[tuple[Edge, ...], int] = OrderedDict()

    def find(self, program: tuple[Edge, ...]) -> int | None:
        """The slot of a program, which is now the last used; None if the box does not know it."""
        if program in self._slot_of:
            self._slot_of.move_to_end(program)
        return self._slot_of.get(program)

    def free(self) -> int:
        """A slot for a new program; what was there is forgotten."""
        if len(self._slot_of) < SLOTS:
            return min(set(range(SLOTS)) - set(self._slot_of.values()))
        return self._slot_of.popitem(last=False)[1]

    def keep(self, program: tuple[Edge, ...], slot: int) -> None:
        """Note that a program is now in a slot."""
        self._slot_of[program] = slot

    def clear(self) -> None:
        """Forget all: the box was reset."""
        self._slot_of.clear()
