"""The simulation: atoms, lights and tweezers of one run."""

from __future__ import annotations

import importlib
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    WHOLE_SENSOR,
    ConfigError,
    Context,
    DepthRamp,
    DeviceError,
    Frame,
    LimitError,
    LineProgram,
    LineSpec,
    Occupancy,
    RandomStream,
    RfSource,
    SensorMode,
    Signal,
    Simulation,
    SiteGrid,
    ToneProgram,
    ToneSource,
    TweezerAmplitudes,
)
from labseq_virtual.flight import RfTransport
from labseq_virtual.images import Exposure, SensorMixin
from labseq_virtual.played import PulseReceiver
from labseq_virtual.settings import LightSettings, WorldSettings
from labseq_virtual.transport import CAUSES, Places, Playing, Transport

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


Floats = NDArray[np.float64]


class StaticArray:
    """Depths of all sites, as fractions of the nominal one.

    At full light the depth of a site is the product of its row's and its column's power, of what the AODs
    make of these two tones (``tone_response``), and of the site's own disorder (``depth_disorder``), which
    no choice of amplitudes mends. The power of a tone goes as its amplitude squared; equal amplitudes that
    reach full scale together give the nominal depth.

    Args:
        grid: The grid of sites.
        settings: The constants.
    """

    def __init__(self, grid: SiteGrid, settings: WorldSettings) -> None:
        self._grid, self._settings = grid, settings
        self._site: Floats = np.ones(grid.shape)
        self._response: tuple[Floats, Floats] = np.ones(grid.n_rows), np.ones(grid.n_cols)
        self._power: tuple[Floats, Floats] = self._response
        self._level = 0.0
        self._source: ToneSource | None = None

    def draw(self, random: np.random.Generator) -> None:
        """Draw the disorder of the machine; all light off, amplitudes equal."""
        n_rows, n_cols = self._grid.shape
        disorder = random.standard_normal((n_rows, n_cols))
        self._site = np.maximum(0.0, 1.0 + self._settings.depth_disorder * disorder)
        row, col = (
            np.exp(self._settings.tone_response * random.standard_normal(n)) for n in (n_rows, n_cols)
        )
        self._response = row, col
        self._power = np.ones(n_rows), np.ones(n_cols)
        self._level = 0.0

    @property
    def depth(self) -> Floats:
        """Depth of each site now, float64 (n_rows, n_cols)."""
        rows, cols = (power * response for power, response in zip(self._power, self._response, strict=True))
        return self._level * self._site * rows[:, None] * cols

    def holds(self) -> NDArray[np.bool_]:
        """Which sites are deep enough to hold an atom, bool (n_rows, n_cols)."""
        return self.depth >= self._settings.lost_below_depth

    def switch_off(self) -> None:
        """No light, and nobody to listen to."""
        self._level = 0.0
        self._source = None

    def connect_outputs(self, source: ToneSource) -> None:
        """From now on the light is what these outputs play."""
        rows, cols = self._grid.shape
        self.drive(TweezerAmplitudes(np.zeros(rows), np.zeros(cols)))
        self._source, self._level = source, 1.0

    def receive_until(self, until_s: float, occupied: NDArray[np.bool_]) -> int:
        """Follow what the outputs played; atoms in too shallow tweezers are gone from ``occupied``.

        Returns:
            How many were lost.
        """
        before = np.count_nonzero(occupied)
        for amplitudes in () if self._source is None else self._source.played(until_s):
            self.drive(amplitudes)
            occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))

    def drive(self, amplitudes: TweezerAmplitudes) -> None:
        """Take over the amplitudes of the tones."""
        rows, cols = amplitudes.row, amplitudes.column
        self._power = (rows * len(rows)) ** 2, (cols * len(cols)) ** 2

    def ramp(self, ramp: DepthRamp, occupied: NDArray[np.bool_]) -> int:
        """Change the depth; atoms in tweezers that become too shallow are gone from ``occupied``.

        Returns:
            How many were lost.
        """
        before = np.count_nonzero(occupied)
        for level in (ramp.start, ramp.end):
            self._level = level
            occupied &= self.holds()
        return int(before - np.count_nonzero(occupied))


