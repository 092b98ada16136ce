"""Simulated worlds that break one promise each."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from labseq.errors import DeviceError, LimitError
from labseq.model import DepthRamp, Frame, Occupancy, SensorMode, ToneProgram
from labseq.roles import WHOLE_SENSOR, Context, Signal
from labseq.testing import SimulationContract

from .planted import Planted


class TinyWorld:
    """Right: atoms in tweezers that are on, a pixel per site."""

    def __init__(self, context: Context) -> None:
        self.random, self.shape = context.random, context.grid.shape
        self.is_open = self.is_lit = False
        self.atoms = np.zeros(self.shape, np.bool_)

    def open(self) -> None:
        self.is_open = True
        self.gain = self.random.machine().uniform(50.0, 60.0, self.shape)

    def close(self) -> None:
        self.is_open = False

    def begin_shot(self) -> None:
        self.atoms[...] = False

    def load(self, t_start_s: float, duration_s: float) -> None:
        self.atoms |= (self.random.shot.random(self.shape) < 0.6) & self.is_lit

    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        if role == "static_tweezers" and isinstance(signal, DepthRamp):
            self.is_lit = signal.end > 0
            self.atoms &= self.is_lit
        elif not (role == "mobile_tweezers" and isinstance(signal, ToneProgram)):
            raise DeviceError("simulation", f"'{role}' plays no {type(signal).__name__}")

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        if not exposure_s > 0:
            raise LimitError("the exposure", exposure_s, "more than 0")
        counts = self.random.shot.poisson(10 + self.gain * self.atoms)
        return Frame(counts.astype(np.uint16), exposure_s, t_start_s)

    def truth(self) -> Occupancy:
        return self.atoms.copy()

    def describe(self) -> Mapping[str, Any]:
        return {"model": "tiny"}


class ReadsAFile(TinyWorld):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        Path(os.devnull).read_bytes()


class ClosesOnlyWhatIsOpen(TinyWorld):
    def close(self) -> None:
        super().close()
        del self.gain


class TellsMilliseconds(TinyWorld):
    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        return replace(frame, exposure_s=1e3 * exposure_s)


class SharesItsImage(TinyWorld):
    def open(self) -> None:
        super().open()
        self.image = np.zeros(self.shape, np.uint16)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        self.image[...] = frame.image
        view = self.image[:]
        view.flags.writeable = False
        return replace(frame, image=view)


class DrawsItsOwnDisorder(TinyWorld):
    def open(self) -> None:
        super().open()
        self.gain = np.random.default_rng().uniform(50.0, 60.0, self.shape)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        return replace(frame, image=np.rint(100 * self.gain).astype(np.uint16))


class HearsNoSeed(TinyWorld):
    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        return replace(frame, image=np.full_like(frame.image, 7))


class DrawsFromOneStream(TinyWorld):
    def open(self) -> None:
        super().open()
        self.stream = np.random.default_rng(self.random.seed)

    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        frame = super().expose(t_start_s, exposure_s, mode)
        return replace(frame, image=frame.image + self.stream.integers(0, 9, self.shape, np.uint16))


class LoadsInTheDark(TinyWorld):
    def load(self, t_start_s: float, duration_s: float) -> None:
        is_lit, self.is_lit = self.is_lit, True
        super().load(t_start_s, duration_s)
        self.is_lit = is_lit


class LoadsNothing(TinyWorld):
    def load(self, t_start_s: float, duration_s: float) -> None:
        pass


class KeepsAtoms(TinyWorld):
    """Loading fills every site again, so that frames show nothing of it."""

    def begin_shot(self) -> None:
        pass

    def load(self, t_start_s: float, duration_s: float) -> None:
        super().begin_shot()
        super().load(t_start_s, duration_s)


class ExposesBackwards(TinyWorld):
    def expose(self, t_start_s: float, exposure_s: float, mode: SensorMode = WHOLE_SENSOR) -> Frame:
        if exposure_s > 0:
            return super().expose(t_start_s, exposure_s, mode)
        return Frame(np.zeros(self.shape, np.uint16), 0.0, t_start_s)


class PlaysAnything(TinyWorld):
    def play(self, role: str, signal: Signal, t_start_s: float) -> None:
        if role == "static_tweezers" and isinstance(signal, DepthRamp):
            super().play(role, signal, t_start_s)


class DescribesInNumpy(TinyWorld):
    def describe(self) -> Mapping[str, Any]:
        return {"gain": self.gain}


class DrawsGlobally(TinyWorld):
    def begin_shot(self) -> None:
        super().begin_shot()
        np.random.random()  # noqa: NPY002 - the fault


PLANTED = Planted(
    SimulationContract(),
    TinyWorld,
    (
        (ReadsAFile, "test_constructor_does_no_io"),
        (ClosesOnlyWhatIsOpen, "test_opens_and_closes_twice"),
        (TellsMilliseconds, "test_gives_frames"),
        (SharesItsImage, "test_gives_frames"),
        (DrawsItsOwnDisorder, "test_same_seed_same_frames"),
        (HearsNoSeed, "test_same_seed_same_frames"),
        (DrawsFromOneStream, "test_shots_are_independent"),
        (LoadsInTheDark, "test_loads_atoms"),
        (LoadsNothing, "test_loads_atoms"),
        (KeepsAtoms, "test_loads_atoms"),
        (ExposesBackwards, "test_refuses_impossible_exposures"),
        (PlaysAnything, "test_refuses_wrong_signals"),
        (DescribesInNumpy, "test_describes_itself"),
        (DrawsGlobally, "test_is_pure"),
    ),
)
