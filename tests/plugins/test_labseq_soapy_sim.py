"""The simulated radio: the amplitudes that the simulation receives, whole runs, mistakes in profiles."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from labseq_soapy.static_tweezers import APART
from labseq_soapy_sim import Fault
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

from labseq import Session
from labseq.errors import LabseqError
from labseq.plugin import Context, DeviceError, RandomStream, TransientError, TweezerAmplitudes
from labseq.roles import RfSource, ToneSource
from labseq.safety.devices import check_devices
from labseq.session.check import check
from labseq.testing.fakes import FakeClock, RecordingSimulation

from .labseq_soapy_rig import GRID, Rig, opened, until
from .small_run import run, write

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


def test_each_change_of_the_amplitudes_is_reported_once_also_a_dip_that_is_over() -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        rig.tweezers.load((ROWS, COLUMNS))
        assert simulation.changes() == []
        rig.tweezers.start()
        (found,) = simulation.changes()
        assert found.row == pytest.approx(ROWS, abs=1e-6)
        assert found.column == pytest.approx(COLUMNS, abs=1e-6)
        assert simulation.changes() == []
        rig.tweezers.ramp(0.25, 0.001)
        rig.tweezers.ramp(1.0, 0.001)
        nominal = (ROWS[0] * COLUMNS[0]) ** 2
        depths = [(one.row[0] * one.column[0]) ** 2 / nominal for one in simulation.changes()]
        assert depths == pytest.approx([0.25, 1.0], abs=1e-4)
        rig.tweezers.release(100e-6)
        assert [one.dark_s for one in simulation.changes()] == pytest.approx([100e-6])
        rig.tweezers.load((ROWS / 2, COLUMNS))
        assert simulation.changes()[0].row == pytest.approx(ROWS / 2, abs=1e-6)


def kill(rig: Rig) -> None:
    os.kill(int(rig.tweezers._link.pid), signal.SIGKILL)  # pyright: ignore[reportOptionalMemberAccess]
    until(lambda: not rig.ring.is_playing)


def test_a_radio_that_fails_makes_no_tweezers() -> None:
    simulation = ReceivingSimulation()
    with opened(simulation=simulation) as rig:
        rig.tweezers.start()
        nominal = simulation.changes()[-1]

        def is_lit(row: bool, column: bool) -> bool:
            """Whether the tones of an axis are as they were, or it is dark."""
            rig.tweezers.radio.changed()
            found = simulation.source._last  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]
            expected = nominal.row * row, nominal.column * column
            return all(np.allclose(one, other, atol=0.01) for one, other in zip(found, expected, strict=True))

        for fault, row, column in ((Fault.MUTE_0, False, True), (Fault.MUTE_1, True, False)):
            rig.ring.set_fault(fault)
            until(lambda row=row, column=column: is_lit(row, column))
        rig.ring.set_fault(Fault.NONE)
        rig.ring["frequency_hz"][0] += 20e3
        until(lambda: is_lit(False, True))
        rig.ring["frequency_hz"][0] -= 20e3
        until(lambda: is_lit(True, True))
        simulation.changes()
        rig.ring.set_fault(Fault.UNDERFLOW)
        until(lambda: rig.described("underflows") == 1)
        with pytest.raises(TransientError):
            rig.tweezers.check_interlocks()
        dark, light = simulation.changes()
        assert not dark.row.any()
        assert light.row == pytest.approx(nominal.row, rel=0.05)
        kill(rig)
        assert not simulation.changes()[-1].row.any()
        with pytest.raises(DeviceError):
            rig.tweezers.ramp(0.5, 0.001)
        assert simulation.changes() == []


class Lab:
    """Atoms in tweezers made by a simulated radio; nothing but the light loses them."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        settings = {"loading": 1.0, "lifetime": 2e6, "imaging_loss": 0.0}
        context = Context("simulation", GRID, clock=self.clock, random=RandomStream(0))
        self.simulation = VirtualSimulation(SimulationSettings.model_validate(settings), context)
        self.simulation.open()

    def load(self, rig: Rig) -> None:
        self.simulation.begin_shot()
        rig.tweezers.start()
        self.simulation.load(self.clock.now(), 0.5)
        self.clock.sleep(0.5)

    @property
    def n_atoms(self) -> int:
        return int(np.count_nonzero(self.simulation.truth()))


