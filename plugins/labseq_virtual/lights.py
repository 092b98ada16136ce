"""The light that the lines switch on at each time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise

from labseq.plugin import ConfigError, LineProgram, LineSpec
from labseq_virtual.settings import LightSettings


class Lights:
    """The light that is on, from the programs of the lines. Without lines, all light is always on.

    Args:
        settings: The lines that each kind of light needs.
        specs: The lines of the profile.
        of_qubit: The lines named in the settings of the two levels.

    Raises:
        ConfigError: The settings name a line that is not in the profile.
    """

    def __init__(
        self, settings: LightSettings, specs: Sequence[LineSpec], of_qubit: Sequence[str] = ()
    ) -> None:
        names = [spec.name for spec in specs]
        self._needs = {kind: getattr(settings, kind) for kind in LightSettings.model_fields}
        named = {f"lights.{kind}": needed for kind, needed in self._needs.items()} | {"qubit": of_qubit}
        for key, needed in named.items():
            if names and (missing := [name for name in needed if name not in names]):
                lines = ", ".join(f"'{name}'" for name in names)
                raise ConfigError(f"`{key}` names a line '{missing[0]}', but the profile has {lines}")
        self._triggers = {spec.name: spec.triggers for spec in specs if spec.triggers}
        self._switches = [spec.name for spec in specs if spec.turns_off == "static_tweezers"]
        self._wires: dict[str, Callable[[float, float], object]] = {}
        self._played: deque[tuple[float, LineProgram]] = deque(maxlen=8)  # events need the last one or two

    def reset(self) -> None:
        """Forget all programs, so that all light is on until the lines play again."""
        self._played.clear()
        self._wires.clear()

    def wire(self, role: str, on_pulse: Callable[[float, float], object]) -> None:
        """Call ``on_pulse`` with start and width of every later pulse of the line that triggers a role."""
        self._wires[role] = on_pulse

    def switch(self, program: LineProgram, t_start_s: float) -> None:
        """Start a program, which ends the one before, and trigger the devices wired to its lines."""
        self._played.append((t_start_s, program))
        pulses = [
            (t_start_s + on_s, off_s - on_s, role)
            for line, role in self._triggers.items()
            for on_s, off_s in program.spans(line)
        ]
        for t_s, width_s, role in sorted(pulses):
            if role in self._wires:
                self._wires[role](t_s, width_s)

    def tweezers_off(self, program: LineProgram) -> tuple[list[tuple[float, float]], bool]:
        """Times when a program turns the static tweezers off, in seconds, and whether they stay off."""
        stay_off = any(program.on[-1, program.lines.index(name)] for name in self._switches)
        return [span for name in self._switches for span in program.spans(name)], stay_off

    def fraction_on(self, kind: str, start_s: float, end_s: float) -> float:
        """Fraction of an interval during which a kind of light is on, because all its lines are on."""
        needed = self._needs[kind]
        if not self._played or not needed:
            return 1.0
        if end_s <= start_s:
            return float(self._all_on(needed, start_s))
        edges = [start_s, *(t for t in self._edges() if start_s < t < end_s), end_s]
        on_s = sum(b - a for a, b in pairwise(edges) if self._all_on(needed, (a + b) / 2))
        return on_s / (end_s - start_s)

    def _edges(self) -> list[float]:
        return sorted({t_start_s + t for t_start_s, program in self._played for t in program.t_s.tolist()})

    def _all_on(self, names: Sequence[str], t_s: float) -> bool:
        """Whether the last program that began before ``t_s`` has all these lines on at that time."""
        before = [(start_s, program) for start_s, program in self._played if start_s <= t_s]
        if not before:
            return False
        start_s, program = before[-1]
        edge = int((program.t_s <= t_s - start_s).sum()) - 1
        return all(bool(program.on[edge, program.lines.index(name)]) for name in names)