ROUNDING_S: Final = 1e-6
"""How far into the past an event may lie because sums of times were rounded."""


class World(SensorMixin, Simulation):
    """Atoms in static tweezers, what light does to them, and what a camera sees of it.

    Implements ``labseq.plugin.ReceivesOutput`` too.
    Events come in the order of time. A program of the mobile tweezers is carried out when it has ended, or as far as it came when another program takes
    its place: playing a program without segments cuts it short, and atoms in flight are lost. A
    ramp of the static tweezers that comes during a program or an exposure acts at its end.

    Mobile tweezers come in two kinds. A driver may tell its program, which is taken at its
    word (``transport.py``). Or the world listens to the driver's outputs, finds the
    tones in what they play, and lets atoms fly in the light (``flight.py``). Static tweezers
    likewise: they tell their ramps, or the world asks for the tones that they really play.

    Args:
        settings: Every constant of the model.
        context: Grid, clock and random numbers.
    """

    def __init__(self, settings: WorldSettings, context: Context) -> None:
        self._settings = settings
        self._name = context.name or "simulation"
        self._grid = context.grid
        self._random = context.random
        self._clock = context.clock
        self._places = Places(context.grid, settings.mobile_light)
        self._transport = Transport(context.grid, context.motion, settings, self._places)
        self._flight = RfTransport(context.grid, context.motion, settings, self._places)
        self._static = StaticArray(context.grid, settings)
        self._pulse_receiver: PulseReceiver | None = None
        self._seed = context.random.seed if settings.machine_seed is None else settings.machine_seed
        self._lights = Lights(settings.lights, context.lines)
        self._exposure = Exposure(context.grid, settings, self._seed)
        self._is_open = False
        self._forget()

    @property
    def loading_probability(self) -> float:
        """Probability that a site holds an atom after a long loading."""
        return self._settings.loading

    def open(self) -> None:
        """Draw the machine's own disorder; no atoms, static tweezers off."""
        machine = RandomStream(self._seed).machine()
        self._static.draw(machine)
        self._places.draw(machine)
        self._is_open = True
        self._forget()

    def warm(self) -> None:
        """Compile the kernels of what is heard and of atoms on their way, or load them."""
        for kernels in ("atom_kernels", "transport_kernels"):
            importlib.import_module(f"labseq_virtual.{kernels}")

    def close(self) -> None:
        """Forget everything."""
        self._is_open = False
        self._static.switch_off()
        self._pulse_receiver = None
        self._lights.forget()
        self._forget()

    def begin_shot(self) -> None:
        """Remove all atoms and draw the shot's factor on the transport loss."""
        self._check_open()
        self._forget()
        if self._pulse_receiver is not None:
            deque(self._pulse_receiver.receive_until(self._clock.now()), maxlen=0)  # light without atoms
        self._flight.begin_shot()
        spread = self._settings.transport_loss_spread
        self._loss_factor = math.exp(spread * self._random.shot.standard_normal() - spread**2 / 2)

    def load(self, t_start_s: float, duration_s: float) -> None:
        """Load every site whose static tweezer is on.

        A site is loaded afresh with the probability 1 - exp(-duration / loading_time)
        and then holds an atom with the probability ``loading``; else it stays as it was.

        Raises:
            DeviceError: The world is further in time already.
        """
        self._advance(t_start_s, "loading")
        lit_s = duration_s * self._lights.fraction_on("loading", t_start_s, t_start_s + duration_s)
        afresh = -math.expm1(-lit_s / self._settings.loading_time)
        draws = self._random.shot.random((2, *self._grid.shape))
        reloaded = (draws[0] < afresh) & self._static.holds()
        self._occupied = np.where(reloaded, draws[1] < self._settings.loading, self._occupied)
        self._now_s = t_start_s + duration_s

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Let a device's output act on the atoms, from ``t_start_s`` on.

        Raises:
            DeviceError: The world is further in time already, or the role does not
                play such a signal.
        """
        self._check_open()
        if role == "mobile_tweezers" and isinstance(signal, ToneProgram):
            self._play_tones(signal, t_start_s)
        elif role == "static_tweezers" and isinstance(signal, DepthRamp):
            self._play_ramp(signal, t_start_s)
        elif role == "static_tweezers" and isinstance(signal, TweezerAmplitudes):
            self._static.drive(signal)
        elif role == "lines" and isinstance(signal, LineProgram):
            self._lights.switch(signal, t_start_s)
        else:
            text = f"'{role}' played a {type(signal).__name__}; expected 'mobile_tweezers' with a ToneProgram"
            text += ", 'static_tweezers' with a DepthRamp or TweezerAmplitudes, or 'lines' with a LineProgram"
            raise DeviceError(self._name, text)

    def wire(self, role: str, on_edge: Callable[[float], object]) -> None:
        """Tell a device of the edges of the line that triggers its role, from now on."""
        self._lights.wire(role, on_edge)

    def connect_outputs(self, role: str, source: RfSource | ToneSource) -> None:
        """From now on listen to the outputs of a driver of tweezers, after the last of earlier ones.

        Raises:
            DeviceError: Another role wants to be heard.
            LimitError: What will be heard would be too blurred to tell the tones apart.
        """
        self._check_open()
        if role == "static_tweezers":
            self._static.connect_outputs(cast("ToneSource", source))
            return
        if role != "mobile_tweezers":
            raise DeviceError(self._name, f"'{role}' wants to be heard; only tweezers play RF")
        self._flight.refuse_blur()
        self._hear(self._clock.now())
        self._pulse_receiver = PulseReceiver(cast("RfSource", source), 2 * self._flight.margin_s)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """Take a frame; the imaging light heats some atoms out, and they shine until they are lost.

        Raises:
            DeviceError: The world is further in time already.
            LimitError: The exposure is not longer than 0, or the sensor cannot be used so.
        """
        if not exposure_s > 0:
            raise LimitError("the exposure", f"{exposure_s} s", "more than 0")
        self._advance(t_start_s, "an exposure")
        lit = self._lights.fraction_on("imaging", t_start_s, t_start_s + exposure_s)
        image, lost = self._exposure.take(self._occupied, exposure_s, self._random.shot, mode, lit)
        self._lost += lost
        self._now_s = t_start_s + exposure_s
        return Frame(image, exposure_s, t_start_s)

    def truth(self) -> Occupancy:
        """The true occupancy now, bool (n_rows, n_cols); after the program that is on its way."""
        self._finish_program()
        self._hear(self._clock.now())
        return self._occupied.copy()

    def losses(self) -> Mapping[str, int]:
        """Atoms lost since the shot began: to vacuum, imaging and too weak light, and by being moved."""
        return {cause: self._lost[cause] for cause in ("vacuum", "imaging", "light", *CAUSES)}

    def spot_powers(self) -> NDArray[np.float64]:
        """Power of each static tweezer now, float64 (n_rows, n_cols), over the nominal one."""
        self._check_open()
        self._hear(self._clock.now())
        return self._static.depth

    def atom_events(self, since_s: float) -> Mapping[str, NDArray[Any]]:
        """What the mobile tweezers did to atoms in this shot, as far as the world heard them play.

        Returns:
            "flights" (:data:`labseq_virtual.flight.FLIGHTS`) and "jumps"
            (:data:`labseq_virtual.flight.JUMPS`); nothing if it listens to nobody.
        """
        if self._pulse_receiver is None:
            return {}
        self._hear(self._clock.now())
        return self._flight.tables(since_s)

    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model, in SI, and the seed of its disorder."""
        return {"model": "labseq_virtual", "seed": self._seed, **self._settings.model_dump(mode="json")}

    def _play_tones(self, program: ToneProgram, t_start_s: float) -> None:
        self._finish_program(t_start_s)
        if program.n_segments == 0:  # silence: legal at any time, it makes safe
            return
        self._advance(t_start_s, "a program of the mobile tweezers")
        self._playing = Playing(program, t_start_s)

    def _play_ramp(self, ramp: DepthRamp, t_start_s: float) -> None:
        self._finish_program()
        self._hear(t_start_s)
        self._advance(max(t_start_s, self._now_s), "a ramp of the static tweezers")
        self._lost["light"] += self._static.ramp(ramp, self._occupied)
        self._now_s += ramp.duration_s

    def _finish_program(self, until_s: float = math.inf) -> None:
        """Carry out the program on its way, as far as it comes until a time."""
        if self._playing is None:
            return
        playing, self._playing = self._playing, None
        n_played = playing.n_segments_until(until_s + ROUNDING_S)
        factor = self._loss_factor * self._heating(playing.t_start_s, min(playing.t_end_s, until_s))
        depth, chance = self._static.depth, self._random.shot
        self._lost += self._transport.carry(self._occupied, playing.program, n_played, depth, chance, factor)
        self._let_pass(max(playing.t_start_s, min(playing.t_end_s, until_s)))

    def _hear(self, until_s: float) -> None:
        """Carry out what was heard from the outputs of mobile and static tweezers until a time."""
        for pulse in () if self._pulse_receiver is None else self._pulse_receiver.receive_until(until_s):
            if pulse.continued or pulse.start_s < self._now_s - ROUNDING_S:
                text = f"the mobile tweezers were on at {pulse.start_s:.6f} s, together with something else"
                raise DeviceError(self._name, f"{text}; wait (mobile_tweezers.wait, camera.read) first")
            self._let_pass(pulse.start_s)
            factor = self._loss_factor * self._heating(pulse.start_s, pulse.end_s)
            depth, chance = self._static.depth, self._random.shot
            self._lost += self._flight.carry(self._occupied, pulse, depth, chance, factor)
            self._let_pass(pulse.end_s)
        self._lost["light"] += self._static.receive_until(until_s, self._occupied)

    def _heating(self, start_s: float, end_s: float) -> float:
        """Factor on the transport loss, for the part of the time without cooling light."""
        lit = self._lights.fraction_on("cooling", start_s, end_s)
        return lit + (1.0 - lit) * self._settings.uncooled_transport

    def _advance(self, t_s: float, what: str) -> None:
        """Let time pass until an event."""
        self._check_open()
        self._hear(t_s)
        if self._playing is not None and t_s >= self._playing.t_end_s - ROUNDING_S:
            self._finish_program()
        busy_until_s = self._now_s if self._playing is None else self._playing.t_end_s
        if t_s < busy_until_s - ROUNDING_S:
            text = f"{what} at {t_s:.6f} s, but what came before it lasts until {busy_until_s:.6f} s; wait"
            raise DeviceError(self._name, f"{text} for its end (mobile_tweezers.wait, camera.read) first")
        self._let_pass(t_s)

    def _let_pass(self, t_s: float) -> None:
        """Let atoms be lost to the vacuum, at the rate of the lifetime."""
        elapsed_s = max(0.0, t_s - self._now_s)
        self._now_s = max(self._now_s, t_s)
        if not self._occupied.any():  # also before the first event, when the time since the last is infinite
            return
        stays = math.exp(-elapsed_s / self._settings.lifetime)
        gone = self._occupied & (self._random.shot.random(self._grid.shape) >= stays)
        self._lost["vacuum"] += int(np.count_nonzero(gone))
        self._occupied &= ~gone

    def _forget(self) -> None:
        self._occupied: Occupancy = np.zeros(self._grid.shape, np.bool_)
        self._playing: Playing | None = None
        self._now_s = -math.inf
        self._loss_factor = 1.0
        self._lost: Counter[str] = Counter()

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "the simulated world is not open; call open() first")