def test_atoms_are_loaded_where_there_are_tweezers_and_stay_in_a_ramp_that_holds_them() -> None:
    lab = Lab()
    with opened(simulation=lab.simulation, clock=lab.clock) as rig:
        rig.tweezers.load((np.array([1.0, 0.0, 1.0]) / 3, np.full(4, 1 / 4)))
        lab.load(rig)
        assert lab.simulation.truth().any(axis=1).tolist() == [True, False, True]
        rig.tweezers.ramp(0.5, 0.001)
        assert lab.n_atoms == 8
        assert lab.simulation.spot_powers()[[0, 2]].mean() == pytest.approx(0.5, rel=0.05)


def test_atoms_are_lost_when_the_light_goes_off() -> None:
    lab = Lab()
    with opened(simulation=lab.simulation, clock=lab.clock) as rig:
        lab.load(rig)
        assert lab.n_atoms == 12
        rig.tweezers.ramp(0.0, 0.001)
        rig.tweezers.ramp(1.0, 0.001)
        assert (lab.n_atoms, lab.simulation.losses()["light"]) == (0, 12)
        lab.load(rig)
        rig.ring.set_fault(Fault.UNDERFLOW)
        until(lambda: rig.described("underflows") == 1)
        assert lab.n_atoms == 0
        with pytest.raises(TransientError):
            rig.tweezers.start()
        lab.load(rig)
        assert lab.n_atoms == 12
        kill(rig)
        assert lab.n_atoms == 0


SIMULATED = "{use: soapy, device: simulated, sample_rate: 12.5 MHz, row_gain: 3, column_gain: 3}"


def test_a_simulated_radio_gives_the_same_atoms_as_the_virtual_tweezers(tmp_path: Path) -> None:
    radio, virtual = run(tmp_path / "radio", SIMULATED), run(tmp_path / "virtual")
    assert (radio.status, radio.simulated, len(radio.shots)) == ("complete", True, 1)
    names = ("underflows", "sequence_errors", "late_packets")
    assert {radio.shots[0].readings[f"static_tweezers.{name}"] for name in names} == {0}
    for one, other in zip(radio.shots, virtual.shots, strict=True):
        assert np.array_equal(one.occupancies, other.occupancies)


@pytest.mark.parametrize(
    ("static", "exit_code", "text"),
    [
        ("device: simulated, sample_rate: 8 MHz", 2, "p.yaml:5:63: .*row tones: .* 3.6 MHz"),
        ("device: simulated, lo_offset: 1 MHz", 2, "p.yaml:5:61: .*lo_offset is 1 MHz"),
        ("device: driver=hackrf, lo_offset: 18 MHz", 2, "p.yaml:5:65: .*row tones: .* 21.6 MHz"),
        ("device: simulated, lo_offset: 18 MHz, bandwidth: 30 MHz", 2, "p.yaml:5:80: .*outermost tone"),
        ("device: 'simulated,coerce_rate=12500000'", 3, "12500000 samples per second, not 40000000"),
        ("row_channel: 1", 2, "row_channel and column_channel are both 1"),
        ("device: 'simulated,sped=1'", 2, "p.yaml:5:39: .*'sped'"),
        ("device: 'simulated, speed=0'", 2, "p.yaml:5:39: speed .*'0'; .* 0.0001"),
        ("device: 'simulated,fault=fire'", 2, "fault .*'fire'"),
    ],
)
def test_mistakes_are_reported_with_their_place(
    tmp_path: Path, static: str, exit_code: int, text: str
) -> None:
    with pytest.raises(LabseqError, match=text) as caught:
        run(tmp_path, f"{{use: soapy, {static}}}")
    assert caught.value.exit_code == exit_code


def test_check_warns_of_a_rate_beyond_the_bus_and_devices_of_a_radio_without_a_clock(tmp_path: Path) -> None:
    static = "{use: soapy, device: 'driver=uhd,type=usrp2', sample_rate: 40 MHz}"
    sequence = write(tmp_path, static)
    warnings = [str(one) for one in check(Session.open(sequence, shots=1)).warnings]
    assert [one for one in warnings if "p.yaml:5:77: " in one and "320 MB/s" in one]
    radio = "profile.static_tweezers={use: soapy, device: 'simulated,time=0', sample_rate: 12.5 MHz}"
    report = check_devices(str(tmp_path / "p.yaml"), [radio])
    assert all(found.ok for found in report.devices), report.devices
    assert [*report.warnings] == [f"static_tweezers: {APART}"]
