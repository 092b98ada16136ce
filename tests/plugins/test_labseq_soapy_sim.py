"""The amplitudes that the simulated radio plays, as the simulation receives them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import cast

import numpy as np
import pytest
from labseq_soapy_sim import Fault
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq.plugin import Context, DeviceError, RandomStream, TransientError, TweezerAmplitudes
from labseq.roles import RfSource, ToneSource
from labseq.testing.fakes import FakeClock, RecordingSimulation

from .labseq_soapy_rig import GRID, Rig, opened, until

ROWS, COLUMNS = np.array([0.1, 0.2, 0.15]), np.array([0.1, 0.05, 0.2, 0.1])


class ReceivingSimulation(RecordingSimulation):
    """Keeps the outputs that are connected to it."""

    def __init__(self) -> None:
        super().__init__()
        self.source: ToneSource | None = None

    def warm(self) -> None:
        pass

    def connect_outputs(self, role: str, source: RfSource | ToneSource) -> None:
        assert role == "static_tweezers"
        self.source = cast("ToneSource", source)

    def changes(self) -> list[TweezerAmplitudes]:
        assert self.source is not None
        return list(self.source.played(0.0))


def depths(found: list[TweezerAmplitudes]) -> list[float]:
    """Depth of the first tweezer over that with the amplitudes of ROWS and COLUMNS."""
    nominal = (ROWS[0] * COLUMNS[0]) ** 2
    return [float((one.row[0] * one.column[0]) ** 2 / nominal) for one in found]


def test_each_change_of_the_amplitudes_is_reported_once() -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        assert simulation.changes() == []
        rig.tweezers.load((ROWS, COLUMNS))
        assert simulation.changes() == []
        rig.tweezers.start()
        (found,) = simulation.changes()
        assert found.row == pytest.approx(ROWS, abs=1e-6)
        assert found.column == pytest.approx(COLUMNS, abs=1e-6)
        assert simulation.changes() == []
        rig.tweezers.load((ROWS / 2, COLUMNS))
        assert simulation.changes()[0].row == pytest.approx(ROWS / 2, abs=1e-6)


def test_a_dip_that_was_over_before_the_simulation_asks_is_reported() -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        rig.tweezers.load((ROWS, COLUMNS))
        rig.tweezers.start()
        rig.tweezers.ramp(0.25, 0.001)
        rig.tweezers.ramp(1.0, 0.001)
        assert depths(simulation.changes()) == pytest.approx([1.0, 0.25, 1.0], abs=1e-4)


def test_equal_runs_are_equal_to_the_last_digit() -> None:
    found: list[list[tuple[bytes, bytes]]] = []
    for _ in range(2):
        simulation = ReceivingSimulation()
        with opened(simulation=simulation) as rig:
            rig.tweezers.start()
            for depth in (0.3, 0.7, 1.0):
                rig.tweezers.ramp(depth, 0.001)
            found.append([(one.row.tobytes(), one.column.tobytes()) for one in simulation.changes()])
    assert found[0] == found[1]
    assert len(found[0]) == 4


def kill(rig: Rig) -> None:
    os.kill(int(rig.tweezers._link.pid), signal.SIGKILL)  # pyright: ignore[reportOptionalMemberAccess]
    until(lambda: not rig.ring.is_playing)


def tune_away(rig: Rig) -> None:
    rig.ring["frequency_hz"][0] += 20e3


@pytest.mark.parametrize(
    "fail",
    [
        kill,
        lambda rig: rig.ring.set_fault(Fault.MUTE_0),
        lambda rig: rig.ring.set_fault(Fault.MUTE_1),
        tune_away,
    ],
    ids=["the process is killed", "rows mute", "columns mute", "oscillator off"],
)
def test_a_radio_that_fails_makes_no_tweezers(fail: Callable[[Rig], None]) -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        rig.tweezers.start()
        assert depths(simulation.changes())[0] > 0.0
        fail(rig)

        def is_dark() -> bool:
            found = simulation.changes()
            return bool(found) and (found[-1].row.max() < 0.01 or found[-1].column.max() < 0.01)

        until(is_dark)


def test_an_underflow_is_a_dark_moment_and_then_light_again() -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        rig.tweezers.start()
        before = simulation.changes()[-1]
        rig.ring.set_fault(Fault.UNDERFLOW)
        until(lambda: int(rig.ring["underflows"]) == 1)
        dark, light = simulation.changes()
        assert not dark.row.any()
        assert np.array_equal(light.row, before.row)


def test_a_ramp_on_a_dead_stream_is_no_light() -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        kill(rig)
        with pytest.raises(DeviceError):
            rig.tweezers.start()
        assert simulation.changes() == []


class Lab:
    """Atoms in tweezers made by a simulated radio; nothing but the light loses them."""

    def __init__(self, **physics: float) -> None:
        self.clock = FakeClock()
        settings = {"loading": 1.0, "lifetime": 2e6, "imaging_loss": 0.0, **physics}
        context = Context("simulation", GRID, clock=self.clock, random=RandomStream(0))
        self.world = VirtualSimulation(SimulationSettings.model_validate(settings), context)
        self.world.open()
        self.world.begin_shot()

    def load(self, rig: Rig) -> None:
        rig.tweezers.start()
        self.world.load(self.clock.now(), 0.5)
        self.clock.sleep(0.5)

    @property
    def n_atoms(self) -> int:
        return int(np.count_nonzero(self.world.truth()))


class TestAtoms:
    def test_are_loaded_only_where_the_radio_makes_tweezers(self) -> None:
        lab = Lab()
        with opened(simulation=lab.world, clock=lab.clock) as rig:
            rig.tweezers.load((np.array([1.0, 0.0, 1.0]) / 3, np.full(4, 1 / 4)))
            lab.load(rig)
            assert lab.world.truth().any(axis=1).tolist() == [True, False, True]

    def test_stay_in_a_ramp_that_holds_them_and_are_lost_in_one_that_does_not(self) -> None:
        lab = Lab()
        with opened(simulation=lab.world, clock=lab.clock) as rig:
            lab.load(rig)
            rig.tweezers.ramp(0.5, 0.001)
            assert lab.n_atoms == GRID.n_rows * GRID.n_cols
            assert lab.world.spot_powers().mean() == pytest.approx(0.5, rel=0.05)
            rig.tweezers.ramp(0.0, 0.001)
            rig.tweezers.ramp(1.0, 0.001)
            assert lab.n_atoms == 0
            assert lab.world.losses()["light"] == 12

    def test_are_lost_when_the_streaming_process_is_killed(self) -> None:
        lab = Lab()
        with opened(simulation=lab.world, clock=lab.clock) as rig:
            lab.load(rig)
            kill(rig)
            assert lab.n_atoms == 0

    def test_are_lost_in_an_underflow_which_asks_for_the_shot_again(self) -> None:
        lab = Lab()
        with opened(simulation=lab.world, clock=lab.clock) as rig:
            lab.load(rig)
            rig.ring.set_fault(Fault.UNDERFLOW)
            until(lambda: rig.described("underflows") == 1)
            assert lab.n_atoms == 0
            with pytest.raises(TransientError):
                rig.tweezers.start()
            lab.world.begin_shot()
            lab.load(rig)
            assert lab.n_atoms == 12

    def test_are_the_same_in_equal_runs(self) -> None:
        runs: list[bytes] = []
        for _ in range(2):
            lab = Lab(loading=0.6, depth_disorder=0.3, lifetime=1.0)
            with opened(simulation=lab.world, clock=lab.clock) as rig:
                lab.load(rig)
                rig.tweezers.ramp(0.3, 0.002)
                runs.append(lab.world.truth().tobytes())
        assert runs[0] == runs[1]
        assert 0 < sum(runs[0]) < 12
