"""Virtual mobile and static tweezers, and the base class of virtual drivers."""

from __future__ import annotations

import importlib
import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from labseq.plugin import (
    AxisTones,
    ConfigError,
    Context,
    DepthRamp,
    DeviceError,
    DeviceTimeoutError,
    Hardware,
    LimitError,
    MobileTweezers,
    Simulation,
    StaticTweezers,
    ToneProgram,
    TweezerAmplitudes,
    TweezersFacts,
    format_quantity,
)
from labseq.plugin.lines import trigger_line
from labseq.plugin.motion import check_tone_program
from labseq.plugin.tweezers import Amplitudes, calibrated_amplitudes, check_amplitudes, check_ramp
from labseq_virtual.settings import MobileTweezersSettings, StaticTweezersSettings


class VirtualDriver(Hardware):
    """Base of the virtual drivers that act on the simulation.

    Args:
        context: Name, clock, random numbers and the simulation.
        role: Name to use if the context has none.

    Raises:
        ConfigError: There is no simulation.
    """

    any_thread = True

    def __init__(self, context: Context, role: str) -> None:
        self._name = context.name or role
        self._clock = context.clock
        self._random = context.random
        self._simulation = require_simulation(context)
        self._is_open = False

    def open(self) -> None:
        """Connect to the simulation."""
        self._is_open = True

    def close(self) -> None:
        """Make the output harmless and disconnect. Legal in any state."""
        self.safe_state()
        self._is_open = False

    @abstractmethod
    def safe_state(self) -> None:
        """Make the output harmless. Legal in any state."""

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceError(self._name, "not open; call open() first")


def require_simulation(context: Context) -> Simulation:
    """The simulation on which virtual hardware acts.

    Raises:
        ConfigError: The profile has none.
    """
    if context.simulation is None:
        raise ConfigError(
            "virtual hardware needs a simulation; add `simulation: {use: virtual}` to the profile"
        )
    return context.simulation


_NOTHING: Final = np.empty(0)
_NO_TONES: Final = AxisTones(np.zeros(1, np.int32), _NOTHING, _NOTHING, _NOTHING, _NOTHING, _NOTHING)
SILENCE: Final = ToneProgram(_NO_TONES, _NO_TONES, _NOTHING, np.empty(0, np.int8), np.empty(0, np.int32))
"""The program without segments, with all tones off."""
FULL_SCALE: Final = 1.0
"""Greatest sum of the amplitudes of an axis, above which the output clips."""
MAX_DEPTH: Final = 1.5
"""Greatest depth of the static tweezers, as a fraction of the nominal one (ours)."""
ROUNDING: Final = 1e-9
"""Excess of a sum of amplitudes over its limit that counts as rounding."""


