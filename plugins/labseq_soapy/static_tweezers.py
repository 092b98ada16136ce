"""Static tweezers on a software-defined radio."""

from __future__ import annotations

import math
import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from labseq.plugin import (
    Context,
    DeviceError,
    LimitError,
    StaticTweezers,
    TransientError,
)
from labseq_soapy.alone import end_stale_process, marker_of, place
from labseq_soapy.array_tones import Amplitudes, ArrayTones
from labseq_soapy.capture import built
from labseq_soapy.library import SoapyError
from labseq_soapy.link import Link
from labseq_soapy.messages import Setup
from labseq_soapy.radio import Facts
from labseq_soapy.settings import SoapySettings
from labseq_soapy.simulated import SimulatedRadio


class SoapyStaticTweezers(StaticTweezers):
    """Plays a loop of tones for each AOD on two outputs of a radio.

    A process of its own keeps the radio supplied. It ramps the light down if labseq is killed or hangs,
    unless the profile says otherwise. The depth of a tweezer is taken to go as the product of the powers of
    its two tones, so that both amplitudes go as its fourth root.

    Args:
        settings: The radio, and how it is used.
        context: Name, grid, clock, calibrated amplitudes.

    Attributes:
        simulated_radio: The simulated radio, while it is open; None for a real one.

    Raises:
        LimitError: The tones span more than 80 % of the sample rate, or no loop holds them all.
    """

    def __init__(self, settings: SoapySettings, context: Context) -> None:
        self._name = context.name or "static_tweezers"
        self._settings = settings
        self._clock = context.clock
        self._world = context.simulation
        self._tones = ArrayTones(self._name, settings, context.grid.shape)
        self._calibrated = _calibrated(context)
        self._amplitudes: Amplitudes | None = None
        self._depth: float | None = 0.0  # None: a ramp was broken off
        self._dark = 0
        self._link: Link | None = None
        self._facts: Facts | None = None
        self._is_loaded = False
        self.simulated_radio: SimulatedRadio | None = None

    def warm(self) -> None:
        """Compile the simulated radio, if that is what there is.

        Raises:
            DeviceError: It cannot be compiled.
        """
        if self._settings.is_simulated:
            with self._in_words():
                built()

    def open(self) -> None:
        """Open the radio and let it play silence; no effect if it is open.

        Raises:
            DeviceError: No library, no such radio, another program has it, or it refuses a setting.
            LimitError: The calibrated amplitudes are too much.
        """
        if self._link is not None:
            return
        try:
            self._link = self._connect()
            self._facts = self._link.facts()
            self._tones.tune(self._facts)
            if self.simulated_radio is not None:
                self.simulated_radio.connect_outputs(self._tones.tones_hz)
        except BaseException:
            self._disconnect()
            raise

    def close(self) -> None:
        """Ramp down and let the radio go; legal in any state."""
        self._disconnect()

    def load(self, amplitudes: Amplitudes | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,); None: as calibrated.

        While the array is on they are faded in.

        Raises:
            LimitError: Wrong number of tones, negative or not finite, or too much together.
            TransientError: The radio ran out of samples while the array was on.
            DeviceError: Not open, or the stream is dead.
        """
        self._checked()
        self._load(amplitudes)

    def start(self) -> None:
        """Ramp the array to its nominal depth; no effect if it is there.

        Raises:
            TransientError: The radio ran out of samples while the array was on.
            DeviceError: Not open, or the stream is dead.
        """
        self._checked()
        if not self._is_loaded:
            self._load(self._amplitudes)
        if self._depth != 1.0:
            self._ramp(1.0, self._settings.switch)

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly; returns when the ramp has ended at the connectors.

        Raises:
            LimitError: A depth or duration that the array cannot have.
            TransientError: The radio ran out of samples while the array was on.
            DeviceError: Not open, or the stream is dead.
        """
        self._checked()
        deepest = self._settings.max_depth
        if not 0 <= depth <= deepest:
            raise LimitError(
                f"{self._name}: depth", f"{depth:g} of the nominal depth", f"0 to {deepest:g} of it"
            )
        if not 0 <= duration_s < math.inf:
            raise LimitError(f"{self._name}: duration of the ramp", f"{duration_s:g} s", "0 or more")
        if not self._is_loaded:
            self._load(self._amplitudes)
        self._ramp(depth, duration_s)

    def safe_state(self) -> None:
        """Ramp the array down; a stream that is dead is dark already.

        Raises:
            DeviceError: The process hangs; it was killed, which ends the light too.
        """
        link = self._link
        if link is None or self._depth == 0.0:
            return
        try:
            self._ramp(0.0, self._settings.switch)
        except DeviceError:
            if link.hangs:
                self._disconnect()
                raise
            self._depth = 0.0

    def check_interlocks(self) -> None:
        """See whether the stream lives; asked at the start of each shot and before each pick-up.

        Raises:
            TransientError: The radio ran out of samples since the last call, while the array was on.
            DeviceError: Not open, or the stream is dead.
        """
        self._checked()

    def self_test(self) -> None:
        """See whether the stream runs and takes the calibrated amplitudes; no light goes on.

        Raises:
            DeviceError: Not open, or something is wrong.
        """
        self._checked()
        try:
            self._tones.samples(self._calibrated)
        except LimitError as error:
            raise DeviceError(self._name, f"it cannot have the calibrated amplitudes: {error}") from error

    def describe(self) -> Mapping[str, Any]:
        """Settings, depth, amplitudes; once opened, also the radio, the loop and underflows."""
        given = self._amplitudes
        amplitudes = (
            "calibrated" if given is None else {"row": given[0].tolist(), "column": given[1].tolist()}
        )
        told = {**self._settings.model_dump(mode="json"), "local_oscillator": self._tones.oscillator_hz}
        common = {"model": "SoapySDR", **told, "depth": self._depth, "amplitudes": amplitudes}
        if self._facts is None or self._link is None:
            return common
        return {
            **common,
            **self._facts.as_message(),
            "model": f"SoapySDR {self._facts.radio['hardware']}",
            "serial_number": self._facts.radio.get("serial", ""),
            "loop_samples": self._tones.loops[0].n_samples,
            "crest_factor": list(self._tones.crest_factor),
            "underflows": self._link.underflows,
        }

    def _connect(self) -> Link:
        setup, device, environment, folder = self._settings, self._settings.device, dict(os.environ), place()
        if setup.is_simulated:
            with self._in_words():
                self.simulated_radio = radio = SimulatedRadio(setup, self._world)
            device, environment, folder = radio.device, radio.environment, radio.folder
        marker = marker_of(setup.device)  # a simulated radio's own folder is another each time
        end_stale_process(self._name, marker, self._clock)
        told = Setup(
            device=device,
            stream=setup.stream,
            channels=(setup.row_channel, setup.column_channel),
            rate_hz=setup.sample_rate,
            oscillator_hz=self._tones.oscillator_hz,
            bandwidth_hz=setup.bandwidth,
            gain_db=(setup.row_gain, setup.column_gain),
            antenna=setup.antenna,
            clock_source=setup.clock_source,
            ramp_s=setup.switch,
            max_wait_s=setup.patience,
            hold=setup.on_exit == "hold",
            marker=str(marker),
        )
        log = Path(folder) / f"{marker.stem}.log"
        return Link(self._name, self._clock, told, log, environment)

    @contextmanager
    def _in_words(self) -> Generator[None]:
        """What a simulated radio lacks is the device's failure."""
        try:
            yield
        except SoapyError as error:
            raise DeviceError(self._name, str(error)) from error

    def _load(self, amplitudes: Amplitudes | None) -> None:
        loop = self._tones.samples(self._calibrated if amplitudes is None else amplitudes)
        self._amplitudes, self._is_loaded = amplitudes, True
        self._opened().load(loop, self._settings.fade)
        if self._depth != 0.0 and self._clock.virtual:
            self._clock.sleep(self._settings.fade)
        self._look()

    def _ramp(self, depth: float, duration_s: float) -> None:
        link, self._depth = self._opened(), None
        link.ramp(depth, duration_s)
        self._depth = depth
        if self._clock.virtual:
            self._clock.sleep(duration_s)
        self._look()

    def _look(self) -> None:
        if self.simulated_radio is not None:
            self.simulated_radio.look()

    def _opened(self) -> Link:
        if self._link is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._link

    def _checked(self) -> Link:
        """The link, if its stream lives and has not failed since the last call."""
        link = self._opened()
        link.check()
        dark, self._dark = link.dark - self._dark, link.dark
        if dark:
            text = f"the radio ran out of samples {dark} time(s) while the array was on: atoms may be lost"
            raise TransientError(text, self._name)
        return link

    def _disconnect(self) -> None:
        link, self._link, self._facts = self._link, None, None
        self._depth, self._dark, self._is_loaded, self._amplitudes = 0.0, 0, False, None
        if link is not None:
            link.close()
        if self.simulated_radio is not None:
            self.simulated_radio.close()
            self.simulated_radio = None


def _calibrated(context: Context) -> Amplitudes:
    """The amplitudes of the calibration in use; without one all equal, full scale together."""
    found = context.calibrations.get("tweezers")
    if found is None:
        n_rows, n_cols = context.grid.shape
        return np.full(n_rows, 1 / n_rows), np.full(n_cols, 1 / n_cols)
    return found.values["row_amplitudes"], found.values["column_amplitudes"]
