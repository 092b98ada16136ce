"""Virtual lines, an instrument of any kind, and a synthesizer that drives the atoms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from labseq.plugin import (
    Context,
    Device,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    LineProgram,
    Lines,
    LinesFacts,
    format_quantity,
)
from labseq.plugin.lines import idle_program, off_program
from labseq.plugin.messages import unknown_name
from labseq_virtual.settings import DeviceSettings, LinesSettings, SynthesizerSettings
from labseq_virtual.tweezers import VirtualDriver

ROUNDING_S = 1e-9
"""Tolerance for comparing times, in seconds, because sums of times are rounded."""


class VirtualLines(VirtualDriver, Lines):
    """Ideal lines, which send exactly the compiled program to the simulation.

    Every ``fire`` needs a compiled program and its own ``arm``, so no program is fired by mistake.
    """

    def __init__(self, settings: LinesSettings, context: Context) -> None:
        super().__init__(context, "lines")
        self._settings = settings
        self._specs = context.lines
        self._compiled: LineProgram | None = None
        self._is_armed = False
        self._end_s = 0.0

    @property
    def lines_facts(self) -> LinesFacts:
        """Channels and limits."""
        settings = self._settings
        named = (spec.channel for spec in self._specs if isinstance(spec.channel, str))
        channels = (
            *range(settings.n_channels),
            *named,
        )  # a dry run replaces boxes that name their outputs
        return LinesFacts(channels, settings.resolution, settings.shortest, settings.max_edges)

    def idle(self) -> None:
        """Turn on the lines that are on between steps.

        Raises:
            DeviceError: Not open.
        """
        self._check_open()
        self._play(idle_program(self._specs))

    def compile(self, program: LineProgram) -> None:
        """Check a program and keep it for the next ``fire``.

        Raises:
            LimitError: More edges, or edges closer together, than the settings allow.
            DeviceError: Not open, or lines that the profile does not declare.
        """
        self._check_open()
        self.check_program(program)
        self._compiled, self._is_armed = program, False

    def check_program(self, program: LineProgram) -> None:
        """Refuse a program that the settings do not allow.

        Raises:
            LimitError: More edges, or edges closer together, than the settings allow.
            DeviceError: Lines that the profile does not declare.
        """
        known = tuple(spec.name for spec in self._specs)
        if program.lines != known:
            raise DeviceError(self._name, f"a program has the lines {program.lines}; expected {known}")
        n_edges, most = len(program.t_s), self._settings.max_edges
        what = f"{self._name}: `{program.kind}`"
        if n_edges > most:
            raise LimitError(f"{what}: number of edges", n_edges, f"at most {most}")
        shortest_s = min((program.t_s[1:] - program.t_s[:-1]).tolist(), default=float("inf"))
        if shortest_s < self._settings.shortest - ROUNDING_S:
            limit = f"at least {format_quantity(self._settings.shortest, 'time')}"
            raise LimitError(f"{what}: time between two edges", format_quantity(shortest_s, "time"), limit)

    def arm(self) -> None:
        """Get ready to fire the program compiled last.

        Raises:
            DeviceError: Not open, or nothing was compiled.
        """
        self._check_open()
        if self._compiled is None:
            raise DeviceError(self._name, "arm() without a compiled program; call compile() first")
        self._is_armed = True

    def fire(self) -> None:
        """Start the program, and return at once.

        Raises:
            DeviceError: Not armed, or the last program has not ended.
        """
        self._check_open()
        now_s = self._clock.now()
        if not self._is_armed or self._compiled is None:
            raise DeviceError(self._name, "fire() without arm(); call arm() before each fire()")
        if now_s < self._end_s - ROUNDING_S:
            raise DeviceError(self._name, f"fired during a program that ends at {self._end_s:.6f} s")
        self._is_armed = False
        self._play(self._compiled)
        self._end_s = now_s + self._compiled.duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """
        self._check_open()
        left_s = self._end_s - self._clock.now()
        self._clock.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s:
            text = f"the program of the lines has not ended after {format_quantity(timeout_s, 'time')}"
            raise DeviceTimeoutError(self._name, text, timeout_s)

    def safe_state(self) -> None:
        """Turn all lines off and forget the compiled program."""
        self._compiled, self._is_armed, self._end_s = None, False, 0.0
        if self._is_open:
            self._play(off_program(self._specs))

    def describe(self) -> Mapping[str, Any]:
        """Model, lines and limits."""
        lines = {spec.name: spec.channel for spec in self._specs}
        return {"model": "virtual lines", "lines": lines, **self._settings.model_dump(mode="json")}

    def _play(self, program: LineProgram) -> None:
        self._simulation.play("lines", program, self._clock.now())


