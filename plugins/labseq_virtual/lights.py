"""Which light the lines let on the atoms, and when."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final

from labseq.plugin import ConfigError, LineProgram, LineSpec
from labseq_virtual.settings import LightSettings

N_REMEMBERED: Final = 8
"""Programs that are kept: an event asks about the last one or two."""


class Lights:
    """What the lines do to the light; without lines all of it is on whenever it is needed.

    Args:
        settings: Which lines each kind of light needs.
        specs: The lines of the profile.

    Raises:
        ConfigError: The settings name a line that the profile does not have.
    """

    def __init__(self, settings: LightSettings, specs: Sequence[LineSpec]) -> None:
        names = [spec.name for spec in specs]
        self._needs = {kind: getattr(settings, kind) for kind in LightSettings.model_fields}
        for kind, needed in self._needs.items():
            if names and (missing := [name for name in needed if name not in names]):
                known = ", ".join(f"'{name}'" for name in names)
                raise ConfigError(f"`lights.{kind}` names a line '{missing[0]}'; the profile has {known}")
        self._triggers = {spec.name: spec.triggers for spec in specs if spec.triggers}
        self._wires: dict[str, Callable[[float], object]] = {}
        self._played: deque[tuple[float, LineProgram]] = deque(maxlen=N_REMEMBERED)

    def forget(self) -> None:
        """All light is on whenever it is needed, until the lines are told of again."""
        self._played.clear()
        self._wires.clear()

    def wire(self, role: str, on_edge: Callable[[float], object]) -> None:
        """Tell a device of the edges of the line that triggers its role, from now on."""
        self._wires[role] = on_edge

    def switch(self, program: LineProgram, t_start_s: float) -> None:
        """Let the lines do as a program says, and trigger what is wired to them; the last one ends."""
        self._played.append((t_start_s, program))
        edges = [
            (t_start_s + t_s, role) for line, role in self._triggers.items() for t_s in program.rising(line)
        ]
        for t_s, role in sorted(edges):
            if role in self._wires:
                self._wires[role](t_s)

    def fraction_on(self, kind: str, start_s: float, end_s: float) -> float:
        """For which part of a time a kind of light is on: all lines that it needs are.

        Args:
            kind: "loading", "cooling" or "imaging".
            start_s: Start on the session's clock.
            end_s: End; not before the start.
        """
        needed = self._needs[kind]
        if not self._played or not needed:
            return 1.0
        if end_s <= start_s:
            return float(self._all_on(needed, start_s))
        edges = [start_s, *(t for t in self._edges() if start_s < t < end_s), end_s]
        lit_s = sum(b - a for a, b in pairwise(edges) if self._all_on(needed, (a + b) / 2))
        return lit_s / (end_s - start_s)

    def _edges(self) -> list[float]:
        return sorted({t_start_s + t for t_start_s, program in self._played for t in program.t_s.tolist()})

    def _all_on(self, names: Sequence[str], t_s: float) -> bool:
        """The state at a time is that of the last program that began before it."""
        before = [(start_s, program) for start_s, program in self._played if start_s <= t_s]
        if not before:
            return False
        start_s, program = before[-1]
        edge = int((program.t_s <= t_s - start_s).sum()) - 1
        return all(bool(program.on[edge, program.lines.index(name)]) for name in names)