class VirtualMobileTweezers(VirtualDriver, MobileTweezers):
    """Ideal mobile tweezers, in which the atoms feel exactly the tones of the program.

    A program is refused before it plays if it leaves the AOD's band or would clip.
    Each ``play`` needs its own ``prepare``, so no program is replayed by mistake.
    ``safe_state`` stops a program early, so that atoms in flight are lost.
    """

    def __init__(self, settings: MobileTweezersSettings, context: Context) -> None:
        super().__init__(context, "mobile_tweezers")
        self._settings = settings
        self._grid = context.grid
        self._prepared: ToneProgram | None = None
        self._armed: ToneProgram | None = None
        self._playing_until_s: float | None = None
        self._is_wired = trigger_line(context.lines, "mobile_tweezers") is not None

    @property
    def waits_for_trigger(self) -> bool:
        """Whether a line triggers the tweezers."""
        return self._is_wired

    def open(self) -> None:
        """Connect to the simulation, and to the line that triggers the tweezers."""
        super().open()
        if self._is_wired:
            self._simulation.wire("mobile_tweezers", lambda t_s, _width_s: self._start(t_s))

    def warm(self) -> None:
        """Compile or load the kernels of transport."""
        importlib.import_module("labseq_virtual.flight_kernels")

    def prepare(self, program: ToneProgram) -> float:
        """Check a program and keep it for the next ``play``.

        Returns:
            Playing time in seconds.

        Raises:
            LimitError: The program has no length, leaves the AOD's band, or clips.
            DeviceError: Not open, or still playing.
        """
        self._check_open()
        self._check_idle("prepare()")
        self._prepared = None
        self.check_program(program)
        self._prepared = program
        return program.total_duration_s

    def check_program(self, program: ToneProgram) -> None:
        """Refuse a program that has no length, leaves the AOD's band, or clips.

        Raises:
            LimitError: The program has no length, leaves the AOD's band, or clips.
        """
        band_hz = self._band_hz
        check_tone_program(self._name, program, band_hz, band_hz, FULL_SCALE)

    def play(self) -> None:
        """Start playing the prepared program, and return at once.

        Raises:
            DeviceError: No program was prepared since the last ``play``, or one is still playing.
        """
        self._check_open()
        self._check_idle("play()")
        if self._prepared is None:
            raise DeviceError(
                self._name, "play() without a prepared program; call prepare() before each play()"
            )
        self._armed, self._prepared, self._playing_until_s = self._prepared, None, math.inf
        if not self._is_wired:
            self._start(self._clock.now())

    def _start(self, t_s: float) -> None:
        """Start the armed program. Without a program the edge has no effect."""
        program, self._armed = self._armed, None
        if program is not None:
            self._simulation.play("mobile_tweezers", program, t_s)
            self._playing_until_s = t_s + program.total_duration_s

    def wait(self, timeout_s: float) -> None:
        """Wait for the end of the program. Returns at once if none is playing.

        Raises:
            DeviceTimeoutError: It did not end within ``timeout_s``.
        """
        self._check_open()
        if self._playing_until_s is None:
            return
        left_s = max(0.0, self._playing_until_s - self._clock.now())
        self._clock.sleep(min(left_s, timeout_s))
        if left_s > timeout_s:
            waited, left = format_quantity(timeout_s, "time"), format_quantity(left_s, "time")
            text = f"still playing after {waited}, but the program needed {left}"
            if self._armed is not None:
                text = f"no trigger came within {waited}"
            raise DeviceTimeoutError(self._name, text, timeout_s)
        self._playing_until_s = None

    def safe_state(self) -> None:
        """Turn all tones off at once, and drop the prepared program."""
        self._prepared = self._armed = None
        if self._playing_until_s is not None:
            self._playing_until_s = None
            self._simulation.play("mobile_tweezers", SILENCE, self._clock.now())

    def self_test(self) -> None:
        """Check that the tones of all sites are in the AOD's band, without playing.

        Raises:
            DeviceError: Not open, or a site is out of reach.
        """
        self._check_open()
        low, high = self._band_hz
        tones = (("row", self._grid.row_frequency_hz), ("column", self._grid.column_frequency_hz))
        for axis, hz in tones:
            for line in np.flatnonzero(~((hz >= low) & (hz <= high))).tolist():
                text = (
                    f"{axis} {line} is out of reach: its tone of {hz[line] / 1e6:.6g} MHz is not in the band"
                )
                raise DeviceError(self._name, f"{text} of {low / 1e6:.6g} to {high / 1e6:.6g} MHz")

    def describe(self) -> Mapping[str, Any]:
        """Model and settings."""
        return {"model": "virtual mobile tweezers", **self._settings.model_dump(mode="json")}

    @property
    def _band_hz(self) -> tuple[float, float]:
        centre, reach = self._settings.band_centre, self._settings.band_half_width
        return centre - reach, centre + reach

    def _check_idle(self, call: str) -> None:
        if self._playing_until_s is not None and self._clock.now() < self._playing_until_s - 1e-9:
            raise DeviceError(
                self._name,
                f"{call} while a program plays until {self._playing_until_s:.6f} s; call wait() first",
            )


