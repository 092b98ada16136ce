"""The simulation of one run: atoms in static tweezers, and the effects of light, tweezers and the camera."""

from __future__ import annotations

import importlib
import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import (
    Context,
    DepthRamp,
    DeviceError,
    Frame,
    LimitError,
    LineProgram,
    Occupancy,
    RandomStream,
    SensorMode,
    Signal,
    Simulation,
    ToneProgram,
    TweezerAmplitudes,
    format_quantity,
)
from labseq.plugin.simulation import WHOLE_SENSOR, RfSource, ToneSource
from labseq_virtual.atoms import Atoms, Mask, table_of
from labseq_virtual.flight import Conditions, Flights, RunningProgram
from labseq_virtual.formulas import noise_hz, recoil_heat
from labseq_virtual.images import Exposure
from labseq_virtual.lights import Lights
from labseq_virtual.mobile_light import MobileLight, MobileTones, with_true_response
from labseq_virtual.records import FATES
from labseq_virtual.rf_analysis import MAX_SITES, PulseReceiver, sites_in_transit
from labseq_virtual.sensors import View
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.static_array import StaticArray
from labseq_virtual.tone_positions import TonePositions
from labseq_virtual.tweezer_view import TweezerView

if TYPE_CHECKING:
    from labseq_virtual.qubits import Qubits

MIN_LEVEL: Final = 1e-3
"""Depth, relative to the nominal one, that a static tweezer has at least in the model."""
NO_RISK: Final = 1e-4
"""Probability of evaporation below which evaporation is ignored."""
UNCOOLED: Final = 3.0
"""Transport loss without cooling light, relative to the loss with cooling light (ours)."""
ROUNDING_S: Final = 1e-6
"""Tolerance for events out of order, in seconds, because sums of times are rounded."""