class VirtualDevice(Device):
    """Accepts commands and remembers them as values.

    The value ``state`` is the last command ("closed" before ``open``, "ready"
    after it, "safe" in the safe state). The arguments of a command become values
    of the same name. After ``command("set", power=0.5)``, ``read("power")`` is 0.5.
    """

    def __init__(self, settings: DeviceSettings, context: Context) -> None:
        self._name = context.name or "device"
        self._commands = settings.commands
        self._values: dict[str, Any] = {**settings.values, "state": "closed"}
        self._is_open = False

    def open(self) -> None:
        """Get ready."""
        self._is_open = True
        self._values["state"] = "ready"

    def close(self) -> None:
        """Disconnect. Legal in any state."""
        self._is_open = False
        self._values["state"] = "closed"

    def safe_state(self) -> None:
        """Make the output harmless. Legal in any state."""
        if self._is_open:
            self._values["state"] = "safe"

    def check_command(self, name: str, **arguments: Any) -> None:  # noqa: ARG002 - any are kept
        """Refuse a command that the settings do not list. Without a list, any command is accepted.

        Raises:
            DeviceError: An unknown command.
        """
        if self._commands and name not in self._commands:
            raise unknown_name(self._name, "command", name, self._commands)

    def command(self, name: str, **arguments: Any) -> None:
        """Carry out a command.

        Raises:
            DeviceError: Not open, or an unknown command.
        """
        self._check_open()
        self.check_command(name)
        self._values.update(arguments)
        self._values["state"] = name

    def read(self, name: str) -> Any:
        """Read a value.

        Raises:
            DeviceError: Not open, or an unknown value.
        """
        self._check_open()
        if name not in self._values:
            raise unknown_name(self._name, "value", name, sorted(self._values))
        return self._values[name]

    def describe(self) -> Mapping[str, Any]:
        """Model, commands and values."""
        return {"model": "virtual device", "commands": list(self._commands), "values": dict(self._values)}

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")


DIMENSIONS: Final[Mapping[str, str]] = {"frequency": "frequency", "phase": "angle", "shift": "angle"}
"""Values of the synthesizer -> their dimensions."""


class VirtualSynthesizer(VirtualDriver, Device):
    """Has one command, ``set``, with any of ``frequency``, ``phase`` and ``shift``, which can be read."""

    def __init__(self, settings: SynthesizerSettings, context: Context) -> None:
        super().__init__(context, "synthesizer")
        self._settings = settings
        self._values: dict[str, float] = {}

    def open(self) -> None:
        """Connect to the simulation, with the values of the settings."""
        super().open()
        self._tune({name: getattr(self._settings, name) for name in DIMENSIONS})

    def safe_state(self) -> None:
        """Do nothing, because a line switches the drive."""

    def check_command(self, name: str, **arguments: Any) -> None:
        """Refuse an unknown command or argument, or one with another unit, with a ``DeviceError``."""
        self._in_si(name, arguments)

    def command(self, name: str, **arguments: Any) -> None:
        """Set values. Raises ``DeviceError`` if it is not open, and like ``check_command``."""
        self._check_open()
        self._tune({**self._values, **self._in_si(name, arguments)})

    def read(self, name: str) -> float:
        """A value in SI units. Raises ``DeviceError`` if it is unknown or the device never was open."""
        if name not in self._values:
            raise unknown_name(self._name, "value", name, [*self._values])
        return self._values[name]

    def describe(self) -> Mapping[str, Any]:
        """Model and values at the start."""
        return {"model": "virtual synthesizer", **self._settings.model_dump(mode="json")}

    def _tune(self, values: dict[str, float]) -> None:
        self._values = values
        # a lab's own simulation need not have atoms with two levels
        tune = getattr(self._simulation, "tune", None)
        if tune is not None:
            tune(self._name, values)

    def _in_si(self, command: str, arguments: Mapping[str, Any]) -> dict[str, float]:
        """The arguments as numbers in SI units. Text has a unit."""
        from labseq.plugin.units import parse_quantity  # only needed if a step sets values

        if command != "set":
            raise unknown_name(self._name, "command", command, ["set"])
        values: dict[str, float] = {}
        for name, value in arguments.items():
            if name not in DIMENSIONS:
                raise unknown_name(self._name, "argument", name, [*DIMENSIONS])
            try:
                values[name] = (
                    parse_quantity(value, DIMENSIONS[name]) if isinstance(value, str) else float(value)
                )
            except ValueError as error:
                raise DeviceError(self._name, f"{name}: {error}") from None
        return values
