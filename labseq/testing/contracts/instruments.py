"""Promises of instruments with commands and values, and of timing boxes that switch lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np

from labseq.errors import DeviceError
from labseq.model import LineProgram, LineSpec
from labseq.roles import Context, Device, Lines, overrides
from labseq.sequencer.lines import line_program
from labseq.testing.contracts.hardware import Action, Factory, HardwareContract, Wait
from labseq.testing.contracts.promises import doing, promise, refusal
from labseq.testing.fakes import RecordingSimulation


class DeviceContract(HardwareContract[Device]):
    """Promises of an instrument with commands and values.

    Attributes:
        commands: Every command of the device, with arguments that it accepts.
        excessive_commands: Commands with arguments beyond a limit of the device, as
            description -> (command, arguments).
        values: Every value that can be read.
    """

    role: ClassVar[str] = "instrument_7"
    commands: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    excessive_commands: ClassVar[Mapping[str, tuple[str, Mapping[str, Any]]]] = {}
    values: ClassVar[Sequence[str]] = ()

    def work(self, device: Device) -> None:
        """Carry out every command."""
        for name, arguments in self.commands.items():
            device.command(name, **arguments)

    def uses(self) -> Mapping[str, Action[Device]]:
        """Send every command and read every value."""
        commands = {f"command('{name}')": self._command(name, given) for name, given in self.commands.items()}
        return {**commands, **{f"read('{name}')": _read(name) for name in self.values}}

    def states(self) -> Mapping[str, Action[Device]]:
        """States after each command."""
        return {f"after '{name}'": self._command(name, given) for name, given in self.commands.items()}

    def excesses(self) -> Mapping[str, Action[Device]]:
        """The commands in ``excessive_commands``."""
        return {what: self._command(*command) for what, command in self.excessive_commands.items()}

    @promise("every command and value that the device declares works")
    def test_does_what_it_declares(self, factory: Factory[Device]) -> None:
        """Use commands and values in the order in which the test lists them."""
        with self.opened(factory) as (device, _):
            for name, arguments in self.commands.items():
                with doing(f"command('{name}')"):
                    device.command(name, **arguments)
            for name in self.values:
                with doing(f"read('{name}')"):
                    device.read(name)

    @promise("an unknown command raises a DeviceError that names the known ones")
    def test_refuses_unknown_commands(self, factory: Factory[Device]) -> None:
        """A user who mistypes a command sees the known ones."""
        with self.opened(factory) as (device, _):
            error = refusal(DeviceError, "an unknown command", device.command, "no_such_command")
            missing = [name for name in self.commands if name not in str(error)]
            assert not missing, f"'{error}' does not name {', '.join(missing)}"

    @promise("an unknown value raises a DeviceError that names the known ones")
    def test_refuses_unknown_values(self, factory: Factory[Device]) -> None:
        """A user who mistypes a value sees the known ones."""
        with self.opened(factory) as (device, _):
            error = refusal(DeviceError, "an unknown value", device.read, "no_such_value")
            missing = [name for name in self.values if name not in str(error)]
            assert not missing, f"'{error}' does not name {', '.join(missing)}"

    def _command(self, name: str, arguments: Mapping[str, Any]) -> Action[Device]:
        return lambda device: device.command(name, **arguments)


def _read(name: str) -> Action[Device]:
    return lambda device: device.read(name)


SPECS: Final = (
    LineSpec("cooling", 2, ("load", "rearrange", "idle")),
    LineSpec("mot", 3, ("load",), lag_s=2e-3, blinding=True),
    LineSpec("imaging", 4, ("image",), lead_s=1e-3, lag_s=0.5e-3),
    LineSpec("camera", 5, ("image",), pulse_s=0.2e-3, triggers="camera"),
    LineSpec("shutter", 6, ("image",), lead_s=2e-3, active_low=True),
)


class LinesContract(HardwareContract[Lines]):
    """Promises of a timing box.

    Attributes:
        specs: The lines connected to the box, which must have their channels.
        tolerance_s: Largest deviation of an edge's time, relative to the first edge, in seconds.
    """

    role: ClassVar[str] = "lines"
    specs: ClassVar[tuple[LineSpec, ...]] = SPECS
    tolerance_s: ClassVar[float] = 1e-6

    def context(self) -> Context:
        """The context of a device with the lines in ``specs``."""
        return replace(super().context(), lines=self.specs)

    def program(self, kind: str = "image", duration_s: float = 10e-3) -> LineProgram:
        """The program of the lines during a step."""
        return line_program(self.specs, kind, duration_s)

    def ready(self, device: Lines) -> None:
        """Compile a program, so that it can be armed and fired."""
        device.compile(self.program())

    def work(self, device: Lines) -> None:
        """Play the lines of one step, as the sequencer does."""
        device.compile(self.program())
        device.arm()
        device.fire()
        device.wait(5.0)

    def uses(self) -> Mapping[str, Action[Lines]]:
        """Compile, arm, fire, wait."""
        return {
            "compile()": lambda lines: lines.compile(self.program()),
            "arm()": lambda lines: lines.arm(),
            "fire()": lambda lines: lines.fire(),
            "wait()": lambda lines: lines.wait(0.1),
        }

    def states(self) -> Mapping[str, Action[Lines]]:
        """States with a compiled program, armed, and in the middle of a program."""

        def arm(lines: Lines) -> None:
            lines.compile(self.program("load", 50e-3))
            lines.arm()

        def fire(lines: Lines) -> None:
            arm(lines)
            lines.fire()

        return {"with a program": self.ready, "while armed": arm, "while a program runs": fire}

    def excesses(self) -> Mapping[str, Action[Lines]]:
        """Programs with more edges, or edges closer together, than any box can play."""

        def check(lines: Lines) -> None:
            if overrides(lines, Lines.check_program):
                lines.check_program(self._many(3, 1e-12))
            else:
                lines.compile(self._many(3, 1e-12))

        return {
            "a program of 1 000 000 edges": lambda lines: lines.compile(self._many(1_000_000, 1e-3)),
            "edges a picosecond apart": lambda lines: lines.compile(self._many(3, 1e-12)),
            "check_program() of edges a picosecond apart": check,
        }

    def waits(self) -> Mapping[str, Wait[Lines]]:
        """Waits for the end of a long program."""

        def enter(lines: Lines) -> None:
            lines.compile(self.program("load", 20.0))
            lines.arm()
            lines.fire()

        return {"wait() for a program of 20 s": Wait(0.1, enter, lambda lines: lines.wait(0.1))}

    @promise("the lines play exactly the program that was compiled, armed and fired")
    def test_does_what_was_compiled(self, factory: Factory[Lines]) -> None:
        """Step after step, with programs that repeat and change their length."""
        steps = (("load", 20e-3), ("image", 5e-3), ("rearrange", 8e-3), ("image", 5e-3), ("image", 7e-3))
        with self.opened(factory) as (lines, context):
            for kind, duration_s in steps:
                program, n_before = self.program(kind, duration_s), len(_played(context))
                with doing(f"`{kind}` for {duration_s} s"):
                    lines.compile(program)
                    lines.arm()
                    lines.fire()
                    lines.wait(5.0)
                for played in _played(context)[n_before:]:
                    self._compare(played, program)

    @promise("fire() returns at once, and wait() returns at the end of the program")
    def test_waits_for_the_end(self, factory: Factory[Lines]) -> None:
        """Time both calls, because the next step must begin after the lags."""
        with self.opened(factory) as (lines, context):
            program = self.program("load", 30e-3)
            lines.compile(program)
            lines.arm()
            fired_s = context.clock.now()
            lines.fire()
            assert context.clock.now() - fired_s < program.duration_s, "fire() waited for the end"
            lines.wait(5.0)
            waited_s = context.clock.now() - fired_s
            assert waited_s >= program.duration_s - 1e-6, f"wait() came back after {waited_s} s of 32 ms"

    @promise("each fire() needs its own arm()")
    def test_refuses_fire_without_arm(self, factory: Factory[Lines]) -> None:
        """Fire without arming, so that nothing is fired twice by mistake."""
        with self.opened(factory) as (lines, _):
            refusal(DeviceError, "arm() before compile()", lines.arm)
            lines.compile(self.program())
            refusal(DeviceError, "fire() before arm()", lines.fire)
            self.work(lines)
            refusal(DeviceError, "a second fire() after one arm()", lines.fire)

    @promise(
        "after safe_state() neither fire() nor arm() takes the program that was compiled",
        "let safe_state() forget the program, so that only compile() makes the next one possible",
    )
    def test_drops_its_program(self, factory: Factory[Lines]) -> None:
        """Fire and arm after safe_state() in every state."""
        with self.each_state(factory) as states:
            for state, lines, _ in states:
                lines.safe_state()
                refusal(DeviceError, f"fire() after safe_state() {state}", lines.fire)
                refusal(DeviceError, f"arm() after safe_state() {state}", lines.arm)

    @promise("lines are off after open() and safe_state(), and the `idle` lines are on after idle()")
    def test_rests(self, factory: Factory[Lines]) -> None:
        """Tested if the context's simulation records the programs."""
        idle = line_program(self.specs, "idle", 0.0).on[-1]
        off = np.zeros_like(idle)
        with self.opened(factory) as (lines, context):
            for method, wanted in (("open", off), ("idle", idle), ("safe_state", off)):
                getattr(lines, method)()  # open() once more, which has no effect
                if played := _played(context):
                    assert np.array_equal(played[-1].on[-1], wanted), f"after {method}(): {played[-1].on[-1]}"

    def _many(self, n_edges: int, apart_s: float) -> LineProgram:
        on = np.zeros((n_edges, len(self.specs)), np.bool_)
        on[::2, 0] = True
        names = tuple(spec.name for spec in self.specs)
        return LineProgram(
            "image", names, np.arange(n_edges, dtype=np.float64) * apart_s, on, 0.0, n_edges * apart_s
        )

    def _compare(self, played: LineProgram, wanted: LineProgram) -> None:
        text = f"`{wanted.kind}`: edges at {played.t_s} s; expected {wanted.t_s} s"
        assert played.t_s.shape == wanted.t_s.shape, text
        assert np.abs(played.t_s - wanted.t_s).max() <= self.tolerance_s, text
        assert np.array_equal(played.on, wanted.on), (
            f"`{wanted.kind}`: states {played.on}; expected {wanted.on}"
        )


def _played(context: Context) -> Sequence[LineProgram]:
    """The line programs that the simulation received. Empty if it does not record them."""
    simulation = context.simulation
    if not isinstance(simulation, RecordingSimulation):
        return []
    plays = [call.args for call in simulation.calls if call.method == "play"]
    return [args[1] for args in plays if args[0] == "lines"]
