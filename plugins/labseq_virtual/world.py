"""The simulated world: one seeded array of atoms that all virtual hardware acts on."""

from __future__ import annotations

import importlib
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    WHOLE_SENSOR,
    Context,
    DepthRamp,
    DeviceError,
    Frame,
    LimitError,
    LineProgram,
    Occupancy,
    RandomStream,
    RfSource,
    SensorMode,
    Signal,
    ToneProgram,
    ToneSource,
    TweezerAmplitudes,
)
from labseq_virtual.exposure import Exposure, SensorMixin
from labseq_virtual.flight import RfTransport
from labseq_virtual.hearing import PulseReceiver
from labseq_virtual.lights import Lights
from labseq_virtual.places import Places
from labseq_virtual.settings import WorldSettings
from labseq_virtual.static_array import StaticArray
from labseq_virtual.transport import CAUSES, Playing, Transport

ROUNDING_S: Final = 1e-6
"""How far into the past an event may lie because sums of times were rounded."""


class World(SensorMixin):
    """Atoms in static tweezers, what light does to them, and what a camera sees of it.

    Implements ``labseq.Simulation``, ``labseq.ReportsSensor``, ``labseq.ReportsTruth``, ``labseq.ReportsLosses``,
    ``labseq.ReceivesOutput`` and ``labseq.ReportsEvents``. Events come in the order of time. A program of the mobile
    tweezers is carried out when it has ended, or as far as it came when another program takes
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
        for kernels in ("tones", "atoms", "transport"):
            importlib.import_module(f"labseq_virtual._kernels_{kernels}")

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
            (:data:`labseq_virtual.jumps.JUMPS`); nothing if it listens to nobody.
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