class VirtualSimulation(Simulation):
    """Atoms in static tweezers, the effect of light on them, and the frames that a camera takes of them.

    Events arrive in order of time. A program of the mobile tweezers acts on the atoms when it has
    ended. Playing a program without segments stops it early, and atoms in flight are lost. A ramp of the
    static tweezers that comes during a program or an exposure acts at its end.

    Atoms fly in the light of the mobile tweezers (``flight.py``). Either a driver passes a program, whose
    tones are played exactly, or it connects its RF outputs, and the simulation finds the tones in the played
    samples. Likewise, static tweezers either pass their ramps, or connect outputs whose tones are measured.
    """

    def __init__(self, settings: SimulationSettings, context: Context) -> None:
        self._settings = settings
        self._name = context.name or "simulation"
        self._grid = context.grid
        self._random = context.random
        self._clock = context.clock
        self._positions = TonePositions(context.grid, settings.mobile_light)
        self._seed = context.random.seed if settings.machine_seed is None else settings.machine_seed
        motion = with_true_response(context.grid, context.motion, settings.mobile_light, self._seed)
        self._motion = motion
        self._flights = Flights(context.grid, motion, settings, self._positions)
        self._mobile_light = MobileLight(context.grid, motion, settings.mobile_light, self._positions)
        self._static = StaticArray(context.grid, settings)
        self._pulse_receiver: PulseReceiver | None = None
        self._noise_hz = noise_hz(settings)
        self._lights = Lights(settings.lights, context.lines, settings.qubit.required_lines)
        self._sources: dict[str, Mapping[str, float]] = {}
        self._exposure = Exposure(context.grid, settings, self._seed)
        self._is_open = False
        self._reset()

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """(height, width) of the sensor in pixels."""
        return self._settings.image.frame

    def readout_fraction(self, mode: SensorMode) -> float:
        """Time to read a frame, relative to the whole sensor without binning."""
        return View.of(self._settings.image, mode).readout_fraction

    def seen_by(self, camera: str) -> TweezerView:
        """The view of any camera other than the atoms' camera, which shows the light of the tweezers."""
        del camera
        settings, seed = self._settings.tweezer_image, self._seed
        return TweezerView(self, self._mobile_light, self._grid, settings, seed, self._random)

    def prepare_sensor(self, mode: SensorMode) -> None:
        """Compute the data shared by all frames of a mode, and load the kernels."""
        importlib.import_module("labseq_virtual.image_kernels")
        self._exposure.prepare(mode)

    def warnings(self) -> list[str]:
        """A warning about a speed at which the light of the mobile tweezers is not known."""
        transit_s = self._settings.mobile_light.transit_time
        sites = sites_in_transit(self._grid, self._motion, transit_s)
        if sites <= MAX_SITES:
            return []
        fastest = self._motion.speed_m_s * MAX_SITES / sites
        came, last = (format_quantity(each, "speed") for each in (self._motion.speed_m_s, fastest))
        what = f"profile.mobile_tweezers.speed is {came}; above {last} the sound's chirp blurs the tweezers"
        return [f"{what}, so more atoms are lost, but the number is not reliable"]

    @property
    def loading_probability(self) -> float:
        """Probability that a site holds an atom after a long loading."""
        return self._settings.loading

    def open(self) -> None:
        """Draw the machine's own disorder, without atoms and with the static tweezers off."""
        machine = RandomStream(self._seed).machine()
        self._static.draw(machine)
        self._positions.draw(machine)
        self._is_open = True
        self._reset()

    def warm(self) -> None:
        """Compile or load the kernels of tone finding and of transport."""
        for kernels in ("rf_kernels", "flight_kernels"):
            importlib.import_module(f"labseq_virtual.{kernels}")

    def close(self) -> None:
        """Remove the atoms and disconnect all outputs."""
        self._is_open = False
        self._static.switch_off()
        self._pulse_receiver = None
        self._lights.reset()
        self._reset()

    def begin_shot(self) -> None:
        """Remove all atoms and draw the shot's factor on the transport loss."""
        self._check_open()
        self._reset()
        if self._pulse_receiver is not None:
            for _ in self._pulse_receiver.receive_until(self._clock.now()):
                pass  # light before the shot has no atoms to act on
        self._flights.begin_shot()
        spread = self._settings.transport_loss_spread
        self._loss_factor = math.exp(spread * self._random.shot.standard_normal() - spread**2 / 2)

    def load(self, t_start_s: float, duration_s: float) -> None:
        """Load every site whose static tweezer is on.

        A site is reloaded with probability 1 - exp(-duration / loading_time), and then holds an atom
        with probability ``loading``. Otherwise it stays as it was.

        Raises:
            DeviceError: A later event has already been simulated.
        """
        self._begin_event(t_start_s, "loading")
        self._qubits = None
        on_s = duration_s * self._lights.fraction_on("loading", t_start_s, t_start_s + duration_s)
        reload_probability = -math.expm1(-on_s / self._settings.loading_time)
        draws = self._random.shot.random((2, *self._grid.shape))
        reloaded = (draws[0] < reload_probability) & self._static.holds()
        self._atoms.occupied[reloaded] = (draws[1] < self._settings.loading)[reloaded]
        self._now_s = t_start_s + duration_s
        self._atoms.heat[reloaded] = self._at_nominal(self._settings.temperature)[reloaded]
        self._atoms.since_s[...] = self._now_s

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        """Apply a device's output to the atoms, from ``t_start_s`` on.

        Raises:
            DeviceError: A later event has already been simulated, or the role does not play such a signal.
        """
        self._check_open()
        if role == "mobile_tweezers" and isinstance(signal, ToneProgram):
            self._play_tones(signal, t_start_s)
        elif role == "static_tweezers" and isinstance(signal, DepthRamp):
            self._play_ramp(signal, t_start_s)
        elif role == "static_tweezers" and isinstance(signal, TweezerAmplitudes):
            if signal.dark_s:
                self._release(t_start_s, signal.dark_s)
            self._static.drive(signal)
        elif role == "lines" and isinstance(signal, LineProgram):
            self._lights.switch(signal, t_start_s)
            self._play_pulses(signal, t_start_s)
            spans, stay_off = self._lights.tweezers_off(signal)
            for start_s, end_s in spans:
                self._release(t_start_s + start_s, end_s - start_s)
            self._lost["light"] += self._static.block(self._atoms, is_blocked=stay_off)
        else:
            text = f"'{role}' played a {type(signal).__name__}; expected 'mobile_tweezers' with a ToneProgram"
            text += ", 'static_tweezers' with a DepthRamp or TweezerAmplitudes, or 'lines' with a LineProgram"
            raise DeviceError(self._name, text)

    def wire(self, role: str, on_pulse: Callable[[float, float], object]) -> None:
        """Call ``on_pulse`` at every later pulse of the line that triggers a role."""
        self._lights.wire(role, on_pulse)

    def tune(self, device: str, values: Mapping[str, float]) -> None:
        """Set the output of a synthesizer, "frequency" in Hz, "phase" and "shift" in rad."""
        self._sources[device] = values

    def connect_outputs(self, role: str, source: RfSource | ToneSource) -> None:
        """Connect the outputs of a driver of tweezers, in place of earlier ones.

        Raises:
            DeviceError: The role is not mobile or static tweezers.
            LimitError: Tones of neighbouring sites could not be resolved.
        """
        self._check_open()
        if role == "static_tweezers":
            self._static.connect_outputs(cast("ToneSource", source))
            return
        if role != "mobile_tweezers":
            raise DeviceError(
                self._name,
                f"'{role}' cannot connect outputs; expected 'mobile_tweezers' or 'static_tweezers'",
            )
        self._flights.check_resolvable()
        self._apply_output(self._clock.now())
        self._pulse_receiver = PulseReceiver(
            cast("RfSource", source), 2 * self._flights.margin_s, self._flights.reach_hz
        )

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        """Take a frame. Imaging light heats some atoms out of their tweezers, and they shine until then.

        Raises:
            DeviceError: A later event has already been simulated.
            LimitError: The exposure is not longer than 0, or the sensor has no such mode.
        """
        if not exposure_s > 0:
            raise LimitError("the exposure", f"{exposure_s} s", "more than 0")
        self._begin_event(t_start_s, "an exposure")
        self._evaporate()
        light_on = self._lights.fraction_on("imaging", t_start_s, t_start_s + exposure_s)
        power, rng = self._static.depth, self._random.shot
        before = self._atoms.occupied.copy()
        image, lost = self._exposure.take(self._atoms.occupied, exposure_s, rng, mode, light_on, power)
        self._lost += lost
        if self._settings.record_truth:
            self._exposed.append((before, before & ~self._atoms.occupied))
        self._now_s = t_start_s + exposure_s
        self._qubits = None
        aim = self._at_nominal(self._settings.temperature + recoil_heat(self._settings))
        left = math.exp(-exposure_s * light_on / self._settings.cooling_time)
        self._atoms.heat = aim + (self._atoms.heat - aim) * left
        self._atoms.since_s[...] = self._now_s
        return Frame(image, exposure_s, t_start_s)

    def truth(self) -> Occupancy:
        """The true occupancy after the running program, bool (n_rows, n_cols)."""
        self._finish_program()
        self._apply_output(self._clock.now())
        return self._atoms.occupied.copy()

    def losses(self) -> Mapping[str, int]:
        """Atoms lost since the shot began, by cause."""
        return {
            cause: self._lost[cause]
            for cause in ("vacuum", "imaging", "light", "release", "push_out", "heat", *FATES[1:])
        }

    def spot_powers(self) -> NDArray[np.float64]:
        """Present power of each static tweezer relative to the nominal one, float64 (n_rows, n_cols)."""
        self._check_open()
        self._apply_output(self._clock.now())
        return self._static.depth

    def tweezer_light(self) -> tuple[NDArray[np.float64], MobileTones | None]:
        """Present power of each static tweezer, as ``spot_powers``, and the mobile tweezers' active tones.

        May be called while a program of the mobile tweezers is played.
        """
        self._check_open()
        now_s = self._clock.now()
        if self._playing is not None:
            playing = self._playing
            tones = self._mobile_light.of_program(playing.program, now_s - playing.t_start_s)
            return self._static.depth, tones
        if self._pulse_receiver is None:
            return self.spot_powers(), None
        rows, columns, is_on = self._pulse_receiver.look(now_s)
        if not is_on:
            return self.spot_powers(), None
        self._lost += self._static.receive_until(now_s, self._atoms, self._random.shot)
        return self._static.depth, self._mobile_light.of_outputs(rows, columns, now_s)

    def atom_events(self, since_s: float) -> Mapping[str, NDArray[Any]]:
        """The atoms of this shot, as far as they are recorded.

        Returns:
            "atoms" (:data:`labseq_virtual.atoms.ATOMS`) with ``record_truth``, and "flights"
            (:data:`labseq_virtual.flight.FLIGHTS`) and "jumps" (:data:`labseq_virtual.flight.JUMPS`) if the
            outputs of the mobile tweezers are connected.
        """
        tables = {"atoms": table_of(self._exposed)} if self._settings.record_truth else {}
        if self._pulse_receiver is None:
            return tables
        self._apply_output(self._clock.now())
        return tables | self._flights.tables(since_s)

    def describe(self) -> Mapping[str, Any]:
        """Every constant of the model, in SI, and the seed of its disorder."""
        return {"model": "labseq_virtual", "seed": self._seed, **self._settings.model_dump(mode="json")}

    def _play_tones(self, program: ToneProgram, t_start_s: float) -> None:
        self._finish_program(t_start_s)
        if program.n_segments == 0:  # silence, allowed at any time because it is the safe state
            return
        self._begin_event(t_start_s, "a program of the mobile tweezers")
        self._playing = RunningProgram(program, t_start_s)

    def _play_ramp(self, ramp: DepthRamp, t_start_s: float) -> None:
        self._finish_program()
        self._apply_output(t_start_s)
        self._begin_event(max(t_start_s, self._now_s), "a ramp of the static tweezers")
        self._lost["light"] += self._static.ramp(ramp, self._atoms, self._random.shot)
        self._now_s += ramp.duration_s

    def _play_pulses(self, program: LineProgram, t_start_s: float) -> None:
        """Apply the pulses of a program to the two levels of the atoms."""
        settings = self._settings.qubit
        if not any(program.rising(line) for line in settings.lines if line in program.lines):
            return
        self._begin_event(t_start_s, "pulses")
        from labseq_virtual.qubits import Qubits  # most runs have no pulses

        if self._qubits is None or self._was_cooled(self._qubits.t_s, t_start_s):
            self._qubits = Qubits(settings, self._grid.shape, t_start_s, self._random.shot)
        self._lost["push_out"] += self._qubits.play(program, t_start_s, self._drive(), self._atoms)

    def _was_cooled(self, start_s: float, end_s: float) -> bool:
        """Whether cooling light that lines switch was on, which prepares the atoms again."""
        return bool(self._settings.lights.cooling) and self._lights.fraction_on("cooling", start_s, end_s) > 0

    def _drive(self) -> Mapping[str, float]:
        """The drive of the atoms, from the output of the source, or on resonance without a source.

        Raises:
            DeviceError: The source is not a synthesizer of this profile.
        """
        settings = self._settings.qubit
        if settings.source in self._sources:
            return self._sources[settings.source]
        if settings.is_given("source"):
            text = (
                f"`qubit.source` is '{settings.source}', which is not a `virtual_synthesizer` of the profile"
            )
            raise DeviceError(self._name, text)
        return {"frequency": settings.transition, "phase": 0.0, "shift": math.pi / 2}

    def _release(self, t_start_s: float, dark_s: float) -> None:
        self._begin_event(t_start_s, "a release")
        self._lost["release"] += self._static.release(dark_s, self._atoms, self._random.shot)
        self._now_s = t_start_s + dark_s
        self._atoms.since_s[...] = self._now_s

    def _finish_program(self, until_s: float = math.inf) -> None:
        """Carry out the running program up to a time."""
        if self._playing is None:
            return
        playing, self._playing, self._qubits = self._playing, None, None
        conditions = self._conditions(playing.t_start_s, min(playing.t_end_s, until_s))
        depth, rng = self._static.depth, self._random.shot
        self._lost += self._flights.carry_program(self._atoms, playing, depth, rng, conditions, until_s)
        self._lose_to_vacuum(max(playing.t_start_s, min(playing.t_end_s, until_s)))

    def _apply_output(self, until_s: float) -> None:
        """Apply what the outputs of mobile and static tweezers played until a time."""
        for pulse in () if self._pulse_receiver is None else self._pulse_receiver.receive_until(until_s):
            if pulse.continued or pulse.start_s < self._now_s - ROUNDING_S:
                text = f"the mobile tweezers were on at {pulse.start_s:.6f} s, together with something else"
                raise DeviceError(self._name, f"{text}; wait (mobile_tweezers.wait, camera.read) first")
            self._lose_to_vacuum(pulse.start_s)
            self._qubits = None
            conditions = self._conditions(pulse.start_s, pulse.end_s)
            depth, rng = self._static.depth, self._random.shot
            if self._atoms.occupied.any():
                self._lost += self._flights.carry_pulse(self._atoms, pulse, depth, rng, conditions)
            self._lose_to_vacuum(pulse.end_s)
        self._lost += self._static.receive_until(until_s, self._atoms, self._random.shot)

    def _conditions(self, start_s: float, end_s: float) -> Conditions:
        """Cooling light between two times, and the factor on the transport loss, which rises without it."""
        cooled = self._lights.fraction_on("cooling", start_s, end_s)
        return Conditions(self._loss_factor * (cooled + (1.0 - cooled) * UNCOOLED), cooled)

    def _begin_event(self, t_s: float, what: str) -> None:
        """Simulate everything before an event. Refuse an event before the end of another."""
        self._check_open()
        self._apply_output(t_s)
        if self._playing is not None and t_s >= self._playing.t_end_s - ROUNDING_S:
            self._finish_program()
        busy_until_s = self._now_s if self._playing is None else self._playing.t_end_s
        if t_s < busy_until_s - ROUNDING_S:
            text = f"{what} at {t_s:.6f} s, but the event before it lasts until {busy_until_s:.6f} s; wait"
            raise DeviceError(self._name, f"{text} for its end (mobile_tweezers.wait, camera.read) first")
        self._lose_to_vacuum(t_s)

    def _lose_to_vacuum(self, t_s: float) -> None:
        """Advance the time to ``t_s``. Atoms are lost at the rate of the vacuum lifetime."""
        elapsed_s = max(0.0, t_s - self._now_s)
        self._now_s = max(self._now_s, t_s)
        if not self._atoms.occupied.any():  # includes the first event, before which elapsed_s is infinite
            return
        cooled = self._lights.fraction_on("cooling", self._now_s - elapsed_s, self._now_s)
        waited_s = np.maximum(0.0, self._now_s - self._atoms.since_s)
        self._atoms.heat = self._relaxed(self._atoms.heat, waited_s, cooled)
        self._atoms.since_s[...] = self._now_s
        stays = math.exp(-elapsed_s / self._settings.lifetime)
        self._lost["vacuum"] += self._atoms.lose(self._random.shot.random(self._grid.shape) >= stays)

    def _relaxed(self, heat: NDArray[np.float64], elapsed_s: NDArray[np.float64], cooled: float) -> Any:
        """Temperatures after times in the static tweezers, cooled or heated by intensity noise."""
        if cooled > 0:
            aim = self._at_nominal(self._settings.temperature)
            return aim + (heat - aim) * np.exp(-elapsed_s * cooled / self._settings.cooling_time)
        return heat * np.exp(np.minimum(elapsed_s * self._noise_hz, 20.0))

    def _at_nominal(self, temperature: float) -> NDArray[np.float64]:
        """Temperature that atoms at a temperature would have in tweezers ramped to the nominal depth."""
        return temperature / np.sqrt(np.maximum(self._static.depth, MIN_LEVEL))

    def _evaporate(self) -> None:
        """Remove atoms that noise has heated beyond the depth, with energies as in a harmonic well."""
        if self._noise_hz == 0:
            return
        depth = self._settings.static_depth * np.maximum(self._static.depth, MIN_LEVEL)
        x = np.minimum(np.sqrt(depth * self._settings.static_depth) / self._atoms.heat, 500.0)
        risk = np.exp(-x) * (1 + x + x**2 / 2) * self._atoms.occupied
        if risk.max() >= NO_RISK:
            self._lost["heat"] += self._atoms.lose(self._random.shot.random(self._grid.shape) < risk)

    def _reset(self) -> None:
        self._atoms = Atoms(np.zeros(self._grid.shape, np.bool_), self._settings.temperature)
        self._playing: RunningProgram | None = None
        self._qubits: Qubits | None = None
        self._now_s = -math.inf
        self._loss_factor = 1.0
        self._lost: Counter[str] = Counter()
        self._exposed: list[tuple[Mask, Mask]] = []

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "the simulation is not open; call open() first")
