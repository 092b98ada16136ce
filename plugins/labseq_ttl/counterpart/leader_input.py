"""A model of the box's start input, by which a leader says go, and of the outputs that answer it."""

from __future__ import annotations

from labseq_ttl.protocol import DEAF, IDLE, LATE, OWED


class LeaderInput:
    """What ``firmware/lead.c`` does, without its clock.

    Attributes:
        state: One of ``DEAF``, ``IDLE``, ``OWED``, ``LATE``.
        signs: Outputs that are on for the leader.
        n_go_signals: Edges that were taken.
        more_came: Whether an edge came that could not be taken.
        level: Level of the input; it is pulled up.
    """

    def __init__(self) -> None:
        self.state = DEAF
        self.signs = self.n_go_signals = 0
        self.more_came = False
        self.level = 1
        self._busy = self._ready = self._failed = 0

    def begin(self, busy: int, ready: int, failed: int) -> None:
        """Listen; edges of before do not count."""
        self._busy, self._ready, self._failed = busy, ready, failed
        self.state, self.signs, self.more_came = IDLE, 0, False

    def end(self) -> None:
        """Listen no more."""
        if self.state != DEAF:
            self.signs = self._failed if self.state == OWED else self.signs & ~self._busy
        self.state, self.more_came = DEAF, False

    def rise(self) -> bool:
        """The input rises; whether that is a go."""
        self.level = 1
        self.more_came = self.state in (OWED, LATE)
        if self.state != IDLE:
            return False
        self.state, self.signs = OWED, self._busy
        self.n_go_signals = (self.n_go_signals + 1) & 0xFFFF
        return True

    def pass_deadline(self) -> None:
        """Nobody has answered in time."""
        if self.state == OWED:
            self.state, self.signs = LATE, self._busy | self._failed

    def answer(self, *, is_ready: bool) -> str:
        """Tell the leader what came of its go; what the box says of it."""
        said = f"{self.state:02x} {self.more_came:02x}"
        self.signs = self._ready if is_ready and self.state != LATE else self._failed
        self.state, self.more_came = IDLE, False
        return said