class VirtualStaticTweezers(VirtualDriver, StaticTweezers):
    """The static array of the simulation.

    Depths in the simulation follow the amplitudes of the tones, ``start`` and ``ramp``.
    """

    def __init__(self, settings: StaticTweezersSettings, context: Context) -> None:
        super().__init__(context, "static_tweezers")
        self._settings = settings
        self._grid = context.grid
        self._amplitudes: Amplitudes | None = None
        self._calibrated = calibrated_amplitudes(context)
        self._depth = 0.0

    @property
    def facts(self) -> TweezersFacts:
        """Facts of tweezers that release the atoms for exactly the requested time."""
        return TweezersFacts(shortest_release_s=0.0)

    def load(self, amplitudes: Amplitudes | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,). None takes calibrated ones.

        Raises:
            LimitError: Wrong number of tones, or amplitudes negative, not finite or too large in sum.
        """
        self._check_open()
        if amplitudes is not None:
            self._check(amplitudes)
        self._amplitudes = amplitudes
        rows, cols = self._calibrated if amplitudes is None else amplitudes
        self._simulation.play("static_tweezers", TweezerAmplitudes(rows, cols), self._clock.now())

    def start(self) -> None:
        """Ramp the array to its nominal depth. No effect if it is there."""
        self._check_open()
        if self._depth == 0.0:
            self.load(self._amplitudes)
        if self._depth != 1.0:
            self._play(1.0, 0.0)

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly. Returns when the ramp has ended.

        Raises:
            LimitError: A depth or duration that the array cannot have.
        """
        self._check_open()
        check_ramp(self._name, depth, duration_s, MAX_DEPTH)
        self._play(depth, duration_s)
        self._clock.sleep(duration_s)

    def release(self, duration_s: float) -> float:
        """Turn the light off for exactly this time, then on again. Returns when the light is on.

        Raises:
            LimitError: The duration is not positive, or not finite.
        """
        self._check_open()
        if not 0 < duration_s < float("inf"):
            raise LimitError(f"{self._name}: duration of the release", f"{duration_s:g} s", "more than 0")
        rows, cols = self._calibrated if self._amplitudes is None else self._amplitudes
        dark = TweezerAmplitudes(rows, cols, duration_s)
        self._simulation.play("static_tweezers", dark, self._clock.now())
        self._clock.sleep(duration_s)
        return duration_s

    def safe_state(self) -> None:
        """Turn the array off at once."""
        if self._depth > 0.0:
            self._play(0.0, 0.0)

    def self_test(self) -> None:
        """Check the calibrated amplitudes against the limits, without switching light on.

        Raises:
            DeviceError: Not open, or the amplitudes exceed a limit.
        """
        self._check_open()
        try:
            self._check(self._calibrated)
        except LimitError as error:
            raise DeviceError(self._name, f"the calibrated amplitudes exceed a limit: {error}") from error

    def describe(self) -> Mapping[str, Any]:
        """Model, settings, depth and current amplitudes."""
        tones = self._amplitudes
        amplitudes = (
            "calibrated" if tones is None else {"row": tones[0].tolist(), "column": tones[1].tolist()}
        )
        return {
            "model": "virtual static tweezers",
            "depth": self._depth,
            "amplitudes": amplitudes,
            **self._settings.model_dump(mode="json"),
        }

    def _play(self, depth: float, duration_s: float) -> None:
        start, self._depth = self._depth, depth
        self._simulation.play("static_tweezers", DepthRamp(start, depth, duration_s), self._clock.now())

    def _check(self, amplitudes: Amplitudes) -> None:
        check_amplitudes(self._name, amplitudes, self._grid.shape)
        for axis, values in zip(("row", "column"), amplitudes, strict=True):
            total = float(values.sum())
            if total > FULL_SCALE + ROUNDING:
                raise LimitError(
                    f"{self._name}: sum of the {axis} amplitudes", f"{total:g}", f"{FULL_SCALE:g}"
                )
